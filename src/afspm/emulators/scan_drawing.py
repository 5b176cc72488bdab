"""Computing the values of a scan, while it lasts or at its start."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from threading import Thread

from afspm.emulators.activities import NoValues, ScanActivity, ScanValues, ValuesInAir
from afspm.errors import InvalidValue
from afspm.simulation import World
from afspm.simulation.feedback import Loop
from afspm.simulation.scanning import Course

_SMALLEST_M, _LARGEST_M, _LONGEST_PIXEL = 1e-12, 200e-6, 1e4


class ScanDrawing:
    """Draws one scan at a time; the world belongs to its thread meanwhile.

    Args:
        units: of the channels.
        background: compute while the scan lasts; False: at its start.

    Attributes:
        wake: called from the thread when a scan is drawn.
        log: told of errors that nobody foresaw.
    """

    def __init__(self, world: World, units: Mapping[str, str], seed: int, *, background: bool) -> None:
        self._world, self._units, self._seed, self._background = world, units, seed, background
        self._newest: ScanActivity | None = None
        self.wake: Callable[[], None] = lambda: None
        self.log = logging.getLogger(__name__)

    def start(self, scan: ScanActivity, slope: tuple[float, float], *, engaged: bool) -> None:
        """Begin to draw a scan. Raises InvalidValue: it can't be simulated."""
        draw = self._drawer(scan, slope, engaged=engaged)
        if self._background:
            self._in_background(draw, scan)
        else:
            scan._drawn.set_result(draw())
        self._newest = scan

    def wait(self) -> None:
        """Wait until the newest scan is drawn, since the world is one thread's at a time."""
        if self._newest is not None:
            wait([self._newest._drawn])

    def _drawer(self, scan: ScanActivity, slope: tuple[float, float], *, engaged: bool) -> Callable[[], ScanValues]:
        _check_scannable(scan)
        if not all(map(math.isfinite, (scan.bias_v, *slope))):
            raise InvalidValue(f"bias and slope: {scan.bias_v}, {slope}", hint="finite")
        direction = "up" if scan.upwards else "down"
        course = Course(scan.region, scan.shape, scan.line_s, scan.start_s, direction)
        Loop.of(self._world.settings.feedback, scan.feedback)
        if not engaged:
            air = ValuesInAir(self._units, course, (self._seed, 1, scan.number))
            return lambda: air
        return lambda: self._world.scan(
            scan.region,
            scan.shape,
            scan.line_s,
            scan.start_s,
            scan.feedback,
            scan.bias_v,
            direction=direction,
            slope=slope,
        )

    def _in_background(self, draw: Callable[[], ScanValues], scan: ScanActivity) -> None:
        def work() -> None:
            try:
                drawn = draw()
            except Exception:
                self.log.exception("scan %d can't be simulated and was stopped", scan.number)
                drawn, scan.stopped_s = NoValues(self._units, scan.shape), scan.start_s
            scan._drawn.set_result(drawn)
            self.wake()

        # not an executor's thread: those are waited for when the process ends
        Thread(target=work, daemon=True, name="simulated scan").start()


def _check_scannable(scan: ScanActivity) -> None:
    """Raises InvalidValue: no scanner has such a frame; simulating it takes minutes, or more memory than there is."""
    pixels = [size_m / count for size_m, count in zip(scan.region.size_m, scan.shape[::-1], strict=True)]
    reach = all(_SMALLEST_M <= size_m <= _LARGEST_M for size_m in scan.region.size_m)
    if not (reach and max(pixels) <= _LONGEST_PIXEL * min(pixels)):
        raise InvalidValue(
            f"a frame of {scan.region.size_m} m with {scan.shape[1]} x {scan.shape[0]} pixels can't be simulated",
            hint=f"{_SMALLEST_M} to {_LARGEST_M} m, pixels at most {_LONGEST_PIXEL:g} times as long as wide",
        )
    if scan.start_s + scan.shape[0] * scan.line_s <= scan.start_s:
        raise InvalidValue(f"a line of {scan.line_s} s can't be simulated", hint="its time must be above 0")
