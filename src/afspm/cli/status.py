"""`afspm status` and `afspm watch`: the state of a running experiment, once or continuously."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import RUNS, Where
from afspm.cli.joining import can_show_blocks, describe, looking, plain_console, say_nothing_runs

if TYPE_CHECKING:
    from rich.console import Console

    from afspm.cli.follower import Follower
    from afspm.cli.status_text import StatusText

REFRESH_S = 0.25  # real time between two pictures of the terminal
LOOK_S = 2.0
"""Interval of checks whether the run still goes on, while no packets arrive."""


def status(
    where: Where = RUNS,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    log: Annotated[int, typer.Option("--log", "-n", min=0, metavar="LINES", help="The last lines of the log.")] = 8,
) -> None:
    """Show the state of a running experiment: control, microscope, problems, notes and the time left.

    Ends with 3 if no experiment runs.
    """
    with looking(where, as_json=as_json) as follower:
        text = _text(follower)
        if as_json:
            typer.echo(json.dumps(text.as_json(), indent=2, ensure_ascii=False))
        else:
            plain_console().print(text.screen(log_lines=log))


def watch(where: Where = RUNS) -> None:
    """Watch a running experiment until it ends, or Ctrl-C. Does not disturb the experiment.

    If the output is no terminal, a line is written at each change. Ends with 3 if the run is cut off.
    """
    console = plain_console()
    with looking(where, lines=True) as follower, contextlib.suppress(KeyboardInterrupt):
        if console.is_terminal and not console.is_dumb_terminal:
            _live(follower, console)
        else:
            _in_lines(follower)
        if not follower.ended:
            say_nothing_runs(f"no scheduler answers any more in {follower.folder.resolve().name}; {follower.cut_off()}")
        typer.echo("the experiment has ended")


def _text(follower: Follower) -> StatusText:
    from afspm.cli.status_text import StatusText

    return StatusText(follower.overview, describe(follower, fancy=can_show_blocks()), follower.clock.now_ns())


def _goes_on(follower: Follower) -> bool:
    # the run's lock is tested only after a silence: it may lie on a slow network disk
    from afspm.night.overview import OLD_S

    return not (follower.ended or (follower.silent_s() > OLD_S and follower.cut_off()))


def _live(follower: Follower, console: Console) -> None:
    from rich.live import Live

    with Live(console=console, screen=True, auto_refresh=False, vertical_overflow="crop") as live:
        shown_s = 0.0
        while _goes_on(follower):
            now_s = follower.clock.monotonic_s()
            if now_s - shown_s >= REFRESH_S:
                text = _text(follower)
                # the log fills the remaining lines
                room = console.height - 1 - len(console.render_lines(text.screen(log_lines=0), pad=False))
                live.update(text.screen(silent_s=follower.silent_s(), log_lines=max(0, room)), refresh=True)
                shown_s = now_s
            follower.pump(REFRESH_S)


def _in_lines(follower: Follower) -> None:
    from afspm.cli.status_text import log_line

    said, log = "", follower.overview.log
    last = log[-1] if log else None
    while _goes_on(follower):
        overview = follower.overview
        key = str((overview.control, overview.status))
        if key != said:
            said = key
            typer.echo(_text(follower).summary())
        fresh = list(overview.log)
        if last is not None and last in fresh:
            fresh = fresh[len(fresh) - fresh[::-1].index(last) :]
        for line in fresh:
            typer.echo(log_line(line).plain)
            last = line
        follower.pump(LOOK_S)
