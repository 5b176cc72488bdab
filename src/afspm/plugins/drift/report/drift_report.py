"""Drawing of drift against time for the report of a run without `DriftPictures`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from afspm import Run, wire
from afspm.plugins.drift.track.record import DriftRecord
from afspm.record import drift_at, drift_knowledge
from afspm.report import OFFSET, is_ours

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from afspm.wire.messages import DriftMapping


NAME = "report_drift"


def figures(run: Run, title: str, again: bool = False) -> Iterator[tuple[str, Figure]]:
    """Yield the drift of at least two mapped scans; unless `again`, only where no component has drawn it."""
    if not (again or is_ours(run.folder, f"{NAME}.png", OFFSET)) or len(record := drift_of(run)) < 2:
        return
    from afspm.plugins.drift.report.drawings import draw_offsets

    yield NAME, draw_offsets(record, title=title)


def drift_of(run: Run) -> DriftRecord:
    """Return the drift that the scheduler published during a run; messages without a mapping are left out."""
    decoded: list[DriftMapping] = [
        wire.decode("DriftMapping", packet.payload) for packet in run.packets(messages=("DriftMapping",))
    ]
    published = [message for message in decoded if len(message.matrix) == 6 and len(message.center) == 2]

    def square(values: Sequence[float]) -> NDArray[np.float64]:
        # before the first registration the scheduler publishes no covariance
        return np.array(values if len(values) == 4 else [np.nan] * 4, dtype=np.float64).reshape(2, 2)

    return DriftRecord(
        keys=tuple(message.filename for message in published),
        time_s=np.array([message.timestamp.ToNanoseconds() * 1e-9 for message in published]),
        center_m=np.array([tuple(message.center) for message in published]).reshape(-1, 2),
        drift_m=np.array([drift_at(np.array(m.matrix).reshape(2, 3), m.center) for m in published]).reshape(-1, 2),
        covariance_m2=np.array([square(message.covariance) for message in published]).reshape(-1, 2, 2),
        rate_m_s=np.array([tuple(m.rate) if len(m.rate) == 2 else (0.0, 0.0) for m in published]).reshape(-1, 2),
        matched=np.array([message.matched for message in published], dtype=bool),
        reasons=tuple(message.reason for message in published),
        outcomes=tuple(drift_knowledge(message)[0] for message in published),
        failures=tuple(message.failures for message in published),
    )
