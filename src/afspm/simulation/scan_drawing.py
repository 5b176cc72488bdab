"""Computation of the values of a scan, at its start or while the scan runs."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack

from afspm.basics import Publication
from afspm.basics.clock import Clock
from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.simulation.activities import NoValues, ScanActivity, ScanValues, ValuesInAir
from afspm.simulation.feedback import Loop
from afspm.simulation.world import World

_SMALLEST_M, _LARGEST_M, _LONGEST_PIXEL = 1e-12, 200e-6, 1e4
FARTHEST_M = 1.0
"""Largest x and y: no stage goes as far, and the surface's cells are counted in 64 bits."""

RunWork = Callable[[Callable[[], None]], None]
"""Runs a function: at once, or in another thread."""
Draw = Callable[[], ScanValues]


def run_at_once(work: Callable[[], None]) -> None:
    work()


class ScanDrawing:
    """The computation of one scan at a time, with exclusive use of the world meanwhile.

    Args:
        units: returns the unit of each channel.
        run: runs the computation.

    Attributes:
        wake: called from the thread of the computation when a scan is ready.
        log: receives unexpected errors.
        clock: waits at the end of a scan that is still being computed, until `release`; from the start of the scan if
            a component waits for its lines. None: no clock waits.
    """

    def __init__(self, world: World, units: Callable[[], Mapping[str, str]], seed: int, run: RunWork) -> None:
        self._world, self._units, self._seed, self._run = world, units, seed, run
        self._newest: ScanActivity | None = None
        self._before: Plain = {}
        self.wake: Callable[[], None] = lambda: None
        self.log = logging.getLogger(__name__)
        self.clock: Clock | None = None
        self._late = ExitStack()

    def start(self, scan: ScanActivity, draw: Draw) -> None:
        """Start the computation returned by `prepared`; an unexpected error stops the scan and leaves it empty."""

        def work() -> None:
            try:
                drawn = draw()
            except Exception:  # in a worker thread: any error costs this scan only, the instrument goes on
                self.log.exception("scan %d can't be simulated and was stopped", scan.number)
                drawn, scan.stopped_s = NoValues(self._units(), scan.shape), scan.start_s
            scan.draw(drawn)
            self.wake()

        self._newest = scan
        self._late.close()
        if self.clock is not None:
            # a receiver of lines needs the first lines long before the end
            since_s = None if self.clock.awaits(Publication.LINES) else scan.end_s
            self._late.enter_context(self.clock.late(since_s))
        self._run(work)

    def release(self) -> None:
        """Let time pass again, unless the scan is still being computed: call it after each look at the instrument."""
        if not self.goes_on:
            self._late.close()

    @property
    def world_before(self) -> Plain:
        """The state of the world before the newest scan, from which the scan can be computed again."""
        return self._before

    def keep_world(self) -> None:
        """Keep the state of the world before the computation of a scan."""
        self._before = self._world.state()

    def rewind(self) -> None:
        """Restore the world as it was before the newest scan."""
        self._world.restore(self._before)

    @property
    def goes_on(self) -> bool:
        """True while a scan is being computed, even if the scan was stopped."""
        return self._newest is not None and self._newest.drawing

    def wait(self) -> None:
        """Wait until the newest scan is computed, since the world belongs to one thread at a time."""
        if self._newest is not None:
            self._newest.wait()

    def prepared(self, scan: ScanActivity, *, engaged: bool) -> Draw:
        """Return the computation of a scan as a function.

        Raises:
            InvalidValue: the scan cannot be simulated.
        """
        _check_scannable(scan)
        if not all(map(math.isfinite, (scan.bias_v, *scan.slope))):
            raise InvalidValue(f"bias and slope: {scan.bias_v}, {scan.slope}", hint="finite")
        course = scan.course
        Loop.of(self._world.settings.feedback, scan.feedback)
        if not engaged:
            air = ValuesInAir(self._units(), course, (self._seed, 1, scan.number))
            return lambda: air
        return lambda: self._world.scan(
            scan.region,
            scan.shape,
            scan.line_s,
            scan.start_s,
            scan.feedback,
            scan.bias_v,
            direction=course.direction,
            slope=scan.slope,
            adjusted=scan.adjusted,
            reach_m=scan.reach_m,
        )


def _check_scannable(scan: ScanActivity) -> None:
    # no scanner has such a frame; simulating it would take minutes, or more memory than a computer has
    pixels = [size_m / count for size_m, count in zip(scan.region.size_m, scan.shape[::-1], strict=True)]
    reach = all(_SMALLEST_M <= size_m <= _LARGEST_M for size_m in scan.region.size_m)
    if not all(abs(along_m) <= FARTHEST_M for along_m in scan.region.center_m):
        raise InvalidValue(f"a frame at {scan.region.center_m} m can't be simulated", hint=f"at most {FARTHEST_M:g} m")
    if not (reach and max(pixels) <= _LONGEST_PIXEL * min(pixels)):
        raise InvalidValue(
            f"a frame of {scan.region.size_m} m with {scan.shape[1]} x {scan.shape[0]} pixels can't be simulated",
            hint=f"{_SMALLEST_M} to {_LARGEST_M} m, pixels at most {_LONGEST_PIXEL:g} times as long as wide",
        )
    if scan.start_s + scan.shape[0] * scan.line_s <= scan.start_s:
        raise InvalidValue(f"a line of {scan.line_s} s can't be simulated", hint="its time must be above 0")
