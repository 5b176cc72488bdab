"""A component that counts scans, and ends the experiment after a number of them."""

from __future__ import annotations

from typing import ClassVar

from afspm import Component, Scan


class ExampleCounter(Component):
    """Ends the experiment after a number of scans.

    Args:
        scans: the number of channels to wait for.
    """

    listens: ClassVar = ("Scan2d",)

    def __init__(self, scans: int = 1) -> None:
        self.left = scans

    def on_scan(self, scan: Scan) -> None:
        self.left -= 1
        if self.left == 0:
            self.log.info("counted by the plug-in")
            self.scope.end_experiment()
