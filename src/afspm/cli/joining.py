"""Connections from terminal commands to a running experiment, in the user's name."""

from __future__ import annotations

import getpass
import json
import platform
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from afspm.cli.follower import Follower
    from afspm.cli.status_text import RunDescription
    from afspm.client.scope import Scope

NOT_RUNNING = 3
"""Exit code if no experiment runs."""
TERMINAL = "terminal"
_UNBROKEN = 10_000  # columns: output to files and pipes is not wrapped


def person() -> str:
    """Return the name of the user at this terminal for the experiment, such as "terminal:ada"."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):  # a container without this user
        user = ""
    return f"{TERMINAL}:{user}" if user else TERMINAL


@contextmanager
def looking(where: Path, *, lines: bool = False, as_json: bool = False, acts: bool = False) -> Iterator[Follower]:
    """Open a follower of the run at `where`; if no run goes on there, end the command with `NOT_RUNNING`.

    Args:
        where: the folder of a run, a folder of runs (its newest) or an experiment file (its newest run).
        lines: whether to follow lines of unfinished scans, too.
        as_json: whether a program reads the output, also that no run goes on.
        acts: whether the command acts on the run afterwards: then several running runs are refused.
    """
    from afspm.cli.follower import Follower

    folder = _running(where, as_json=as_json, acts=acts)
    with Follower(folder, TERMINAL, lines=lines) as follower:
        with _only_if_running(folder, as_json=as_json):
            follower.catch_up()
        if follower.ended:
            say_nothing_runs(f"{folder.resolve().name} has just ended", as_json=as_json)
        yield follower


@contextmanager
def acting(where: Path) -> Iterator[Scope]:
    """Connect to the run at `where`, as for `looking`, in the user's name; end the command if no run goes on there."""
    from afspm.client.connect import join

    folder = _running(where, as_json=False, acts=True)
    with _only_if_running(folder, as_json=False):
        scope = join(folder, person())
    with scope:
        yield scope


def describe(follower: Follower, *, fancy: bool = True) -> RunDescription:
    """Return facts about the run that are not in its packets."""
    from afspm.cli.status_text import RunDescription
    from afspm.night import plans_of
    from afspm.record import REPLAY_OF, read_run_json

    clock, facts = follower.launch.clock, read_run_json(follower.folder)
    return RunDescription(
        name=str(facts.get("name", follower.folder.name)),
        folder=str(follower.folder),
        replay_of=str(facts.get(REPLAY_OF, "")),
        simulated=follower.launch.simulated,
        began_ns=round(float(clock["start_s"]) * 1e9) if clock else None,
        speed=float(clock["speed"]) if clock else 1.0,
        fancy=fancy,
        plans=plans_of(facts),
    )


def can_show_blocks() -> bool:
    """Return whether the terminal's encoding has the block characters of bars."""
    try:
        "█░".encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def say_nothing_runs(why: str, *, as_json: bool = False) -> NoReturn:
    """End the command because no run goes on: raises typer.Exit."""
    _end_without_run(f"nothing runs here: {why}", as_json=as_json, running=False)


def say_unanswered(folder: Path, *, as_json: bool = False) -> NoReturn:
    """End the command because the scheduler of a run does not answer: raises typer.Exit."""
    from afspm.record import cut_off_message
    from afspm.record.run_json import run_json_or_empty
    from afspm.record.run_lock import other_computer

    name = folder.resolve().name
    if cut_off := cut_off_message(folder):
        say_nothing_runs(f"no scheduler answers in {name}; {cut_off}", as_json=as_json)
    if computer := other_computer(folder):
        why = f"{name} was started on {computer}, and does not answer to this computer ({platform.node()})"
        _end_without_run(f"{why}: run this command there", as_json=as_json, running=None)
    why = f"no scheduler answers in {name}, though it has not ended"
    if (run_json_or_empty(folder).get("guest") or {}).get("keys"):
        why += f"; perhaps its scheduler lacks the public key of {TERMINAL}"
    say_nothing_runs(why, as_json=as_json)


def _end_without_run(why: str, *, as_json: bool, running: bool | None) -> NoReturn:
    # running: null where it is not known
    if as_json:
        typer.echo(json.dumps({"running": running, "why": why}, indent=2, ensure_ascii=False))
    else:
        typer.echo(f"afspm: {why}", err=True)
    raise typer.Exit(NOT_RUNNING)


def _running(where: Path, *, as_json: bool, acts: bool) -> Path:
    from afspm.basics.errors import FileError
    from afspm.client.connect import find_run, others_running, require_no_others, several_run
    from afspm.record import goes_on, read_run_json
    from afspm.record.run_json import ENDED, RUN_FILE

    try:
        folder = find_run(where)
    except FileError as error:
        say_nothing_runs(str(error), as_json=as_json)
    if not (folder / RUN_FILE).exists():
        why = "it is about to start: repeat the command in a few seconds; or its files were removed"
        say_nothing_runs(f"{folder.name} has no {RUN_FILE}: {why}", as_json=as_json)
    ended, others = read_run_json(folder).get(ENDED), others_running(where, folder)
    if ended or (others and not goes_on(folder)):
        how = f"has ended ({ended})" if ended else "was cut off"
        more = f"; {others[-1]} goes on: name its folder" if others else ""
        say_nothing_runs(f"{folder.resolve().name} {how}{more}", as_json=as_json)
    if acts:
        require_no_others(where, folder, others)
    elif others:
        typer.echo(f"afspm: {several_run(folder, others)}: this is {folder}", err=True)
    return folder


@contextmanager
def _only_if_running(folder: Path, *, as_json: bool) -> Iterator[None]:
    from afspm.basics.errors import ExperimentEnded, NoResponse

    try:
        yield
    except ExperimentEnded as error:
        say_nothing_runs(str(error), as_json=as_json)
    except NoResponse:
        say_unanswered(folder, as_json=as_json)


def plain_table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> Table:
    """Return a table whose only line is below its heads."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for head in heads:
        table.add_column(head, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def plain_console() -> Console:
    """Return a console for tables and colours; output to files and pipes is not wrapped."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = _UNBROKEN
    return console
