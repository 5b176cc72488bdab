"""`afspm run`, `demo` and `trace`: run an experiment."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Protocol

import typer

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
from afspm.cli.arguments import RUNS, Files, OptionalFiles, Runs, Speed, names_in, opt
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.basics.plain_data import PlainMapping
    from afspm.experiment import Experiment, ProcessStart
    from afspm.experiment.resolved_experiment import ResolvedExperiment
    from afspm.supervisor import ResumableRun
    from afspm.supervisor.run import FinishedRun

_QUESTIONS: Final = {
    "sample": "Sample",
    "person": "Your name",
    "orcid": "Your ORCID iD",
    "project": "Project",
    "probe": "Probe, as `afspm probes` lists it",
    "technique": "Technique (STM, STS or AFM)",
}
_SIMULATOR, _PAPERS_METHOD = "simulator", "paper"
_TIP_REPAIR_NIGHT = (
    "A simulated night, planned for eight hours: the tip changes three times, and is repaired. Two minutes."
)
_DRIFT_NIGHT = "A simulated night of eighteen hours on a sample that drifts by micrometres. Three to five minutes."


class RunPage(Protocol):
    """Interface of a module that shows runs in the browser."""

    def with_page(self, files: list[Path]) -> Experiment:
        """Return the experiment of these files, with a web page added if the files have none."""

    def resumed_with_page(self, found: ResumableRun) -> ResumableRun:
        """Return the run to resume, with a web page added if the run has none."""

    def page_of(self, experiment: Experiment, started: Sequence[str]) -> tuple[str, PlainMapping] | None:
        """Return name and settings of the web page among the processes started here; None if there is no page."""

    def stay(self, folder: Path, name: str, settings: PlainMapping) -> None:
        """Show an ended run until Ctrl-C, on a web page with this name and these settings."""


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
        bool, opt("Ask for sample, person, project and probe first, for the files of the run ([metadata]).", "--ask")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check, list the processes to start, and start none.")
    ] = False,
    report: Annotated[bool, opt("Write report.html when it has ended.", "--report/--no-report")] = True,
    stay: Annotated[
        bool | None,
        opt("Keep the dashboard when it has ended. Default: in a terminal, until Ctrl-C.", "--stay/--no-stay"),
    ] = None,
    feedback_off: Annotated[bool, opt("The z feedback is off because you want it so.", "--feedback-off")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show details, too.")] = False,
) -> None:
    """Run an experiment.

    Everything is checked before anything starts. Processes that crash or freeze are restarted. Ctrl-C ends the
    experiment cleanly, a second Ctrl-C at once. Ends with 0 when the experiment has ended by itself, even if a
    component was given up; with 1 when the experiment file is wrong or something essential was given up; with 3 when
    all plans were done and nothing ended the experiment; with 4 when the last component with a plan was given up; with
    130 when the run was stopped.
    """
    import logging
    import sys
    from dataclasses import replace

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
        feedback_off=feedback_off,
        log_level=logging.DEBUG if verbose else logging.INFO,
    )
    if resume is not None:
        if files or only or without or speed or dry_run or ask:
            others = "--dashboard and --feedback-off"
            refusal = f"a run is resumed as it was started: of other options only {others} are possible"
            raise typer.BadParameter(refusal, param_hint="--resume")
        found = resuming.find(resume)
        if dashboard:
            found = _page().resumed_with_page(found)
        as_begun = found.options(options)
        require_no_errors(found.experiment, as_begun.only, as_begun.without)
        ended = resuming.resume(found, options, terminal=sys.stdout)
        _keep_page(found.experiment, ended, stay)
        raise typer.Exit(ended.outcome.exit_code)
    if not files:
        raise typer.BadParameter("name an experiment file, or a run with --resume", param_hint="FILE")
    experiment = _page().with_page(files) if dashboard else load(*files)
    require_no_errors(experiment, options.only, options.without)
    if dry_run:
        for start in running.dry_run(experiment, options):
            typer.echo(_described(start))
        return
    _require_limits(experiment, options.only, options.without)
    if ask:
        options = replace(options, metadata=ask_metadata(experiment))
    ended = running.run(experiment, options, terminal=sys.stdout)
    _keep_page(experiment, ended, stay)
    raise typer.Exit(ended.outcome.exit_code)


def _require_limits(experiment: Experiment, only: Collection[str], without: Collection[str]) -> None:
    # a person has set limits for a real controller, or wants none
    import sys

    from afspm.cli import contacting, examination
    from afspm.experiment.process_starts import chosen_names

    resolved = experiment.resolved
    kind, settings = resolved.driver()
    given = dict(resolved.document.data.get("limits", {}))
    is_said = given.pop("none", False) or given or resolved.default_limits.sources()
    chosen = chosen_names(resolved, only, without)
    is_here = any(translator.name in chosen for translator in resolved.with_role(Role.TRANSLATOR))
    if kind is None or is_said or not is_here or experiment.simulated(only, without):
        return
    if not sys.stdin.isatty():
        what = "no limits are set for a real controller"
        hint = "`afspm new instrument` proposes some; or say that you want none: [limits] none = true"
        raise ConfigError(what, where=str(experiment.files[0]), hint=hint)
    examination.show(contacting.asked(kind, settings)[1])
    typer.confirm("No limits are set ([limits]): nothing that a component asks for is refused. Run?", abort=True)


def _keep_page(experiment: Experiment, ended: FinishedRun, wanted: bool | None) -> None:
    import sys

    from afspm.supervisor.supervision.run_end import EndReason

    started = [report.name for report in ended.outcome.reports if report.starts]
    # without a terminal (a service, a script) no person could press Ctrl-C, and the run would never end
    if ended.outcome.why is EndReason.STOPPED or not (sys.stdout.isatty() if wanted is None else wanted):
        return
    try:
        page = _page()
    except ConfigError as error:  # the run has ended well: its exit code stays
        typer.echo(f"the page can't be kept open: {error}", err=True)
        return
    if (found := page.page_of(experiment, started)) is not None:
        page.stay(ended.folder, *found)


def _page() -> RunPage:
    page: RunPage | None = entry_points.load(entry_points.PAGES, "dashboard")
    if page is None:
        raise ConfigError("no installed package shows a run in the browser", where=entry_points.PAGES)
    return page


def _described(start: ProcessStart) -> str:
    what = " ".join(start.command) or start.launch.class_
    return f"{start.launch.name} ({start.role.value}): {what}"


def ask_metadata(experiment: Experiment) -> dict[str, str]:
    """Ask the user for the entries of [metadata]; the defaults are from the file and the microscope's class."""
    known = experiment.resolved.metadata()
    return {name: answer for name, text in _QUESTIONS.items() if (answer := _answer(name, text, known.get(name, "")))}


