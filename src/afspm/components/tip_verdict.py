"""Verdicts on the tip as messages.

The verdict on a complete scan is a message of the contract: a list of places, each with a score. The verdict on the
lines of a running scan is a `TipVerdict`, since the message of the contract names a scan by its end and has no field
for a row: reports that count judged scans would count a scan that never was.
"""

from __future__ import annotations

from dataclasses import dataclass

from afspm import wire
from afspm.model import Region, Scan, ScanParameters
from afspm.night.bad_scans import BAD, LINE_VERDICT_MESSAGE, VERDICT_MESSAGE, read_verdict
from afspm.wire.messages import SpatialROIWithScoreList, TipVerdict

__all__ = [
    "BAD",
    "GOOD",
    "MESSAGE",
    "OF_LINES",
    "UNCLEAR",
    "LineVerdict",
    "line_verdict_message",
    "read_line_verdict",
    "read_verdict",
    "verdict_message",
]

MESSAGE = VERDICT_MESSAGE
OF_LINES = LINE_VERDICT_MESSAGE
GOOD, UNCLEAR = 1.0, 0.5


@dataclass(frozen=True)
class LineVerdict:
    """The verdict that the tip has changed during a scan.

    Attributes:
        region, shape: region and shape of the whole scan.
        began_ns: the start of the scan, as in its lines.
        row: index of the row that raised the alarm.
        since_row: index of the first row with the change, by estimate.
        downwards: whether rows are scanned from the last to the first.
        confidence: share of scans with a good tip that give less evidence.
        stops: whether the scan is stopped; otherwise the verdict only informs people.
    """

    region: Region
    shape: tuple[int, int]
    channel: str
    began_ns: int | None
    row: int
    since_row: int
    downwards: bool
    confidence: float
    stops: bool
    reason: str = ""


def line_verdict_message(verdict: LineVerdict) -> TipVerdict:
    """Return a verdict as a `TipVerdict` message."""
    message = TipVerdict(
        channel=verdict.channel,
        row=verdict.row,
        since_row=verdict.since_row,
        downwards=verdict.downwards,
        confidence=verdict.confidence,
        stops=verdict.stops,
        reason=verdict.reason,
    )
    message.params.MergeFromString(wire.encode(ScanParameters(verdict.region, verdict.shape))[1])
    if verdict.began_ns is not None:
        message.timestamp.FromNanoseconds(verdict.began_ns)
    return message


def read_line_verdict(message: TipVerdict) -> LineVerdict | None:
    """Return the content of a `TipVerdict`; None without region and pixels."""
    parameters = wire.decode("ScanParameters2d", message.params.SerializeToString())
    if not (isinstance(parameters, ScanParameters) and isinstance(parameters.region, Region)):
        return None
    if not isinstance(parameters.shape, tuple):
        return None
    return LineVerdict(
        parameters.region,
        parameters.shape,
        message.channel,
        message.timestamp.ToNanoseconds() if message.HasField("timestamp") else None,
        message.row,
        message.since_row,
        message.downwards,
        message.confidence,
        message.stops,
        message.reason,
    )


def verdict_message(scan: Scan, score: float) -> SpatialROIWithScoreList:
    """Return a `SpatialROIWithScoreList` with the region, time and channel of a scan, and a score."""
    message = SpatialROIWithScoreList(channel=scan.channel)
    if scan.time_ns is not None:
        message.timestamp.FromNanoseconds(scan.time_ns)
    entry = message.spatials.add(score=score)
    (left, low), (width, height) = scan.region.top_left_m, scan.region.size_m
    entry.spatial.roi.top_left.x, entry.spatial.roi.top_left.y = left, low
    entry.spatial.roi.size.x, entry.spatial.roi.size.y = width, height
    entry.spatial.roi.angle = scan.region.angle_rad
    entry.spatial.length_units, entry.spatial.angular_units = "m", "rad"
    return message
