"""`afspm run`: an experiment, from its file to the folder that it leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import FilesUnlessResumed, names_in

if TYPE_CHECKING:
    from afspm.experiment import Experiment, ProcessStart


def run(
    files: FilesUnlessResumed = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            metavar="NAME[,NAME…]",
            help="Start these processes here, and no others.",
            show_default=False,
        ),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without", metavar="NAME[,NAME…]", help="Start all processes here but these.", show_default=False
        ),
    ] = None,
    runs: Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where to make the run's folder.")] = Path("runs"),
    speed: Annotated[
        float | None,
        typer.Option(
            min=1e-6, help="Experiment seconds in a real second; simulated microscopes only.", show_default=False
        ),
    ] = None,
    dashboard: Annotated[
        bool,
        typer.Option(
            "--dashboard", help="Show it in the browser, too, if the file doesn't say so.", show_default=False
        ),
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Go on with a run that was killed or stopped, in its folder; the newest, of a folder of runs.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check, say what would be started, and start nothing.")
    ] = False,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write report.html when it has ended.", show_default=False)
    ] = True,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Tell details too.")] = False,
) -> None:
    """Run an experiment.

    Everything is checked before anything starts. Processes that crash or freeze are restarted. Ctrl-C ends the
    experiment cleanly, a second one at once. Ends with 0 when the experiment has ended by itself, with 1 when the
    experiment file is wrong or something essential was given up.
    """
    import logging
    import sys

    from afspm.cli.dashboard import resumed_with_dashboard, with_dashboard
    from afspm.experiment import load
    from afspm.supervisor import resume as resuming
    from afspm.supervisor import run as running

    options = running.RunOptions(
        runs=runs,
        only=names_in(only),
        without=names_in(without),
        speed=speed,
        report=report,
        log_level=logging.DEBUG if verbose else logging.INFO,
    )
    if resume is not None:
        if files or only or without or speed or dry_run:
            said = "a run is resumed as it was begun: give nothing else, but --dashboard"
            raise typer.BadParameter(said, param_hint="--resume")
        found = resuming.find(resume)
        if dashboard:
            found = resumed_with_dashboard(found)
        _check(found.experiment)
        raise typer.Exit(resuming.resume(found, options, terminal=sys.stdout).outcome.exit_code)
    if not files:
        raise typer.BadParameter("name an experiment file, or a run with --resume", param_hint="FILE")
    experiment = with_dashboard(files) if dashboard else load(*files)
    _check(experiment)
    if dry_run:
        for start in running.dry_run(experiment, options):
            typer.echo(_told(start))
        return
    ended = running.run(experiment, options, terminal=sys.stdout)
    raise typer.Exit(ended.outcome.exit_code)


def _check(experiment: Experiment) -> None:
    """Show what is wrong or doubtful. Raises typer.Exit if something is wrong."""
    from afspm.cli import check

    findings = experiment.check()
    if findings:
        from rich.console import Console

        check.show(findings, Console(stderr=True, highlight=False))
    if any(finding.is_error for finding in findings):
        raise typer.Exit(1)


def _told(start: ProcessStart) -> str:
    what = " ".join(start.command) or start.launch.class_
    return f"{start.launch.name} ({start.role.value}): {what}"
