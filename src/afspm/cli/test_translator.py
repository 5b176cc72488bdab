"""`afspm test-translator`: does a translator do what the wire format says?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import names_in

if TYPE_CHECKING:
    from rich.console import Console

    from afspm.testing.translators import CheckOptions

Files = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="FILE [OVERLAY…]",
        help="An experiment file with a translator; a scheduler, too, unless the usual one will do.",
        show_default=False,
    ),
]
_ASK = """The probe will be moved, scans and spectra be taken, gains and bias changed by a few percent, the feedback
switched off and on, all within the frame that is set now; everything is put back. Nothing is approached, pulsed or
crashed. Is the tip so far from the sample that it can't reach it, whatever the feedback does?"""


def check_translator(
    files: Files = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", "-k", metavar="PART", help="Only checks with this in their name.", show_default=False),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without",
            metavar="NAME[,NAME…]",
            help="Processes that run already: joined by the addresses in the file.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE", help="Write the report here, too.", show_default=False)
    ] = None,
    runs: Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where to make the run's folder.")] = Path("runs"),
    speed: Annotated[
        float, typer.Option(min=1e-6, help="Experiment seconds in a real second; simulated microscopes only.")
    ] = 20.0,
    frame: Annotated[
        str,
        typer.Option(
            metavar="SIZE",
            help='Stay within a square of this side about the centre of the frame that is set, e.g. "500 nm". '
            "Default: within the frame that is set.",
            show_default=False,
        ),
    ] = "",
    yes: Annotated[bool, typer.Option("--yes", "-y", help="The tip is withdrawn: don't ask.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the checks, and do none.")] = False,
) -> None:
    """Check each base operation of a translator from outside, with the tip withdrawn.

    Starts translator and scheduler (and an emulated controller, if there is one), or joins running ones. What the
    microscope does not support is skipped and listed. Ends with 0 if nothing was wrong.
    """
    import sys

    from rich.console import Console

    from afspm.testing.translators import CheckOptions
    from afspm.units import si

    if listed:
        _list()
        return
    if not files:
        raise typer.BadParameter("an experiment file is wanted", param_hint="FILE")
    console = Console(file=sys.stdout, highlight=False)
    options = CheckOptions(files, names_in(without), runs, speed, names_in(only), si(frame, "m") if frame else None)
    if not yes and not _is_simulated(options):
        typer.confirm(_ASK, abort=True)
    _run(options, console, report)


def _list() -> None:
    from afspm.testing.translators.registry import all_checks

    for check in all_checks():
        typer.echo(f"{check.name:31}{check.title}")


def _is_simulated(options: CheckOptions) -> bool:
    from afspm.testing.translators.session import is_simulated, prepare

    return is_simulated(prepare(options), options)


def _run(options: CheckOptions, console: Console, copy: Path | None) -> None:
    import signal

    from afspm.testing.translators import CheckReport, run
    from afspm.testing.translators.report import show_beginning, show_end, show_result

    begun: list[CheckReport] = []

    def begin(report: CheckReport) -> None:
        begun.append(report)
        show_beginning(report, console)

    # whoever ends it has everything put back first
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        report = run(options, begin, done=lambda result: show_result(result, console))
    except KeyboardInterrupt:
        for report in begun:
            show_end(report, console)
        raise
    show_end(report, console)
    if copy is not None:
        copy.write_text(report.to_json(), encoding="utf-8")
    if not report.passed:
        raise typer.Exit(1)
