"""A component of ten lines."""

import numpy as np

from afspm import Component
from afspm.model import ChannelName


class Sharpness(Component):
    """Warns of scans that are less sharp than the first one was."""

    listens = ("Scan2d",)

    def __init__(self, threshold: float = 0.8, channel: ChannelName = "height"):
        self.threshold, self.channel = threshold, channel

    def on_scan(self, scan):
        if scan.is_of(self.channel):
            sharpness = float(np.percentile(np.abs(np.diff(scan.values, axis=1)), 99))  # how steep the edges are
            first = self.memory.setdefault("first", sharpness)
            self.memory.save()
            if sharpness < self.threshold * first:
                self.log.warning("a scan is %.0f %% as sharp as the first", 100 * sharpness / first)
