"""Work after the end of a run: notifications, summary and report."""

from __future__ import annotations

import csv
import logging
import math
import os
import signal
import subprocess
import threading
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics import python_environment
from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError, FileError
from afspm.basics.formatting import duration_text
from afspm.basics.interpreter import python_command
from afspm.basics.progress_line import ProgressLine
from afspm.components import notifications
from afspm.components.notifications import END, GIVEN_UP, NotDelivered, Notification, Targets, Way
from afspm.experiment import Role, implied_parts
from afspm.model.events import LOGGED_AS
from afspm.model.requests import LoansInForce
from afspm.night.run import open_run
from afspm.record.journal import JOURNAL_FILE
from afspm.record.run_json import STATE_DIR
from afspm.record.run_lock import quoted, resume_command, unrecorded_message
from afspm.storage import log_folder
from afspm.storage.disk import DiskTimeout, run_bounded
from afspm.supervisor.supervision.run_end import EndReason
from afspm.transport.process import signals
from afspm.wire.messages import LOANS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from afspm.experiment import Experiment, ProcessStart
    from afspm.supervisor.log import RunLog
    from afspm.supervisor.supervisor import RunOutcome

# each of these bounds the wait for a hanging disk, network or program: the terminal returns in any case
REPORT_STALLED_S = 120.0
TOLD_WITHIN_S = 30.0  # for all notifications together
COUNTED_WITHIN_S = 20.0  # for reading the record
TABLE = "metadata.csv"  # written by the component Metadata


@dataclass(frozen=True)
class EndedRun:
    """Name, folder and outcome of a run that has ended."""

    name: str
    folder: Path
    outcome: RunOutcome
    simulated: bool


def follow(
    experiment: Experiment,
    ended: EndedRun,
    starts: Sequence[ProcessStart],
    clock: Clock,
    log: RunLog,
    *,
    with_report: bool,
) -> None:
    """Send the notifications of [notify], then log a summary and write the report.

    Notifications go first, because the rest needs the disk and may take long. If parts run on several computers, only
    the computer with the scheduler sends notifications.
    """
    notify = experiment.resolved.sections.notify
    if any(start.role is Role.SCHEDULER for start in starts):
        tell(ended, implied_parts.targets(notify, experiment.folder), notify.on, clock, log)
    for line in summary(ended.outcome, ended.folder):
        log.write(LOGGED_AS, logging.INFO, line)
    if with_report:
        report(ended.folder, log)


def summary(outcome: RunOutcome, folder: Path) -> list[str]:
    """Return the lines of the summary: reason of the end, processes, restarts, waits given up, measurements, folder."""
    lines = [f"{outcome.text}, after {duration_text(outcome.duration_s)}"]
    lines.append(f"ran: {', '.join(report.name for report in outcome.reports if report.starts)}")
    for report in outcome.reports:
        if (restarts := report.starts - 1 - report.ordered) > 0:
            lines.append(f"{report.name} was restarted {_times(restarts)}")
        if report.ordered:
            lines.append(f"{report.name} was restarted {_times(report.ordered)}, as ordered")
        if report.unfinished:
            lines.append(f"{report.name} was {report.unfinished}")
        if report.given_up:
            lines.append(f"{report.name} was GIVEN UP: {report.last_exit or 'it never started'}")
    if outcome.waits_given_up:
        how_often = _times(outcome.waits_given_up)
        lines.append(f"simulated time went on {how_often} without a process that was behind: scans may be late")
    try:
        lines += run_bounded(lambda: _counts(folder), COUNTED_WITHIN_S)
    except DiskTimeout as error:
        lines.append(f"what was measured can't be counted: {error}")
    lines.append(f"everything is in {folder}")
    if outcome.why is EndReason.PLANS_LOST and _would_fail_again(outcome):
        lines.append("resumed, it would fail again: correct the experiment file, and begin a new run with it")
    elif outcome.why in (EndReason.STOPPED, EndReason.PLANS_LOST):
        lines.append(f"{resume_command(folder)} goes on with it")
    return lines


def _would_fail_again(outcome: RunOutcome) -> bool:
    # a resumed run has the settings with which it began
    given_up = [report for report in outcome.reports if report.given_up]
    return bool(given_up) and all(report.misconfigured for report in given_up)


def _counts(folder: Path) -> list[str]:
    lacking = unrecorded_message(folder, log_folder(folder / STATE_DIR))
    return [*(_counts_of_record(folder) or _counts_of_table(folder / TABLE)), *([lacking] if lacking else [])]


def _counts_of_record(folder: Path) -> list[str]:
    try:
        with open_run(folder) as run:
            whole = sum(not row.interrupted for row in run.scans)
            interrupted, spectra = len(run.scans) - whole, len(run.spectra)
            lent = [thing.loans for _, _, thing in run.messages((LOANS.name,)) if isinstance(thing, LoansInForce)][-1:]
    except FileError:
        return []
    return [
        _measured(whole, spectra) + (f"; {interrupted} interrupted" if interrupted else ""),
        *(f"still in force, and set back when it goes on: {loan.text}" for loans in lent for loan in loans),
    ]


def _counts_of_table(table: Path) -> list[str]:
    # the table has a row a channel; the channels of one scan count as one scan
    try:
        with table.open(encoding="utf-8", newline="") as file:
            rows = {(row.get("measurement"), row.get("time")) for row in csv.DictReader(file)}
    except (OSError, ValueError, csv.Error):
        return []
    counts = Counter(measurement for measurement, _ in rows)
    return [_measured(counts["scan"], counts["spectrum"])]