def _answer(name: str, text: str, known: str) -> str:
    import pydantic

    from afspm.experiment.sections import MetadataSection

    while answer := typer.prompt(text, default=known, show_default=bool(known)).strip():
        try:
            return str(getattr(MetadataSection.model_validate({name: answer}), name))
        except pydantic.ValidationError as error:
            typer.echo(f"  {error.errors()[0]['msg'].removeprefix('Value error, ')}")
    return ""


def demo(
    drift: Annotated[bool, typer.Option("--drift", help="The night on a sample that drifts.")] = False,
    on: Annotated[
        str, typer.Option("--on", help="With --drift: another microscope, e.g. asylum: an emulated controller.")
    ] = "",
    runs: Runs = RUNS,
    dashboard: Annotated[bool, typer.Option("--dashboard", help="Show it in the browser, too.")] = False,
) -> None:
    """Show a simulated night: the tip changes, the change is detected, and the tip is repaired.

    Nothing but afspm is needed. The night leaves a folder with its scans, a picture and `report.html`.
    """
    files = [_sample("tip_repair") / "experiment.toml"] if not drift else _drift_night(on or _SIMULATOR)
    if on and not drift:
        raise ConfigError("--on chooses the microscope of the night with --drift", hint="add --drift")
    typer.echo(_DRIFT_NIGHT if drift else _TIP_REPAIR_NIGHT)
    typer.echo(f"It leaves a folder in {runs}, with report.html. Ctrl-C ends it early.")
    run(files, runs=runs, dashboard=dashboard)


def _drift_night(microscope: str) -> list[Path]:
    night = _sample("drift_night") / "experiment.toml"
    there = sorted(file.stem for file in night.parent.glob("*.toml") if file.stem not in (night.stem, _PAPERS_METHOD))
    if microscope not in there:
        raise ConfigError(f"there is no night on {microscope!r}", where="--on", hint=f"one of {', '.join(there)}")
    return [night, night.with_name(f"{microscope}.toml")]


def _sample(name: str) -> Path:
    # in a wheel samples lie in the package, in a clone in `experiments`
    package = Path(__file__).parents[1]
    installed = package / "samples" / name
    return installed if installed.is_dir() else package.parents[1] / "experiments" / name


def trace(
    files: Files,
    runs: Runs = RUNS,
    speed: Speed = None,
) -> None:
    """Run an experiment, and record all traffic with the controller.

    The trace is one file in the run's folder; it includes the files that the controller saved, and no secrets. Attach
    it to a bug report: `afspm emulate --replay` plays it back. `afspm run` does the same with `trace = true` in the
    translator's section.
    """
    import sys

    from afspm.cli.experiment_file import require_no_errors
    from afspm.supervisor import run as running
    from afspm.translator.trace import FILE

    experiment = _with_trace(files)
    require_no_errors(experiment, (), ())
    ended = running.run(experiment, running.RunOptions(runs=runs, speed=speed), terminal=sys.stdout)
    file = ended.folder / FILE
    typer.echo(f"the trace: {file}" if file.exists() else "no trace: nothing was sent to the controller")
    raise typer.Exit(ended.outcome.exit_code)


def _with_trace(files: list[Path]) -> Experiment:
    from afspm.experiment.tracing import trace_overlay

    def overlay(resolved: ResolvedExperiment, folder: Path) -> Path:
        found = trace_overlay(resolved, folder)
        if found is None:
            raise ConfigError("no translator here talks to a controller: nothing to trace", where=str(files[0]))
        return found

    return with_overlay(files, overlay)


def with_overlay(files: list[Path], overlay: Callable[[ResolvedExperiment, Path], Path]) -> Experiment:
    import tempfile

    from afspm.experiment import load

    with tempfile.TemporaryDirectory() as folder:
        return load(*files, overlay(load(*files).resolved, Path(folder)))
