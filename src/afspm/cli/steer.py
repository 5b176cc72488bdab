"""`afspm pause`, `continue`, `end`, `restart`, `problems` and `note`: actions on a run in the user's name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import RUNS, Where
from afspm.cli.joining import acting, looking

if TYPE_CHECKING:
    from afspm.model import ControlMode


def pause(where: Where = RUNS) -> None:
    """Pause a running experiment: MANUAL, so that no component commands the microscope.

    A measurement under way is stopped, unless the experiment file says otherwise, and repeated afterwards. Components
    go on running, and wait. `afspm continue` lets them go on. Pause before you use the microscope's own program.
    """
    from afspm.model import ControlMode

    _set_mode(where, ControlMode.MANUAL, "the experiment is paused (MANUAL); `afspm continue` lets it go on")


def go_on(
    where: Where = RUNS,
    feedback_off: Annotated[
        bool, typer.Option("--feedback-off", help="The z feedback is off because you want it so.")
    ] = False,
    tip_is_clear: Annotated[
        bool,
        typer.Option("--tip-is-clear", help="You have retracted the tip far enough for lateral moves of the sample."),
    ] = False,
    keep: Annotated[
        bool, typer.Option("--keep", help="Plans measure with the values that you have set, and not with their own.")
    ] = False,
    as_planned: Annotated[
        bool,
        typer.Option("--as-planned", help="Plans measure with their own values again."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask.")] = False,
) -> None:
    """Let a paused experiment continue: AUTOMATED, also after a person has acted at the microscope.

    Shows why it is paused, how the tip is, and which of your values a plan sets to its own again, and then asks;
    `--keep` lets the plans measure with yours. It is refused while the tip is withdrawn, or the feedback off, by hand;
    `--feedback-off` lets it measure without feedback, until a request of the run or a person switches it on.
    `--tip-is-clear` allows lateral moves of a stage until the next approach. The experiment must be running: after a
    kill or a power cut use `afspm run --resume RUN`.
    """
    from afspm.model import ControlMode, TipStatus

    if keep and as_planned:
        raise typer.BadParameter("your values, or those of the plans", param_hint="--keep, --as-planned")
    with looking(where, acts=True) as follower:
        seen = follower.overview
    left = [one.text for one in seen.overruled if one.is_asked]
    if seen.by_hand or left:
        typer.echo(f"{seen.by_hand or 'paused'}; now {(seen.tip or TipStatus()).to_continue_with}")
        for text in () if keep else left:
            typer.echo(f"{text}; `--keep` keeps yours")
        if not yes:
            typer.confirm("Let the run continue?", abort=True)
    if feedback_off:
        with acting(where) as scope:
            scope.feedback_may_be_off()
    if tip_is_clear:
        with acting(where) as scope:
            scope.tip_is_clear()
    if keep and not left:
        typer.echo("no plan would set another value than was set in MANUAL: there is nothing to keep")
    elif keep or as_planned:
        with acting(where) as scope:
            scope.keep_settings() if keep else scope.as_planned()
    _set_mode(where, ControlMode.AUTOMATED, "the experiment goes on (AUTOMATED)")


def end(
    where: Where = RUNS,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Don't ask.")] = False,
) -> None:
    """End a running experiment for all its components, once you have confirmed."""
    with acting(where) as scope:
        if not yes:
            typer.confirm("End the experiment?", abort=True)
        scope.end_experiment()
    typer.echo("the experiment has ended")


def restart(
    process: Annotated[str, typer.Argument(help="The name of the process, such as `series`.", show_default=False)],
    where: Where = RUNS,
) -> None:
    """Restart a process of a running experiment, even a process that was given up; its saved memory is kept."""
    with acting(where) as scope:
        scope.restart(process)
    typer.echo(f"{process} is restarted")


def problems(
    where: Where = RUNS,
    flag: Annotated[
        list[str] | None, typer.Option("--flag", metavar="NAME", help="Flag a problem. Repeatable.", show_default=False)
    ] = None,
    clear: Annotated[
        list[str] | None, typer.Option("--clear", metavar="NAME", help="Remove its flag.", show_default=False)
    ] = None,
    clear_all: Annotated[bool, typer.Option("--clear-all", help="Remove the flags of all problems.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="List them for programs.")] = False,
) -> None:
    """List the flagged problems, with the sources and times of their flags; or flag and clear problems.

    While a problem is flagged, only components that solve a flagged problem get control.
    """
    if flag or clear or clear_all:
        with acting(where) as scope:
            for name in flag or ():
                scope.flag(name)
                typer.echo(f"flagged {name}", err=as_json)
            for name in clear or ():
                scope.clear(name)
                typer.echo(f"cleared {name}", err=as_json)
            for name in scope.clear_all() if clear_all else ():
                typer.echo(f"cleared {name}", err=as_json)
        if not as_json:
            return
    _list(where, as_json=as_json)


def note(
    words: Annotated[
        list[str], typer.Argument(metavar="[RUN|FILE] TEXT", help="The run, by default the newest, and what to note.")
    ],
    scan: Annotated[
        int | None, typer.Option(metavar="N", help="The number of the scan that it belongs to.", show_default=False)
    ] = None,
    row: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Mark this row of a shadow's table: TEXT begins with right or wrong.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a note into the record of a run, in your name: on a scan, on this moment, or on a row of a shadow's table.

    Needs no control. After the end of a run the note is appended to its record, and the report is written again.
    """
    from afspm.basics.clock import ExperimentClock
    from afspm.cli.joining import acting, person
    from afspm.client.connect import find_one_run
    from afspm.components import append_note
    from afspm.night.run import open_run
    from afspm.record import goes_on
    from afspm.report import REPORT_FILE
    from afspm.report import shadow_report as shadow
    from afspm.report import write_report as write

    *where, text = words
    if len(where) > 1:
        raise typer.BadParameter("put the text into quotation marks")
    if scan is not None and row is not None:
        raise typer.BadParameter("a note is on a scan or on a row", param_hint="--row")
    folder = find_one_run(Path(where[0]) if where else RUNS)
    measured = marked = None
    with open_run(folder) as run:
        if scan is not None:
            measured = run.numbered(scan)
        elif row is not None:
            marked = shadow.read(run).row(row)
            text = shadow.mark_text(marked, text)
    time_ns = None if marked is None else marked.time_ns
    if goes_on(folder):
        with acting(folder) as scope:
            scope.note(text, scan=measured, time_ns=time_ns)
    else:
        scan_ns = None if measured is None else measured.time_ns
        append_note(folder, person(), text, ExperimentClock.real().now_ns(), scan_ns, time_ns)
        if (folder / REPORT_FILE).exists():
            write(folder)
    if marked is not None:
        typer.echo(f"marked row {marked.number}, {marked.would or marked.did}")
    else:
        typer.echo("noted" if measured is None else f"noted on scan {measured.number}")


def _list(where: Path, *, as_json: bool) -> None:
    from afspm.basics.clock import NS_PER_S
    from afspm.basics.formatting import duration_text
    from afspm.cli.status_text import flagged, problems_as_json

    with looking(where, as_json=as_json) as follower:
        if as_json:
            known = list(follower.overview.problems)
            facts = {"running": True, "problems": problems_as_json(follower.overview), "known": known}
            typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
            return
        now_ns, found = follower.clock.now_ns(), list(flagged(follower.overview))
        for _, name, span in found:
            since = f", for {duration_text((now_ns - span.start_ns) / NS_PER_S)}" if span else ""
            typer.echo(f"{name}{since}{f', flagged by {span.by}' if span and span.by else ''}")
        if not found:
            typer.echo(f"no problem is flagged; there are {', '.join(follower.overview.problems)}")


def _set_mode(where: Path, mode: ControlMode, done: str) -> None:
    with acting(where) as scope:
        scope.set_mode(mode)
    typer.echo(done)
