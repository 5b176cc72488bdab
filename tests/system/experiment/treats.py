"""Scans, treats the tip beside and away from the scan, and switches the feedback off for a while."""

from __future__ import annotations

from afspm import Component, Region
from afspm.model import names


class Treats(Component):
    def run(self) -> None:
        scope = self.scope
        with scope.control():
            scope.scan(Region((0.0, 0.0), (500e-9, 500e-9)), shape=(16, 16))
            scope.set(names.PULSE_VOLTAGE, "-4 V")
            scope.set(names.PULSE_DURATION, "50 ms")
            scope.set(names.CRASH_DEPTH, "5 nm")
            for place_m, action in (
                ((300e-9, 0.0), names.PULSE),
                ((2e-6, 0.0), names.PULSE),
                ((2e-6, 1e-6), names.CRASH),
            ):
                scope.move_probe(place_m)
                scope.action(action)
            scope.set_feedback(on=False)
            scope.sleep(30.0)
            scope.set_feedback(on=True)
        scope.end_experiment()
