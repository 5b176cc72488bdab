"""`afspm status` and `afspm watch`: looking at a running experiment, once or for as long as one likes."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.joining import Where, about, can_show_blocks, looking, say_nothing_runs

if TYPE_CHECKING:
    from rich.console import Console

    from afspm.cli.telling import About
    from afspm.client.follower import Follower

REFRESH_S = 0.25
LOOK_S = 2.0
"""So often it is looked whether it still goes on, where nothing is said."""
UNBROKEN = 10_000  # columns: what programs and files get has a line for a line
RUNS = Path("runs")


def status(
    where: Where = RUNS,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    log: Annotated[int, typer.Option("--log", "-n", min=0, metavar="LINES", help="The last lines of the log.")] = 8,
) -> None:
    """Say how a running experiment is: who is in control, what the microscope does, how long it will still take.

    Ends with 3 where nothing runs.
    """
    from afspm.cli import telling

    with looking(where) as follower:
        told, now_ns = about(follower, fancy=can_show_blocks()), follower.clock.now_ns()
        if as_json:
            typer.echo(json.dumps(telling.as_json(follower.overview, told, now_ns), indent=2, ensure_ascii=False))
        else:
            _console().print(telling.screen(follower.overview, told, now_ns, log_lines=log))


def watch(where: Where = RUNS) -> None:
    """Watch a running experiment until it ends, or Ctrl-C; the experiment does not notice.

    Where the output is no terminal, a line is written whenever something changes. Ends with 3 if the run is cut off.
    """
    console = _console()
    with looking(where, lines=True) as follower, contextlib.suppress(KeyboardInterrupt):
        told = about(follower, fancy=can_show_blocks())
        if console.is_terminal and not console.is_dumb_terminal:
            _live(follower, told, console)
        else:
            _in_lines(follower)
        if not follower.ended:
            say_nothing_runs(f"nobody answers any more in {follower.folder.resolve().name}; {follower.cut_off()}")
        typer.echo("the experiment has ended")


def _goes_on(follower: Follower) -> bool:
    """Whether there is more to come. (Who runs it is looked for only where it is silent: a disk may be far away.)"""
    from afspm.record.overview import OLD_S

    return not (follower.ended or (follower.silent_s() > OLD_S and follower.cut_off()))


def _live(follower: Follower, told: About, console: Console) -> None:
    from rich.live import Live

    from afspm.cli import telling

    def picture() -> object:
        now_ns = follower.clock.now_ns()
        return telling.screen(
            follower.overview, told, now_ns, silent_s=follower.silent_s(), log_lines=_room(follower, told, console)
        )

    with Live(console=console, screen=True, auto_refresh=False, vertical_overflow="crop") as live:
        shown_s = 0.0
        while _goes_on(follower):
            now_s = follower.clock.monotonic_s()
            if now_s - shown_s >= REFRESH_S:
                live.update(picture(), refresh=True)  # type: ignore[arg-type]
                shown_s = now_s
            follower.pump(REFRESH_S)


def _room(follower: Follower, told: About, console: Console) -> int:
    """How many lines of the log fit below all else."""
    from afspm.cli import telling

    rest = telling.screen(follower.overview, told, follower.clock.now_ns(), log_lines=0)
    taken = len(console.render_lines(rest, pad=False))
    return max(0, console.height - taken - 1)


def _in_lines(follower: Follower) -> None:
    from afspm.cli import telling

    said, seen = "", len(follower.overview.log)
    last = follower.overview.log[-1] if seen else None
    while _goes_on(follower):
        overview = follower.overview
        key = str((overview.control, overview.status))
        if key != said:
            said = key
            typer.echo(telling.summary(overview, follower.clock.now_ns()))
        fresh = list(overview.log)
        if last is not None and last in fresh:
            fresh = fresh[len(fresh) - fresh[::-1].index(last) :]
        for line in fresh:
            typer.echo(telling.log_line(line).plain)
            last = line
        follower.pump(LOOK_S)


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = UNBROKEN
    return console
