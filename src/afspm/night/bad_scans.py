"""The rule that marks a scan as bad: for tables, the report, its map, and pictures of the night.

A flag follows the scan that caused it, often after another scan. In a night with three repairs, framing the scans taken
during a flag missed the first bad scan of each repair, and framed the scan that proved it. So verdicts count, and flags
only in a run without verdicts. Scans of the corrector are not bad as such: most of them prove that the tip is good.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from afspm.model import Problem

if TYPE_CHECKING:
    from afspm.wire.messages import SpatialROIWithScoreList

BAD = 0.0
"""The score of a scan that was judged to show a bad tip."""
VERDICT_MESSAGE = "SpatialROIWithScoreList"
LINE_VERDICT_MESSAGE = "TipVerdict"
_SAME_SCAN_NS = 1_000_000_000  # the channels of a scan get their times one after the other
_NOT_OF_A_SCAN = frozenset({int(Problem.THERMAL_DRIFT), int(Problem.DEVICE_MALFUNCTION)})
"""Problems without a verdict on the previous scan: they concern the sample's position or the controller."""


def read_verdict(message: SpatialROIWithScoreList) -> tuple[int, float] | None:
    """Return (time of the scan in ns, score) of a verdict message; None for a verdict that is not about a scan."""
    if not message.spatials or not message.HasField("timestamp"):
        return None
    return message.timestamp.ToNanoseconds(), float(message.spatials[0].score)


def last_scores(times_ns: Iterable[int], verdicts: Iterable[tuple[int, float]]) -> dict[int, float]:
    """Return the last score of each judged scan, by its time.

    Args:
        times_ns: ends of scans.
        verdicts: time of the scan and score, in the order of arrival.
    """
    times_ns = sorted(times_ns)
    scores: dict[int, float] = {}
    for of_ns, score in verdicts:
        after = bisect_left(times_ns, of_ns)
        near = min(times_ns[max(after - 1, 0) : after + 1], key=lambda time_ns: abs(time_ns - of_ns), default=None)
        if near is not None and abs(near - of_ns) <= _SAME_SCAN_NS:
            scores[near] = score
    return scores


def bad_scans(
    times_ns: Sequence[int],
    verdicts: Iterable[tuple[int, float]],
    flagged_ns: Mapping[int, Iterable[int]],
    interrupted_ns: Iterable[int] = (),
    of_conditions: Collection[int] = (),
) -> frozenset[int]:
    """Return the times of the bad scans.

    A scan is bad if it was interrupted, or if the last verdict on it is bad. In a run without verdicts on these scans,
    the newest scan before each flagged problem is bad, except before thermal drift, device-malfunction and the problems
    of conditions.

    Args:
        times_ns: ends of scans, or their interruptions.
        verdicts: time of the scan and score, in the order of arrival.
        flagged_ns: the times at which each problem was flagged, by its number.
        interrupted_ns: the times of the interruptions.
        of_conditions: the numbers of the problems flagged by conditions, which judge other instruments.
    """
    judged = last_scores(times_ns, verdicts)
    bad = {time_ns for time_ns, score in judged.items() if score == BAD}
    bad |= set(times_ns) & set(interrupted_ns)
    if judged:
        return frozenset(bad)
    silent = _NOT_OF_A_SCAN.union(of_conditions)
    for flag_ns in (flag for number, flags in flagged_ns.items() if number not in silent for flag in flags):
        newest_ns = max((time_ns for time_ns in times_ns if time_ns <= flag_ns), default=None)
        bad |= set() if newest_ns is None else {newest_ns}
    return frozenset(bad)
