"""`afspm run`: an experiment, from its file to the folder that it leaves behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol

import typer

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
from afspm.cli.arguments import RUNS, OptionalFiles, Runs, Speed, names_in, opt

if TYPE_CHECKING:
    from afspm.basics.plain_data import PlainMapping
    from afspm.experiment import Experiment, ProcessStart
    from afspm.supervisor.resume import ResumableRun
    from afspm.supervisor.run import FinishedRun


class RunPage(Protocol):
    """The functions of a module that shows runs in the browser."""

    def with_page(self, files: list[Path]) -> Experiment:
        """Return the experiment of these files, with a page if the files have none."""

    def resumed_with_page(self, found: ResumableRun) -> ResumableRun:
        """Return the run that is to go on, with a page if it has none."""

    def page_of(self, experiment: Experiment, started: Sequence[str]) -> tuple[str, PlainMapping] | None:
        """Return name and settings of a page among the processes that were started here; None: there is none."""

    def stay(self, folder: Path, name: str, settings: PlainMapping) -> None:
        """Show a run that has ended until Ctrl-C, on the page of this name and these settings."""


def run(
    files: OptionalFiles = None,
    only: Annotated[
        list[str] | None, opt("Start these processes here, and no others.", "--only", metavar="NAME[,NAME…]")
    ] = None,
    without: Annotated[
        list[str] | None, opt("Start all processes here but these.", "--without", metavar="NAME[,NAME…]")
    ] = None,
    runs: Runs = RUNS,
    speed: Speed = None,
    dashboard: Annotated[bool, opt("Show it in the browser, too, if the file doesn't say so.", "--dashboard")] = False,
    resume: Annotated[
        Path | None,
        opt(
            "Go on with a run that was killed or stopped, in its folder (of a folder of runs: the newest).",
            metavar="RUN",
        ),
    ] = None,
    ask: Annotated[
        bool, opt("Ask for sample, person and project first, for the files of the run ([metadata]).", "--ask")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check, say what would be started, and start nothing.")
    ] = False,
    report: Annotated[bool, opt("Write report.html when it has ended.", "--report/--no-report")] = True,
    stay: Annotated[
        bool | None,
        opt("Keep the dashboard when it has ended. Default: in a terminal, until Ctrl-C.", "--stay/--no-stay"),
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Tell details too.")] = False,
) -> None:
    """Run an experiment.

    Everything is checked before anything starts. Processes that crash or freeze are restarted. Ctrl-C ends the
    experiment cleanly, a second one at once. Ends with 0 when the experiment has ended by itself, with 1 when the
    experiment file is wrong or something essential was given up, with 3 when all plans were done and nothing ended the
    experiment, with 4 when the last component with a plan was given up.
    """
    import logging
    import sys
    from dataclasses import replace

    from afspm.cli import metadata_questions
    from afspm.cli.experiment_file import require_no_errors
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
        if files or only or without or speed or dry_run or ask:
            said = "a run is resumed as it was begun: give nothing else, but --dashboard"
            raise typer.BadParameter(said, param_hint="--resume")
        found = resuming.find(resume)
        if dashboard:
            found = _page().resumed_with_page(found)
        as_begun = found.options(options)
        require_no_errors(found.experiment, as_begun.only, as_begun.without)
        ended = resuming.resume(found, options, terminal=sys.stdout)
        _stay(found.experiment, ended, stay)
        raise typer.Exit(ended.outcome.exit_code)
    if not files:
        raise typer.BadParameter("name an experiment file, or a run with --resume", param_hint="FILE")
    experiment = _page().with_page(files) if dashboard else load(*files)
    require_no_errors(experiment, options.only, options.without)
    if dry_run:
        for start in running.dry_run(experiment, options):
            typer.echo(_told(start))
        return
    if ask:
        options = replace(options, metadata=metadata_questions.ask(experiment))
    ended = running.run(experiment, options, terminal=sys.stdout)
    _stay(experiment, ended, stay)
    raise typer.Exit(ended.outcome.exit_code)


def _stay(experiment: Experiment, ended: FinishedRun, wanted: bool | None) -> None:
    """Keep the page of a dashboard that was started here, unless a person has stopped the run."""
    import sys

    from afspm.supervisor.supervision.run_end import EndReason

    started = [report.name for report in ended.outcome.reports if report.starts]
    if ended.outcome.why is EndReason.STOPPED or not (sys.stdout.isatty() if wanted is None else wanted):
        return
    try:
        page = _page()
    except ConfigError as error:  # the run has ended well: its exit code stays
        typer.echo(f"the page does not stay: {error}", err=True)
        return
    if (found := page.page_of(experiment, started)) is not None:
        page.stay(ended.folder, *found)


def _page() -> RunPage:
    page: RunPage | None = entry_points.load(entry_points.PAGES, "dashboard")
    if page is None:
        raise ConfigError("no installed package shows a run in the browser", where=entry_points.PAGES)
    return page


def _told(start: ProcessStart) -> str:
    what = " ".join(start.command) or start.launch.class_
    return f"{start.launch.name} ({start.role.value}): {what}"
