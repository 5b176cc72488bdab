"""Says how rough each wide view is."""

from __future__ import annotations

import numpy as np

from afspm import Component
from afspm.model import Scan


class Survey(Component):
    """Logs the roughness of every scan that it gets: only wide ones, as the experiment file has it."""

    def on_scan(self, scan: Scan) -> None:
        self.log.info("%s: %.3g nm rms", self.packet.envelope if self.packet else "", np.std(scan.values) * 1e9)
