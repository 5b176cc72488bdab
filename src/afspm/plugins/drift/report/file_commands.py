"""`afspm drift FILE…`: read scans, track drift on all cores with progress bars, print and write the results."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from afspm import open_run, read
from afspm.basics import NS_PER_S, AfspmError, FileError, InvalidValue, ProgressLine, counted, day_and_time
from afspm.components import Array, suffixes
from afspm.driver import FileContent
from afspm.model import RegistrationOutcome
from afspm.plugins.drift.estimators import estimator
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.plugins.drift.report.simulated_truth import true_drift
from afspm.plugins.drift.track import tracker
from afspm.plugins.drift.track.offline import Stack, against_first, corrected, followed
from afspm.plugins.drift.track.record import DriftRecord
from afspm.plugins.drift.track.scan_series import Series, series
from afspm.plugins.drift.workers import on_cores, processes
from afspm.record import JOURNAL_FILE, MEASURED_SUFFIX

NM = 1e9
NM_PER_MIN = 60e9
_SCANS_OF_A_RUN = "scans"


@dataclass(frozen=True, eq=False)
class Analysis:
    """Result for all scans of one channel.

    Attributes:
        record: drift record of the tracker.
        pairs: registrations of the first scan with each later scan.
        estimates: drift record of the pairs.
    """

    record: DriftRecord
    pairs: tuple[Registration, ...]
    estimates: DriftRecord


def run(
    paths: Sequence[Path], channel: str, by: str, following: str, output: Path, jobs: int | None, *, quiet: bool
) -> None:
    """Analyse files, print the table, and write the results.

    Raises:
        InvalidValue: no file can be analysed. ConfigError: the estimator or tracker is unknown. FileError: as
            `written`.
    """
    console, aside = Console(file=sys.stdout, highlight=False), Console(stderr=True, highlight=False)
    with ProgressLine("reading the files", quiet=quiet):
        contents, unreadable = read_all(paths)
    for reason in unreadable:
        aside.print(f"left out: {reason}", markup=False, soft_wrap=True)
    if not contents:
        raise InvalidValue("there is nothing to follow: no file was read", hint="name scans, or folders of them")
    found = series(contents, channel)
    for reason in found.left_out:
        aside.print(f"left out: {reason}", markup=False, soft_wrap=True)
    begun = day_and_time(round(found.scans[0].mid_s * NS_PER_S), UTC, seconds=False)
    console.print(f"{counted(len(found.scans), 'scan')} of {found.channel} from {begun} on", markup=False)
    analysis = analysed(found.scans, by, following, jobs, aside, quiet=quiet)
    console.print(as_table(analysis.record))
    console.print(analysis.record.summary())
    truth_m = true_drift(paths[0], found.scans) if len(paths) == 1 else None  # only a single run has one truth
    changed = tip_changed(paths, found.scans)
    if "yes" in changed:
        since = Path(found.scans[changed.index("yes")].key).name
        console.print(
            f"the tip changed before {since}: from there on its shift of the image is in the drift", markup=False
        )
    with ProgressLine("drawing the figures", quiet=quiet):
        files = list(written(found, analysis, truth_m, changed, output, aside))
    for path in files:
        console.print(str(path), markup=False, soft_wrap=True)


def read_all(paths: Sequence[Path]) -> tuple[list[FileContent], list[str]]:
    """Return the contents of files and folders, and an error text for each unreadable file."""
    contents: list[FileContent] = []
    unreadable: list[str] = []
    for path in _files(paths):
        try:
            contents.append(read(path))
        except AfspmError as error:
            unreadable.append(str(error))
    return contents, unreadable


def _files(paths: Sequence[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        folder = path / _SCANS_OF_A_RUN if (path / _SCANS_OF_A_RUN).is_dir() else path
        found = sorted(file for file in folder.rglob("*") if file.is_file() and file.suffix.lower() in suffixes())
        of_the_controller = [file for file in found if file.suffix != MEASURED_SUFFIX]
        # the record contains the same scans again, with places in sample coordinates where drift was corrected
        yield from of_the_controller if (path / JOURNAL_FILE).exists() and of_the_controller else found


def register_pair(by: str, reference: DriftScan, scan: DriftScan) -> Registration:
    """Register two scans with the named estimator; a module-level function, so that worker processes can import it."""
    return estimator(by).register(reference, scan)


def analysed(
    scans: Sequence[DriftScan], by: str, following: str, jobs: int | None, console: Console, *, quiet: bool
) -> Analysis:
    """Track drift through the scans, and register each later scan with the first in parallel.

    The tracker runs in this process. Registrations run in other processes, or with a single job in a thread.
    """
    tracking = tracker(following, estimator(by))
    wanted = processes(jobs, sum(scan.values.size for scan in scans))
    others = 1 if wanted == 1 else max(wanted - 1, 2)  # processes that register pairs; 1: this process
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=console, transient=True, disable=quiet) as progress,
        ThreadPoolExecutor(1) as beside,
    ):
        track = progress.add_task("followed", total=len(scans))
        pair = progress.add_task("compared with the first", total=len(scans) - 1)
        work = beside.submit(_pairs, scans, by, others, lambda: progress.advance(pair))
        updates = []
        for update in followed(scans, tracking):
            updates.append(update)
            progress.advance(track)
        pairs = work.result()
    record = DriftRecord.of(scans, updates)
    return Analysis(record, pairs, against_first(record, scans, pairs))


def _pairs(scans: Sequence[DriftScan], by: str, jobs: int, done: Callable[[], None]) -> tuple[Registration, ...]:
    tasks = [(by, scans[0], scan) for scan in scans[1:]]
    pairs = [Registration.refused("")] * len(tasks)
    for outcome in on_cores(register_pair, tasks, jobs=jobs):
        pairs[outcome.index] = Registration.failed(outcome.error) if outcome.error else outcome.value
        done()
    return tuple(pairs)


def as_table(record: DriftRecord) -> Table:
    """Return the record as a table: hours since the first scan, drift and its uncertainty in nm, rates in nm/min."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("scan", no_wrap=True, max_width=24)
    for name in ("h", "x / nm", "y / nm", "± sd", "nm/min x", "y"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("accepted", overflow="fold", min_width=16)
    hours = (record.time_s - record.time_s[0]) / 3600.0
    for k, key in enumerate(record.keys):
        numbers = (*record.drift_m[k] * NM, record.sd_m[k].max() * NM, *record.rate_m_s[k] * NM_PER_MIN)
        texts = (f"{value:.2f}" if abs(value) < 1e5 else f"{value:.1e}" for value in numbers)
        outcome = record.outcomes[k]
        accepted = "yes" if record.matched[k] else "no"
        if outcome is not RegistrationOutcome.REGISTERED:
            accepted += f", {outcome.label}: {record.reasons[k]}"
        table.add_row(Path(key).name, f"{hours[k]:.2f}", *texts, accepted)
    return table


def tip_changed(paths: Sequence[Path], scans: Sequence[DriftScan]) -> list[str]:
    """Return for each scan whether the tip has changed since the first: "yes", "no", or "" if unknown.

    Only the record of a run shows it: files of a controller do not show what happened between them.
    """
    if len(paths) != 1 or not (paths[0] / JOURNAL_FILE).exists():
        return [""] * len(scans)
    with open_run(paths[0]) as run:
        changes_ns = run.tip_changes_ns()
        # by the names of files: the clocks of controller and run may differ
        ended_ns = {Path(file).name: row.time_ns for row in run.scans for file in (row.filename, row.file) if file}
    first_ns, *_ = times_ns = [ended_ns.get(Path(scan.key).name) for scan in scans]
    if first_ns is None:
        return [""] * len(scans)
    since_ns = next((at_ns for at_ns in changes_ns if at_ns > first_ns), math.inf)
    return ["" if end_ns is None else "yes" if end_ns >= since_ns else "no" for end_ns in times_ns]


def written(
    found: Series, analysis: Analysis, truth: Array | None, changed: Sequence[str], folder: Path, console: Console
) -> Iterator[Path]:
    """Write the results, and yield the path of each file; print the reason if there is no stack.

    Raises:
        FileError: the folder or a file can't be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"can't be made: {error.strerror or error}", where=str(folder)) from error
    analysis.record.write(folder / "drift.csv", changed)
    yield folder / "drift.csv"
    analysis.estimates.write(folder / "drift_estimates.csv", changed)
    yield folder / "drift_estimates.csv"
    try:
        _stack(found, analysis.record).write(folder / "drift_stack.nc", channel=found.channel, unit=found.unit)
        yield folder / "drift_stack.nc"
    except InvalidValue as error:
        console.print(f"no stack: {error}", markup=False, soft_wrap=True)
    from afspm.plugins.drift.report import album

    part = album.RunPart("", found.channel, 0, len(found.scans), analysis.estimates)
    matched = next(((0, k, one) for k, one in enumerate(analysis.pairs, 1) if one.accepted and one.matches), None)
    yield from album.write(
        album.DriftRun(found.scans, analysis.record, [part], matched, truth, truth is not None), folder
    )


def _stack(found: Series, record: DriftRecord) -> Stack:
    # only registered scans: the position of the others is a prediction
    which = np.flatnonzero(record.matched)
    return corrected([found.scans[k] for k in which], record.drift_m[which], record.rate_then_m_s[which])
