"""The verdict on a scan as a message of the contract: a list of places, each with a score."""

from __future__ import annotations

from typing import Any

from afspm import wire
from afspm.model import Scan
from afspm.record.bad_scans import BAD, VERDICT_MESSAGE, read_verdict

__all__ = ["BAD", "GOOD", "MESSAGE", "UNCLEAR", "read_verdict", "verdict_message"]

MESSAGE = VERDICT_MESSAGE
GOOD, UNCLEAR = 1.0, 0.5


def verdict_message(scan: Scan, score: float) -> Any:
    """Return a `SpatialROIWithScoreList` with one place: the scan's, with its time and channel."""
    message: Any = wire.message_type(MESSAGE)(channel=scan.channel)
    if scan.time_ns is not None:
        message.timestamp.FromNanoseconds(scan.time_ns)
    entry = message.spatials.add(score=score)
    (left, low), (width, height) = scan.region.top_left_m, scan.region.size_m
    entry.spatial.roi.top_left.x, entry.spatial.roi.top_left.y = left, low
    entry.spatial.roi.size.x, entry.spatial.roi.size.y = width, height
    entry.spatial.roi.angle = scan.region.angle_rad
    entry.spatial.length_units, entry.spatial.angular_units = "m", "rad"
    return message
