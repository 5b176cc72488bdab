"""`afspm shadow`: a run that only watches a person's work, and its folder for others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli.arguments import RUNS, HelpWhenBare, OptionalFiles, RecordedRun, Runs, opt

_WATCH = "watch"


class ShadowCommands(HelpWhenBare):
    """The commands of `afspm shadow`; without the name of one it is `watch`."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        is_named = not args or args[0] in self.commands or args[0] in ctx.help_option_names
        return super().parse_args(ctx, args if is_named else [_WATCH, *args])


app = typer.Typer(
    cls=ShadowCommands,
    rich_markup_mode=None,
    help="Watch a person's work at the microscope, and write down what afspm would have done.",
)


@app.command(_WATCH)
def watch(
    files: OptionalFiles = None,
    on: Annotated[
        str,
        opt(
            "The microscope, e.g. nanonis: all detectors that need no settings. Files are then its overlays.",
            "--on",
            metavar="MAKER",
        ),
    ] = "",
    runs: Runs = RUNS,
) -> None:
    """Watch a person's work; `watch` may be left out: `afspm shadow night.toml`, `afspm shadow --on nanonis`.

    The controller is only read: the process that talks to it has no function that sets or starts anything. Components
    see all scans, and no component gets control. Ctrl-C ends it; a killed shadow leaves the controller as it is. The
    report and shadow.csv have what afspm would have done, beside what the person did.
    """
    import sys
    import tempfile

    from afspm.cli.experiment_file import require_no_errors
    from afspm.cli.run import with_overlay
    from afspm.experiment.shadow import shadow_file, shadow_overlay
    from afspm.night.run import open_run
    from afspm.report import shadow_report as watched
    from afspm.supervisor import run as running

    with tempfile.TemporaryDirectory() as folder:
        named = [*([shadow_file(on, Path(folder))] if on else []), *(files or [])]
        if not named:
            raise typer.BadParameter("name an experiment file, or a microscope with --on", param_hint="FILE")
        experiment = with_overlay(named, shadow_overlay)
        require_no_errors(experiment, (), ())
        ended = running.run(experiment, running.RunOptions(runs=runs), terminal=sys.stdout)
    with open_run(ended.folder) as found:
        for line in watched.agreement_in_words(watched.read(found)):
            typer.echo(line)
    raise typer.Exit(ended.outcome.exit_code)


@app.command("pack")
def pack(
    recorded: RecordedRun = RUNS,
    out: Annotated[Path, opt("The folder to make.", "--out", "-o", metavar="DIR")] = Path("shadow-pack"),
    hide: Annotated[list[str] | None, opt("Replace this text, too. Repeatable.", "--hide", metavar="TEXT")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask.")] = False,
) -> None:
    """Make a folder of a shadow's run for others: without names, comments and places of files.

    It has raw values, the wire trace, which `afspm emulate --replay` plays back, and the table. All that is replaced
    and kept is listed first. Nothing is sent: look at the folder, and then give it to whom you like.
    """
    from afspm.cli import shadow_pack
    from afspm.night.run import open_run

    with open_run(recorded) as run:
        found = shadow_pack.read(run, hide or ())
        typer.echo("replaced by x, in all files:")
        for one in found.private:
            typer.echo(f"  {one.text!r}, {one.where}")
        for one in found.too_short:
            typer.echo(f"NOT replaced, too short or a word of the protocol: {one.text!r}, {one.where}")
        typer.echo(f"left out: {shadow_pack.LEFT_OUT}")
        typer.echo("kept:")
        for line in shadow_pack.KEPT:
            typer.echo(f"  {line}")
        if not yes:
            typer.confirm(f"Write {out}?", abort=True)
        for line in shadow_pack.write(found, out):
            typer.echo(f"left out: {line}")
    typer.echo(f"packed into {out}")
