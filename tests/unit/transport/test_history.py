"""What a publisher keeps for those who come later."""

from __future__ import annotations

from afspm.clock import ExperimentClock
from afspm.transport.late_joiners import PublishedHistory


def test_what_is_of_this_moment_only_is_not_sent_to_who_comes_later() -> None:
    published = PublishedHistory(ExperimentClock.real(), most_packets=3)
    scan = published.stamp("Scan2d", b"scan")
    lines = [published.stamp("ScanLines", b"line", keep=False) for _ in range(10)]
    state = published.stamp("ScopeStateMsg", b"free")
    assert published("somebody", ("",), -1) == [scan, state]
    times = [packet.time_ns or 0 for packet in (scan, *lines, state)]
    assert times == sorted(set(times))
