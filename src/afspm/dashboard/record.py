"""What was before this dashboard was started, and scans that are not in memory any more: out of the run's record."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from pathlib import Path

from afspm.dashboard.frames import Frame, Key
from afspm.errors import AfspmError
from afspm.model import ProblemNames, Scan
from afspm.record.journal import JOURNAL_FILE
from afspm.record.overview import Overview
from afspm.record.run import open_run
from afspm.record.tables import ScanRow

KEPT = 6
PAST = (
    "ProcessStates", "JournalEntries", "ControlState", "ScopeStateMsg", "ScanParameters2d", "Scan2d", "Spec1d",
    "DriftMapping",
)  # fmt: skip
"""Messages with which an `Overview` has the time line, the map, drift and refusals. Of others the scheduler has kept
enough for whoever comes late."""
_SAME_SCAN_NS = 1_000_000_000  # channels of one scan may be stamped one after the other


class Archive:
    """Reads what the recorder has written into the run's folder. From any thread.

    Args:
        folder: of the run; None where it is on another computer.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._log = logging.getLogger("afspm.dashboard")
        self._lock = threading.Lock()
        self._read: OrderedDict[Key, Frame] = OrderedDict()

    def past(self, problems: ProblemNames) -> Overview | None:
        """What the run has come to so far, without what was said; None if there is no record of it yet."""
        if self._folder is None or not (self._folder / JOURNAL_FILE).is_file():  # a replay has only that of another run
            return None
        try:
            with open_run(self._folder) as run:
                return run.overview(PAST, problems)
        except (AfspmError, ImportError) as error:
            self._log.debug("the past can't be read: %s", error)
            return None

    def frame(self, time_ns: int, channel: str) -> Frame | None:
        """A finished channel by its time; None if it is not in the record, or there is none."""
        if self._folder is None:
            return None
        key = (time_ns, channel)
        with self._lock:
            if key in self._read:
                self._read.move_to_end(key)
                return self._read[key]
            try:
                frame = self._find(self._folder, time_ns, channel)
            except (AfspmError, ImportError, KeyError) as error:
                self._log.debug("a scan that can't be read: %s", error)
                return None
            if frame is not None:
                self._read[key] = frame
                while len(self._read) > KEPT:
                    self._read.popitem(last=False)
            return frame

    def _find(self, folder: Path, time_ns: int, channel: str) -> Frame | None:
        with open_run(folder) as run:
            near = [row for row in run.scans if abs(row.time_ns - time_ns) <= _SAME_SCAN_NS and _has(row, channel)]
            if not near:
                return None
            row = min(near, key=lambda one: abs(one.time_ns - time_ns))
            return _frame(run.scan(row)[channel], time_ns)


def _has(row: ScanRow, channel: str) -> bool:
    return bool(row.file) and any(name == channel for name, _ in row.channels)


def _frame(scan: Scan, time_ns: int) -> Frame:
    """Below all numbers of what comes now, and the same for the same scan."""
    number = -1 - (hash((time_ns, scan.channel)) & (2**52 - 1))
    return Frame(number, scan.channel, scan.unit, scan.region, scan.values, time_ns, None, scan.filename, scan.shape[0])