def _measured(scans: int, spectra: int) -> str:
    return f"measured: {scans} scan{'' if scans == 1 else 's'}, {spectra} spectr{'um' if spectra == 1 else 'a'}"


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def report(
    folder: Path,
    log: RunLog,
    *,
    command: Sequence[str] = (),
    stalled_s: float = REPORT_STALLED_S,
    processor_s: Callable[[int], float] | None = None,
) -> None:
    """Write the report of a recorded run, in a separate process; log a failure.

    A crash of a plotting library then costs the report, not the exit code of the run.

    The process is given up only if it has used no processor for `stalled_s`, as on a disk that hangs: on a busy
    computer the report of a long night takes long.

    Args:
        command: the program that writes it, instead of afspm's own.
        processor_s: returns the processor time that a process has used; None: as the system counts it.
    """
    if not (folder / JOURNAL_FILE).is_file():
        return  # no record, no report
    log.write(LOGGED_AS, logging.INFO, "writing the report …")
    again = f"`afspm report {quoted(folder)}` writes it"
    command = command or [*python_command("afspm.report"), str(folder)]
    environment = {**os.environ, **python_environment(), "MPLBACKEND": "agg"}
    stop = _Stop()
    try:
        with signals.caught(stop, -1), ProgressLine("writing the report"):
            exit_code, output = _until_done(command, environment, stop, stalled_s, processor_s or _processor_s)
    except _Stopped as stopped:
        log.write(LOGGED_AS, logging.WARNING, f"no report: {stopped} came while it was written; {again}")
        if stopped.number == signal.SIGINT:
            raise KeyboardInterrupt from None
        signal.raise_signal(stopped.number)
        return
    except subprocess.TimeoutExpired:
        stalled = f"its process has not worked for {stalled_s:g} s, as if the disk did not answer"
        log.write(LOGGED_AS, logging.WARNING, f"no report: {stalled}; {again}")
        return
    except OSError as error:
        log.write(LOGGED_AS, logging.WARNING, f"no report: {error}")
        if stop.came is not None:
            signal.raise_signal(stop.came)
        return
    if exit_code:
        lines = output.decode(errors="replace").strip().splitlines()
        log.write(LOGGED_AS, logging.WARNING, f"no report: {lines[-1] if lines else f'exit code {exit_code}'}")
    else:
        from afspm.report import REPORT_FILE

        log.write(LOGGED_AS, logging.INFO, f"the report is {folder / REPORT_FILE}")


class _Stopped(BaseException):
    """Not an Exception, so that no broad `except` takes it for an error of the report."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class _Stop:
    """Raises `_Stopped` for a signal; for one that comes while the process is being started, once it can be killed."""

    def __init__(self) -> None:
        self._is_started = False
        self.came: int | None = None

    def __call__(self, number: int) -> None:
        if self._is_started:
            raise _Stopped(number)
        self.came = number

    def started(self) -> None:
        self._is_started = True
        if self.came is not None:
            raise _Stopped(self.came)


def _until_done(
    command: Sequence[str],
    environment: Mapping[str, str],
    stop: _Stop,
    stalled_s: float,
    processor_s: Callable[[int], float],
) -> tuple[int, bytes]:
    # raises TimeoutExpired once the process has used no processor for `stalled_s`
    none, pipe = subprocess.DEVNULL, subprocess.PIPE
    with subprocess.Popen(command, stdin=none, stdout=none, stderr=pipe, env=environment) as process:
        used_s = -1.0
        while True:
            try:
                stop.started()
                _, errors = process.communicate(timeout=stalled_s)
                return process.returncode, errors
            except subprocess.TimeoutExpired:
                before_s, used_s = used_s, processor_s(process.pid)
                if used_s <= before_s:
                    process.kill()
                    raise
            except BaseException:  # Ctrl-C must not leave the process behind
                process.kill()
                raise


def _processor_s(pid: int) -> float:
    import psutil

    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.Error:
        return math.inf  # it has just ended: `communicate` has its result
    return float(times.user + times.system)


def tell(ended: EndedRun, targets: Targets, on: tuple[str, ...], clock: Clock, log: RunLog) -> None:
    """Notify of the run's end, if `on` includes the occasion; retry failed deliveries for half a minute."""
    is_lost = ended.outcome.why in (EndReason.LOST, EndReason.PLANS_LOST)
    what = GIVEN_UP if is_lost and GIVEN_UP in on else END
    if what not in on:
        return
    notice = Notification(
        what, ended.name, str(ended.folder), clock.now_ns(), _text(ended.outcome), simulated=ended.simulated
    )
    until_s = clock.monotonic_s() + TOLD_WITHIN_S
    for way in targets.ways:
        _tell(notice, targets, way, clock, until_s, log)


def _tell(notice: Notification, targets: Targets, way: Way, clock: Clock, until_s: float, log: RunLog) -> None:
    tries = 0
    while True:
        try:
            targets.deliver(notice, way)
            return
        except ConfigError as error:
            log.write(LOGGED_AS, logging.ERROR, f"the {way} failed: {error}")
            return
        except NotDelivered as error:
            tries += 1
            delay_s = notifications.delay_s(tries)
            if clock.monotonic_s() + delay_s >= until_s:
                log.write(LOGGED_AS, logging.ERROR, f"the {way} failed: {error}")
                return
        threading.Event().wait(delay_s)


def _text(outcome: RunOutcome) -> str:
    given_up = [report.name for report in outcome.reports if report.given_up]
    return outcome.text + (f"; given up: {', '.join(given_up)}" if given_up else "")
