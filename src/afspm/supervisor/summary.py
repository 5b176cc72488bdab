"""What is said at the end of a run."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.errors import FileError
from afspm.formatting import duration_text
from afspm.logic.supervision.run_end import EndReason
from afspm.record.run import open_run
from afspm.record.run_lock import resume_command
from afspm.storage.disk import DiskTimeout, run_bounded

if TYPE_CHECKING:
    from afspm.supervisor.supervisor import RunOutcome

COUNTED_WITHIN_S = 20.0
TABLE = "metadata.csv"  # of the component Metadata


def lines(outcome: RunOutcome, folder: Path) -> list[str]:
    """The summary: why it ended, what ran, what had to be restarted or was given up, where everything is."""
    told = [f"{outcome.text}, after {duration_text(outcome.duration_s)}"]
    told.append(f"ran: {', '.join(report.name for report in outcome.reports if report.starts)}")
    for report in outcome.reports:
        if (restarts := report.starts - 1 - report.ordered) > 0:
            told.append(f"{report.name} was restarted {_times(restarts)}")
        if report.ordered:
            told.append(f"{report.name} was started anew {_times(report.ordered)}, as ordered")
        if report.given_up:
            told.append(f"{report.name} was GIVEN UP: {report.last_exit or 'it never started'}")
    try:
        told += run_bounded(lambda: _recorded(folder) or _tabled(folder / TABLE), COUNTED_WITHIN_S)
    except DiskTimeout as error:
        told.append(f"what was measured can't be counted: {error}")
    told.append(f"everything is in {folder}")
    if outcome.why is EndReason.STOPPED:
        told.append(f"{resume_command(folder)} goes on with it")
    return told


def _recorded(folder: Path) -> list[str]:
    """What the record counts, where there is one."""
    try:
        with open_run(folder) as run:
            whole = sum(not row.interrupted for row in run.scans)
            interrupted, spectra = len(run.scans) - whole, len(run.spectra)
    except FileError:
        return []
    return [_measured(whole, spectra) + (f"; {interrupted} interrupted" if interrupted else "")]


def _tabled(table: Path) -> list[str]:
    """What the table of measurements counts, where the experiment kept one; a scan's channels are one scan."""
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
