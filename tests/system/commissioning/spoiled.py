"""Controllers that are wrong in one thing: each vendor's driver with something in between, on the vendor's emulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from afspm.basics import FileError, entry_points
from afspm.driver import Driver
from afspm.model import Scan, ScanLines, ScopeState, ScopeStatus, Spectrum, names
from afspm.plugins.gxsm.emulator import GxsmEmulator
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanonis.emulator import NanonisEmulator
from afspm.plugins.nanosurf.emulator import NanosurfEmulator
from afspm.simulation.scanning import Course

LATE_S = 120.0
"""Experiment seconds."""


class MirroredY(Driver):
    """Rows from the top to the bottom, as pictures have them."""

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        found = super().load(result)  # type: ignore[safe-super]
        return [replace(one, values=one.values[::-1].copy()) if isinstance(one, Scan) else one for one in found]


class OtherWay(Driver):
    """Angles the other way round, wherever they are told: only the sample shows it."""

    def write(self, values: Any) -> None:
        super().write(turned(values))

    def read(self, wanted: Any) -> dict[str, Any]:
        return turned(super().read(wanted))

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        found = super().load(result)  # type: ignore[safe-super]
        return [
            replace(one, region=replace(one.region, angle_rad=-one.region.angle_rad)) if isinstance(one, Scan) else one
            for one in found
        ]


class OtherZNanonis(Nanonis):
    """Z counts towards the sample, as on a rig whose piezo is wired so."""

    def _ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[Any, ...]:
        found = super()._ask(name, *arguments, longer_s=longer_s)
        return (-found[0],) if name == "ZCtrl.ZPosGet" else found  # type: ignore[operator]


class NoisyNanonis(Nanonis):
    """A bias of this controller is read with a noise of 2 mV from end to end."""

    off_v = 1e-3

    def read(self, wanted: Any) -> dict[str, Any]:
        found = super().read(wanted)
        if names.TIP_BIAS_VOLTAGE in found:
            self.off_v = -self.off_v
            found[names.TIP_BIAS_VOLTAGE] = float(found[names.TIP_BIAS_VOLTAGE]) + self.off_v
        return found


class DeafNanonis(Nanonis):
    """A withdrawal has no effect, without an error."""

    def _ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[Any, ...]:
        return () if name == "ZCtrl.Withdraw" else super()._ask(name, *arguments, longer_s=longer_s)


class NoLinesNanonis(Nanonis):
    """The lines of a running scan can't be read."""

    def lines(self, start: int) -> Sequence[ScanLines]:
        raise FileError("another layout")


class LateEnd(Driver):
    """Notices the end of a scan two minutes late."""

    until_s = 0.0
    before = ScopeState.FREE

    def status(self) -> ScopeStatus:
        found = super().status()  # type: ignore[safe-super]
        if self.before is ScopeState.SCANNING and found.state is ScopeState.FREE:
            self.until_s = self.clock.now_s() + LATE_S
        self.before = found.state
        return ScopeStatus(ScopeState.SCANNING) if self.clock.now_s() < self.until_s else found


def turned(values: Any) -> dict[str, Any]:
    return {name: -float(value) if name == names.SCAN_ANGLE else value for name, value in values.items()}


for vendor in (entry_points.load(entry_points.DRIVERS, name) for name in entry_points.names(entry_points.DRIVERS)):
    for fault in (MirroredY, OtherWay, LateEnd):
        name = fault.__name__ + vendor.__name__
        globals()[name] = type(name, (fault, vendor), {"__module__": __name__})


class CoarseNanonisEmulator(NanonisEmulator):
    """A panel with few pixels: its frame is a pixel wider than from the first to the last."""

    def open(self) -> str:
        address = super().open()
        self.software.scans.pixels = self.software.scans.lines = 32
        return address


def turn(angle_rad: float) -> Any:
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])


PLACES: dict[str, Callable[[float], Any]] = {
    "x mirrored": lambda angle_rad: np.diag([-1.0, 1.0]),
    "y mirrored": lambda angle_rad: np.diag([1.0, -1.0]),
    "swapped": lambda angle_rad: np.array([[0.0, 1.0], [1.0, 0.0]]),
    "scale": lambda angle_rad: np.diag([1.1, 1.1]),
    "scale of y": lambda angle_rad: np.diag([1.0, 0.9]),
    "angle": lambda angle_rad: turn(np.radians(5.0)),
    "other way": lambda angle_rad: turn(-2.0 * angle_rad),
}


class WrongScanner:
    """A controller whose pixels are elsewhere about the centre of the frame, in the laboratory's axes, by `fault`."""

    def __init__(self, *, fault: str, **settings: Any) -> None:
        def pixels_m(course: Course) -> tuple[Any, Any]:
            (x, y), center = course.region.pixels_m(course.shape), np.array(course.region.center_m)
            placed = PLACES[fault](course.region.angle_rad) @ (np.stack([x.ravel(), y.ravel()]) - center[:, None])
            return tuple(one.reshape(x.shape) + at for one, at in zip(placed, center, strict=True))

        Course.pixels_m = pixels_m  # type: ignore[method-assign, assignment]  # of this process alone
        super().__init__(**settings)


class WrongNanonisEmulator(WrongScanner, NanonisEmulator):
    """The emulated Nanonis with such a scanner."""


class WrongNanosurfEmulator(WrongScanner, NanosurfEmulator):
    """The emulated Nanosurf with such a scanner."""


class SimulatingGxsmEmulator(GxsmEmulator):
    """GXSM's own simulator, without a scan-speed; its picture turns the other way."""

    def __init__(self, *, pixels_per_s: float, **settings: Any) -> None:
        super().__init__(card="simulator", **settings)
        self.pixels_per_s = pixels_per_s

    def open(self) -> str:
        address = super().open()
        self.program.entries.put("sim-stm-speed", self.pixels_per_s)
        return address
