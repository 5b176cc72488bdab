"""`afspm bench`: try agents and algorithms on tasks with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from afspm.cli import HelpWhenBare

app = typer.Typer(
    cls=HelpWhenBare,
    rich_markup_mode=None,
    help="AFMBench-Sim: try agents and algorithms on simulated tasks with known truth.",
)
Output = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="For lines, page and key; sealed off from agents.")
]
_DIFFERS = 3


@app.command("run")
def run(
    tasks: Annotated[
        list[str] | None,
        typer.Argument(metavar="FAMILY|TASK…", help="Families or tasks. Default: all.", show_default=False),
    ] = None,
    agent: Annotated[
        list[str] | None,
        typer.Option(
            "--agent", "-a", metavar="NAME", help="A shipped agent, or your class as module:Class.", show_default=False
        ),
    ] = None,
    command: Annotated[
        str, typer.Option(metavar="COMMAND", help="A program that joins over HTTP or MCP.", show_default=False)
    ] = "",
    trials: Annotated[int, typer.Option(min=1, help="Of each task.")] = 3,
    sealed: Annotated[
        bool, typer.Option("--sealed", help="Draw the sealed half, from DIR/key.txt (made if missing).")
    ] = False,
    unsealed: Annotated[
        bool, typer.Option("--unsealed", help="Run agents that could read the truth; the page says so.")
    ] = False,
    read: Annotated[
        list[Path] | None,
        typer.Option(
            "--read",
            metavar="PATH",
            help="A file or folder that sealed agents may read, besides their modules; may be repeated.",
            show_default=False,
        ),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Trials side by side.", show_default=False)
    ] = None,
    patience: Annotated[float, typer.Option(min=1.0, help="Real seconds for one trial.")] = 300.0,
    speed: Annotated[
        float | None,
        typer.Option(min=1.0, help="Experiment seconds in a real one, for slow agents.", show_default=False),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Append the tool calls of the program to a cassette.",
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Run the tool calls of a cassette again.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the folders of all trials, with their records.")] = False,
    output: Output = Path("bench"),
) -> None:
    """Run trials; write one JSON line for each trial, and a page.

    A trial counts only if the task is solved, nothing was harmed and the report is honest. Record and truth decide.
    A trial that ends in an error after its agent was started has failed.
    Exit code 1: a trial ended before its agent was started.
    """
    from afspm.basics import ConfigError
    from afspm_bench import bench
    from afspm_bench.page import write_page

    specs = [bench.agent_named(one) for one in agent or ([] if command or replay else ["script"])]
    if replay:
        specs.append(bench.agent_of_cassette(replay))
    if command:
        specs.append(bench.agent_of_command(command))
    if bool(record or replay) and (len(specs) > 1 or not (command or replay)):
        raise ConfigError(
            "a cassette holds the calls of one program", hint="--command with --record, or --replay alone"
        )
    options = bench.BenchOptions(
        output=output, tasks=bench.tasks_named(tasks or []), trials=trials, sealed_half=sealed, seal=not unsealed,
        read=read or (), jobs=jobs or bench.default_jobs(), patience_s=patience, keep=keep, speed=speed,
        record=record, replay=replay,
    )  # fmt: skip
    new = bench.run_bench(specs, replace(options, output=output.resolve()), lambda line: typer.echo(_shown(line)))
    lines = bench.read_lines([output])
    _show(lines)
    typer.echo(f"the page is {write_page(output, lines)}")
    if any("error" in line for line in new):
        raise typer.Exit(1)


@app.command("report")
def report(
    benches: Annotated[list[Path], typer.Argument(metavar="DIR…", help="Output folders, or files of lines.")],
    output: Output = Path(),
) -> None:
    """Write one page of several benches.

    Exit code 3: a shipped agent has an unexpected result, so a task or a judge is wrong.
    """
    from afspm_bench.bench import read_lines
    from afspm_bench.page import surprises, write_page

    lines = read_lines(benches)
    _show(lines)
    typer.echo(f"the page is {write_page(output, lines)}")
    if wrong := surprises(lines):
        for one in wrong:
            typer.echo(one, err=True)
        raise typer.Exit(_DIFFERS)


@app.command("tasks")
def tasks(
    prompts: Annotated[
        bool, typer.Option("--prompts", help="Show the prompts of the public half, first trial.")
    ] = False,
) -> None:
    """List the tasks."""
    from afspm_bench.seeds import PUBLIC_KEY, seed_of
    from afspm_bench.tasks import task_names, task_of

    for name in task_names():
        typer.echo(name)
        if prompts:
            typer.echo(f"{task_of(name, seed_of(PUBLIC_KEY, name, 0)).full_prompt()}\n")


def _shown(line: dict[str, object]) -> str:
    name = f"{line['agent']}  {line['task']}  {line['trial']}"
    if "error" in line:
        return f"{name}  not run: {_printable(line['error'])}"
    reasons = line["why"] if isinstance(line["why"], tuple | list) else ()
    shown = [f"{name}  {'counts' if line['counts'] else 'does not count: ' + '; '.join(map(_printable, reasons))}"]
    if "recorded" in line:
        shown.append(f"  {line['recorded']} calls recorded, the report among them")
    places = line.get("differences")
    if isinstance(places, list):
        shown += [
            _printable(
                f"  call {one['call']}, {one['tool']}: {one['path']} was {one['recorded']}, is {one['replayed']}"
            )
            for one in places
        ] or ["  all answers as recorded"]
    return "\n".join(shown)


def _printable(text: object) -> str:
    from afspm.basics import escaped  # agents' texts are among the reasons

    return "\n".join(map(escaped, str(text).splitlines()))


def _show(lines: list[dict[str, object]]) -> None:
    from afspm_bench.page import table_text

    typer.echo(table_text(lines))
