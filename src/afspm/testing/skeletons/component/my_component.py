"""MyComponent: describe its decision in one sentence."""

from __future__ import annotations

import numpy as np

from afspm import Component, Scan
from afspm.model import ChannelName


class MyComponent(Component):
    """A component that logs the roughness of each scan, and at the end the roughest scan.

    Args:
        channel: the evaluated channel, by its role, the same on every microscope, or by its maker's name.
    """

    listens = ("Scan2d",)

    def __init__(self, channel: ChannelName = "height") -> None:
        self.channel = channel

    def on_scan(self, scan: Scan) -> None:
        if not scan.is_of(self.channel):
            return
        if scan.time_ns and scan.time_ns <= self.memory.get("newest_ns", -1):
            return  # handled before a restart: the cached scans arrive again
        self.memory["newest_ns"] = scan.time_ns or -1
        found = self.memory.setdefault("rms_nm", [])  # kept on disk: it survives a restart
        found.append(1e9 * roughness(scan.values))
        self.log.info("scan %d: %.2f nm rms", len(found), found[-1])

    def on_end(self) -> None:
        if found := self.memory.get("rms_nm"):
            self.log.info("the roughest is scan %d: %.2f nm rms", int(np.argmax(found)) + 1, max(found))


def roughness(heights_m: np.ndarray) -> float:
    """Return the RMS roughness in metres, with the median of each line subtracted."""
    return float(np.nanstd(heights_m - np.nanmedian(heights_m, axis=1, keepdims=True)))
