from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from afspm.clock import ExperimentClock
from afspm.dashboard.record import Archive
from afspm.dashboard.watch import Watch
from afspm.model import (
    JournalEntries,
    JournalEntry,
    LogLine,
    LogLines,
    Region,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
)

S = 1_000_000_000


def test_where_nothing_is_recorded_nothing_is_found(tmp_path: Path) -> None:
    assert Archive(None).frame(S, "Height") is None
    assert Archive(tmp_path).frame(S, "Height") is None


def test_a_watch_rings_when_something_has_changed_and_tells_how_long_it_is_silent() -> None:
    watch = Watch(ExperimentClock.real())
    rung = []
    watch.on_change(lambda: rung.append(watch.changes))
    assert not watch.connected
    watch.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), S)
    assert rung == [1]
    assert watch.connected
    assert watch.silent_s() < 60.0
    assert watch.wait_free(0.0)
    assert not watch.wait_for(lambda overview: overview.control is not None, 0.01)


@pytest.mark.timeout(60)
def test_eight_hours_of_messages_take_bounded_memory() -> None:
    """A line a second in two channels, a scan every 5 minutes, states, log and journal: 200 000 messages."""
    watch, region = Watch(ExperimentClock.real()), Region((0.0, 0.0), (1e-6, 1e-6))
    watch.frames = type(watch.frames)(memory_bytes=4 << 20)
    rows = np.zeros((1, 256))
    sizes = []
    for second in range(8 * 3600):
        now_ns, row = (second + 1) * S, second % 256
        for channel in ("Height", "Phase"):
            began_ns = (second - row + 1) * S
            lines = ScanLines(region, (256, 256), channel, "m", row, rows, began_ns)
            watch.take("ScanLines", lines, now_ns, f"ScanLines_{channel}")
            if row == 255:
                scan = Scan(region, channel, "m", np.zeros((256, 256)), now_ns)
                watch.take("Scan2d", scan, now_ns, f"Scan2d_{channel}")
        state = ScopeState.SCANNING if row < 255 else ScopeState.FREE
        watch.take("ScopeStateMsg", ScopeStatus(state), now_ns)
        watch.take("LogLines", LogLines((LogLine(now_ns, "series", "INFO", "x" * 80),)), now_ns)
        watch.take("JournalEntries", JournalEntries((JournalEntry(now_ns, "request", "series", "x", 1),)), now_ns)
        if second % 7200 == 7199:
            overview = watch.overview
            sizes.append((watch.frames.kept_bytes, len(overview.log), len(overview.entries), len(overview.refusals)))
    assert sizes[1:] == [sizes[1]] * 3
    assert sizes[-1][0] <= 4 << 20
