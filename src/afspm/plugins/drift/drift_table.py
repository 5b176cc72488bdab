"""`DriftTable`: what was told of drift, scan by scan, as a table in the run folder."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from afspm.basics.clock import iso_utc
from afspm.client.component import Component
from afspm.components.line_file import LineFile, csv_line
from afspm.model import RegistrationOutcome
from afspm.model.drift_mapping import drift_at
from afspm.plugins.drift.record import COLUMNS as RECORD

COLUMNS = ("datetime", "filename", "offset_x", "offset_y", "rate_x", "rate_y", "units", *RECORD, "lost", "correcting")


class DriftTable(Component):
    """Writes `drift_correction.csv`: for each scan the offset between tip and sample coordinates, and its rate.

    The offset is x_sample - x_tip. The columns from `scan` to `failures` are those of `drift.record`, which reads
    the table. `outcome` says how the position of a scan is known: registered, coarse, or by dead reckoning (refused,
    failed, new), with the variances that it then has. Whatever is killed, there is one header and no row is there
    twice.

    Args:
        file: its name in the run folder.
    """

    listens: ClassVar = ("DriftMapping",)

    def __init__(self, file: str = "drift_correction.csv") -> None:
        self.file = file

    def on_start(self) -> None:
        self._table = LineFile(Path(self.run_dir) / self.file, ",".join(COLUMNS))
        self._written = {tuple(row[:2]) for row in csv.reader(self._table.lines())}

    def on_drift_mapping(self, message: Any) -> None:
        row = drift_row(message)
        if tuple(row[:2]) in self._written:
            return  # replayed after a restart
        self._table.append([csv_line(row)])
        self._written.add(tuple(row[:2]))


def drift_row(message: Any) -> list[str]:
    """Return a DriftMapping as a row."""
    time_ns = message.timestamp.ToNanoseconds()
    drift_x, drift_y = drift_at(np.array(message.matrix).reshape(2, 3), message.center)
    xx, xy, _, yy = message.covariance or (math.nan,) * 4  # of a scan before anything was known
    rate = message.rate or (math.nan,) * 2
    outcome = RegistrationOutcome.of(message.outcome, matched=message.matched)
    numbers = (*message.center, drift_x, drift_y, xx, yy, xy, *rate)
    return [
        iso_utc(time_ns),
        message.filename,
        *(_text(value) for value in (-drift_x, -drift_y, *rate)),
        "m; m/s",
        message.filename,
        f"{time_ns * 1e-9:.6f}",
        *(_text(value) for value in numbers),
        *("yes" if message.matched else "no", message.reason, outcome.label, str(message.failures)),
        *("yes" if flag else "no" for flag in (message.lost, message.correcting)),
    ]


def _text(value: float) -> str:
    return f"{value + 0.0:.9g}"  # never -0
