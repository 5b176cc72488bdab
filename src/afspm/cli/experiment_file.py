"""`afspm check`, `graph`, `doctor`, `keys` and `notify`: work on an experiment file before a run."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

from afspm.basics.formatting import counted, duration_text, quantity
from afspm.basics.plain_data import Plain
from afspm.cli.arguments import RUNS, Files, OptionalFiles, Quiet, Runs, opt

if TYPE_CHECKING:
    from rich.console import Console

    from afspm.cli.examination import Examination
    from afspm.components import PlannedWork
    from afspm.components.notifications import Notification, Targets, Way
    from afspm.experiment import Experiment, Finding


def check(
    files: Files,
    expanded: Annotated[bool, typer.Option("--expanded", help="Print the whole file, with all defaults.")] = False,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Convert a file of another form, such as the published one, and explain each line.",
        ),
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="For programs: a list of findings, each with level, file, line, what and hint."),
    ] = False,
) -> None:
    """Find every error of an experiment file, before anything starts.

    Shows file, line, error and remedy. Ends with 1 if there are errors; warnings alone end with 0.
    """
    from rich.console import Console

    from afspm.experiment import load
    from afspm.experiment.setting_notes import SettingNotes

    experiment = load(*files)
    findings = experiment.check()
    if as_json:
        typer.echo(json.dumps([_finding_as_json(one) for one in findings], ensure_ascii=False, indent=2))
        raise typer.Exit(1 if any(finding.is_error for finding in findings) else 0)
    console = Console(stderr=expanded or explain, highlight=False)
    if explain and experiment.is_readable:
        _explain(experiment, console)
    show(findings, console)
    if expanded:
        typer.echo(experiment.expanded(), nl=False)
    if experiment.is_readable:
        for line in experiment.resolved.default_limits.lines():
            console.print(line, markup=False, soft_wrap=True)
        console.print(_summary(experiment, findings), markup=False, soft_wrap=True)
        if not any(finding.is_error for finding in findings):
            for line in estimate_lines(
                experiment.planned_work(), experiment.clock().speed, datetime.now(UTC), experiment.order()
            ):
                console.print(line, markup=False, soft_wrap=True)
            for line in experiment.notes():
                console.print(line, markup=False, soft_wrap=True)
            show(SettingNotes(experiment.resolved).all(), console)
    if any(finding.is_error for finding in findings):
        raise typer.Exit(1)


def _finding_as_json(finding: Finding) -> Plain:
    place = finding.place
    return {
        "level": finding.level.value, "file": place.file, "line": place.line or None, "what": finding.what,
        "hint": finding.hint,
    }  # fmt: skip


def _explain(experiment: Experiment, console: Console) -> None:
    from afspm.experiment.forms import all_forms

    for form in all_forms()[0]:
        for place, line, became in form.explained(experiment.resolved):
            console.print(f"{place}: {line}: {became}", markup=False, emoji=False, soft_wrap=True)
        typer.echo(form.short(experiment.resolved), nl=False)


def show(findings: Sequence[Finding], console: Console) -> None:
    """Print each finding as a paragraph, with colours on a terminal."""
    from rich.text import Text

    for finding in findings:
        colour = "bold red" if finding.is_error else "yellow"
        line = Text.assemble((str(finding.place), "bold"), ": ", (f"{finding.level.value}: ", colour), finding.what)
        if finding.hint:
            line.append(f"\n    {finding.hint}", "dim")
        console.print(line, soft_wrap=True)  # a wrapped line could not be clicked or searched


def require_no_errors(experiment: Experiment, only: Collection[str] = (), without: Collection[str] = ()) -> None:
    """Print errors and warnings for the processes started here. Raises typer.Exit if there are errors."""
    findings = experiment.check(only, without)
    if findings:
        from rich.console import Console

        show(findings, Console(stderr=True, highlight=False))
    if any(finding.is_error for finding in findings):
        raise typer.Exit(1)


def _summary(experiment: Experiment, findings: Sequence[Finding]) -> str:
    errors = sum(finding.is_error for finding in findings)
    warnings = len(findings) - errors
    count = len(experiment.component_names)
    told = [f"{n} {word}{'s' if n != 1 else ''}" for n, word in ((errors, "error"), (warnings, "warning")) if n]
    return f"{experiment.name}: {count} process{'es' if count != 1 else ''}, {', '.join(told) or 'nothing wrong'}"


def graph(
    files: Files,
    output: Annotated[Path | None, opt("The SVG file to write. Default: named as the experiment.", "--output", "-o")]
    = None,
) -> None:  # fmt: skip
    """Draw the components, sockets and envelopes of an experiment as SVG."""
    from afspm.basics.errors import FileError
    from afspm.experiment import load
    from afspm.experiment.graph import draw

    experiment = load(*files)
    experiment.require_valid()
    target = output or Path(f"{experiment.name}.svg")
    try:
        target.write_text(draw(experiment), encoding="utf-8")
    except OSError as error:
        raise FileError(f"the picture can't be written: {error.strerror or error}", where=str(target)) from error
    typer.echo(target)


def keys(
    files: Files,
    folder: Annotated[
        Path | None, opt("Where to put them. Default: [security] keys of the file, else keys/ beside it.", "--folder")
    ] = None,
    also: Annotated[list[str] | None, opt("A person who gets a key. Repeatable.", "--also", metavar="NAME")] = None,
    quiet: Quiet = False,
) -> None:
    """Make a key pair for each process of an experiment, for the supervisors, and for the people named.

    Existing keys are kept. Copy public/ to every computer, and of private/ only the keys of the processes that run
    there.
    """
    from afspm.experiment import load
    from afspm.model.events import SUPERVISOR
    from afspm.transport.keys import generate

    experiment = load(*files)
    target = folder or experiment.keys_folder or experiment.folder / "keys"
    written = generate(target, [*experiment.component_names, SUPERVISOR, *(also or ())])
    if quiet:
        return
    for file in written:
        typer.echo(file)
    if not written:
        typer.echo(f"all keys are there already, in {target}")
    if experiment.keys_folder is None:
        typer.echo(f'to use them: [security] keys = "{target.name}"')


def notify(
    files: Files, test: Annotated[bool, typer.Option("--test", help="Send a test message by each of them.")] = False
) -> None:
    """List the notifications of [notify] in an experiment file; with --test, send a test message by each.

    Ends with 1 if there are none, or if a test message does not arrive.
    """
    from afspm.experiment import implied_parts, load

    experiment = load(*files)
    require_no_errors(experiment)
    section = experiment.resolved.sections.notify
    targets = implied_parts.targets(section, experiment.folder)
    if not targets.ways and not section.ping:
        typer.echo("afspm: the file has no [notify] with a `command`, a `webhook` or a `ping`", err=True)
        raise typer.Exit(1)
    if not test:
        if targets.ways:
            typer.echo(f"{' and '.join(targets.ways)}, on {', '.join(section.on)}; --test sends a message")
        if section.ping:
            typer.echo(f"a ping every {duration_text(section.every)}; --test sends one")
        return
    arrived = [_arrives(targets, _message(experiment), way) for way in targets.ways]
    if section.ping:
        arrived.append(_pings(section.ping))
    if not all(arrived):
        raise typer.Exit(1)


def _message(experiment: Experiment) -> Notification:
    from afspm.basics.clock import ExperimentClock
    from afspm.components.notifications import TEST, Notification

    now_ns = ExperimentClock.real().now_ns()
    return Notification(TEST, experiment.name, "", now_ns, "a test message of afspm: calls from this experiment arrive")


def _pings(where: str) -> bool:
    from afspm.basics.errors import ConfigError
    from afspm.components.notifications import NotDelivered, address, ping

    try:
        ping(address(where, key="ping"))
    except (ConfigError, NotDelivered) as error:
        typer.echo(f"the ping failed: {error}", err=True)
        return False
    typer.echo("the ping was answered")
    return True


def _arrives(targets: Targets, message: Notification, way: Way) -> bool:
    from afspm.basics.errors import ConfigError
    from afspm.components.notifications import NotDelivered

    try:
        targets.deliver(message, way)
    except (ConfigError, NotDelivered) as error:
        typer.echo(f"the {way} failed: {error}", err=True)
        return False
    typer.echo(f"the {way} took the message")
    return True


COMPUTING_S = 0.1
"""Real time between two scans without a period: 0.04 to 0.14 s, measured on an idle computer of two cores."""


def estimate_lines(
    works: Mapping[str, PlannedWork | None],
    speed: float,
    now: datetime,
    order: Mapping[str, Sequence[str]] | None = None,
) -> Iterator[str]:
    """Yield a line about the planned work of each component, then a line about the expected end if it is known.

    Args:
        speed: experiment seconds per real second.
        now: start of the experiment, real time.
        order: the components after which each component begins.
    """
    from afspm.model.planned_work import planned_end_s

    for name, work in works.items():
        after = f", after {' and '.join(before)}" if (before := (order or {}).get(name)) else ""
        yield (
            f"how long {name} works is not known: its class does not plan its work{after}"
            if work is None
            else f"{name} plans {work_text(work)}{after}"
        )
    end_s = planned_end_s(works.values())
    if end_s is None:
        return
    planned = [work for work in works.values() if work is not None]
    bound = "at the latest about" if any(work.at_most for work in planned) else "about"
    end = now + timedelta(seconds=end_s / speed)
    real = f", {duration_text(end_s / speed)} real" if speed != 1.0 else ""
    computing = "" if speed <= 1.0 else f"; at {speed:g} x also without computing, about {COMPUTING_S:g} s real a scan"
    yield (
        f"started now it would end {bound} {end.astimezone():%Y-%m-%d %H:%M} ({duration_text(end_s)}{real}),"
        f" without repairs, rescans and waiting for control{computing}"
    )


def work_text(work: PlannedWork) -> str:
    """Return the planned work of a component as one line of text."""
    parts = []
    if work.scans is None:
        parts.append("scans without end")
    elif work.scans:
        parts.append(counted(work.scans, "scan"))
    if work.spectra:
        parts.append(counted(work.spectra, "spectrum", "spectra"))
    if work.path_m:
        parts.append(f"{quantity(work.path_m, 'm', 3)} scanned")
    if work.bytes_a_channel:
        parts.append(f"{work.bytes_a_channel / 1e6:.3g} MB a channel before compression")
    if work.scans:
        beside = " beside the spectra" if work.spectra else ""
        took = "unknown duration" if work.duration_s is None else duration_text(work.duration_s)
        parts.append(took + beside)
    bound = "at most " if work.at_most else ""
    return bound + ", ".join(parts) + (f" ({work.why})" if work.why else "")


def doctor(
    context: typer.Context,
    files: OptionalFiles = None,
    runs: Runs = RUNS,
    listen: Annotated[float, opt("Seconds to listen to published packets.", "--listen", min=0.1)] = 3.0,
    on: Annotated[str, opt("Only ask the controller of this maker, e.g. nanonis.", "--on", metavar="MAKER")] = "",
    at: Annotated[str, opt("Its address; without it, the maker's usual one.", "--at", metavar="ADDRESS")] = "",
    everything: Annotated[bool, opt("List all parameters, and what all packages add to afspm.", "--all")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Find the faults of an experiment, seen from this computer, with remedies.

    A real controller is asked for its release, range, preamplifier, bias, setpoint … Questions are all
    that is sent to it. Checks names, ports, keys, clocks, versions, disk and memory, and the packets of the scheduler.
    Works before the experiment runs, while it runs, and when a part of it does not. Shows why a driver, component,
    reader … of an installed package can't be loaded. Without a file only this computer is checked. Ends with 1 if
    something keeps the experiment from working.
    """
    from afspm.cli import contacting, examination
    from afspm.experiment import load
    from afspm.experiment.shadow import driver_of

    if (at and not on) or (on and files):
        raise typer.BadParameter("name a file, or a maker with --on and perhaps --at", param_hint="--on")
    if on:
        settings = {"address": at} if at else {}
        examined = examination.Examination(contacting.asked(driver_of(on)[1], settings, everything=everything)[1])
    else:
        experiment = load(*files) if files else None
        examined = examination.examine(experiment, runs, listen, _commands(context), everything=everything)
    if as_json:
        typer.echo(json.dumps(_as_json(examined), indent=2, ensure_ascii=False))
    else:
        _show(examined, everything=everything)
    if not examined.is_well:
        raise typer.Exit(1)


def _commands(context: typer.Context) -> Collection[str]:
    root = context.find_root().command
    return root.commands.keys() if isinstance(root, TyperGroup) else ()


def _as_json(examined: Examination) -> dict[str, object]:
    found = [{**dataclasses.asdict(one), "severity": one.severity.value} for one in examined.found]
    heard = [{**dataclasses.asdict(one), "rate_hz": one.rate_hz} for one in examined.heard]
    return {"is_well": examined.is_well, "found": found, "heard": heard}


def _show(examined: Examination, *, everything: bool) -> None:
    from afspm.cli.examination import show

    for heard in examined.heard:
        told = f"packets {heard.envelope}: {heard.rate_hz:.2g} a second, {heard.bytes_per_s / 1000:.3g} kB/s"
        typer.echo(told)
    show(examined.found, everything=everything)
