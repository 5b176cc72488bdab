"""Keeps every scan as it was published."""

from __future__ import annotations

import json

import numpy as np

from afspm import Component, Scan


class Keeper(Component):
    listens = ("Scan2d",)

    def on_scan(self, scan: Scan) -> None:
        number = self.memory["scans"] = self.memory.get("scans", 0) + 1
        region = scan.region
        facts = [scan.channel, scan.unit, *region.center_m, *region.size_m, region.angle_rad]
        np.savez(self.run_dir / f"kept-{number:03}.npz", values=scan.values, facts=json.dumps(facts))
