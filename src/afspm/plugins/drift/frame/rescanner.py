"""`Rescanner`: takes the rescans that the Drift Compensated Scheduler requests (paper, "Overarching Workflow")."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, ClassVar

from afspm import Component, Events, wire
from afspm.basics import ConfigError, ControlLost, Refused
from afspm.model import Problem, Region, RescanKind, ScanParameters, names

if TYPE_CHECKING:
    from afspm.wire.messages import DriftRescan

WANTED, MAPPINGS = "DriftRescan", "DriftMapping"
FLAGGED_WITHIN_S = 5.0
BACK_WITHIN_S = 60.0
_PIXELS_AT_ONCE = 16
_FRAME_BEFORE = "frame_before"
Pixels = tuple[int, int] | None

_IN_WORDS: dict[int, str] = {
    RescanKind.AGAIN: "the same region again",
    RescanKind.OPPOSITE: "the other direction",
    RescanKind.SEARCH: "a wider region",
}


class Rescanner(Component):
    """A component that scans a region again on a `DriftRescan`: unchanged, in the other direction, or wider.

    During a rescan thermal-drift is flagged, so that no other component scans. If no attempt succeeds, the component
    logs the failure and the experiment goes on. If a search does not find the sample, the component flags
    device-malfunction, which a person must clear.

    Args:
        attempts: largest number of scans for one request; a request for the other direction allows one scan.
        widen: factor from the requested region to the first search region, and from each search region to the next.
        most_pixels: largest side of a search region in pixels; up to this bound the pixel size stays.
        problem: problem that the component flags and solves.
    """

    solves: ClassVar = ("thermal-drift",)
    flags: ClassVar = ("thermal-drift", "device-malfunction")
    listens: ClassVar = (WANTED, MAPPINGS)
    needs_actions = (names.START_SCAN,)

    def __init__(
        self, attempts: int = 3, widen: float = 2.0, most_pixels: int = 512, problem: str = "thermal-drift"
    ) -> None:
        if attempts < 1 or not widen > 1.0 or most_pixels < 2:
            raise ConfigError(
                "attempts must be at least 1, widen above 1, most_pixels at least 2; they are "
                f"{attempts}, {widen}, {most_pixels}"
            )
        self.attempts, self.widen, self.most_pixels = attempts, widen, most_pixels
        self.problem = problem

    def run(self) -> None:
        with self.scope.events(WANTED) as wanted, self.scope.events(MAPPINGS, timeout_s=0.0) as mappings:
            self._restore_after_lost_control()
            for event in wanted:
                if event.message.timestamp.ToNanoseconds() <= int(self.memory.get("done_ns", -1)):
                    continue  # answers a rescan of this component, or is from before a restart
                try:
                    self._rescan(event.message, mappings)
                except ControlLost as lost:
                    self.log.info("the rescan was given up: %s", lost.what)
                self._restore_after_lost_control()
                self.memory["done_ns"] = self.clock.now_ns()
                self.memory.save()

    def _rescan(self, message: DriftRescan, mappings: Events) -> None:
        parameters: ScanParameters = wire.decode("ScanParameters2d", message.params.SerializeToString())
        if not isinstance(parameters.region, Region):
            self.log.error("a request for a rescan names no region: %s", message.reason)
            return
        kind = int(message.kind)
        self.log.info("%s: %s", _IN_WORDS.get(kind, "a scan"), message.reason)
        if not self._is_flagged():
            self.scope.flag(self.problem)
            self.scope.wait_until(self._is_flagged, timeout_s=FLAGGED_WITHIN_S)
        with self.scope.control(solving=self.problem):
            optional = kind == RescanKind.OPPOSITE
            try:
                found = self._scan_as_requested(message, parameters, mappings)
            except Refused as refused:
                level = logging.INFO if optional else logging.ERROR
                self.log.log(level, "the rescan was refused: %s", refused.reason)
                found = False
            if not found and optional:
                self.log.info("the velocity of drift stays unknown until the second scan")
            elif not found and kind == RescanKind.SEARCH:
                # before the other flag is cleared, so that no component scans in between
                self.log.critical(
                    "the sample can't be found again; nothing is scanned until a person clears the problem"
                )
                self.scope.flag(Problem.DEVICE_MALFUNCTION)
            elif not found:
                self.log.error("%d rescans did not help; the experiment goes on, please check it", self.attempts)
            self.scope.clear(self.problem)

    def _scan_as_requested(self, message: DriftRescan, parameters: ScanParameters, mappings: Events) -> bool:
        # changed settings are restored after success and failure alike
        region, shape, kind = parameters.region, parameters.shape, int(message.kind)
        assert isinstance(region, Region)
        assert shape is None or isinstance(shape, tuple)
        try:
            if kind == RescanKind.SEARCH:  # saved, so that it is also restored after a kill
                self.memory.setdefault(_FRAME_BEFORE, [*region.center_m, *region.size_m, region.angle_rad, shape])
                self.memory.save()
            settings = self.scope.settings_of()  # like is registered with like
            if message.HasField("upwards"):
                settings[names.SCAN_DIRECTION] = names.UP if message.upwards else names.DOWN
            with self.scope.settings(settings):
                for attempt in range(1 if kind == RescanKind.OPPOSITE else self.attempts):
                    self._drop_waiting(mappings)
                    if kind == RescanKind.SEARCH:
                        self._search(region, shape, attempt + 1)
                    else:
                        self.scope.scan(region, shape=shape)
                    if self._is_accepted(kind, mappings):
                        return True
            return False
        finally:
            self._restore_frame()

    def _restore_frame(self) -> None:
        if (frame := self.memory.get(_FRAME_BEFORE)) is not None:
            self._restore_region(*frame)
            self.memory.pop(_FRAME_BEFORE)
        self.memory.save()

    def _restore_after_lost_control(self) -> None:
        # control may be lost before the restoration, when another component clears the drift
        if _FRAME_BEFORE not in self.memory:
            return
        try:
            with self.scope.control(timeout_s=BACK_WITHIN_S):
                self._restore_frame()
        except (ControlLost, Refused) as error:
            self.log.warning("the region of the scans before could not be set again: %s", error.what)

    def _search(self, region: Region, shape: Pixels, times: int) -> None:
        # a wider region, at most the widest that limits and scanner allow
        for fewer in range(times, -1, -1):
            wider, pixels = self._wider(region, shape, fewer)
            try:
                self.scope.scan(wider, shape=pixels)
            except Refused as refused:
                if fewer == 0:
                    raise
                self.log.warning(
                    "a region of %.3g nm was refused, trying a smaller one: %s", wider.size_m[0] * 1e9, refused.reason
                )
            else:
                return

    def _wider(self, region: Region, shape: Pixels, times: int) -> tuple[Region, Pixels]:
        factor = self.widen**times
        width, height = region.size_m
        wider = Region(region.center_m, (width * factor, height * factor), region.angle_rad)
        if shape is None:
            return wider, None
        rows, columns = (self._more_pixels(n, factor) for n in shape)
        return wider, (rows, columns)

    def _more_pixels(self, n: int, factor: float) -> int:
        # a controller that takes multiples of 16 pixels has taken n
        step = math.gcd(n, _PIXELS_AT_ONCE)
        return min(round(((n - 1) * factor + 1) / step), max(self.most_pixels, n) // step) * step

    def _restore_region(
        self, x: float, y: float, width: float, height: float, angle: float, shape: list[int] | None
    ) -> None:
        rows_columns = None if shape is None else (shape[0], shape[1])
        try:
            self.scope.set_scan_region(Region((x, y), (width, height), angle), shape=rows_columns)
        except Refused as refused:
            self.log.warning("the region of the scans before could not be set again: %s", refused.reason)

    def _is_accepted(self, kind: int, mappings: Events) -> bool:
        # the mapping of a scan is published right before it
        mapping = None
        for event in mappings:
            mapping = event.message
        if mapping is None:
            self.log.warning("the scheduler reported no drift for the scan")
            return False
        is_enough = kind in (RescanKind.OPPOSITE, RescanKind.SEARCH)  # these need not be exactly at the place
        return bool(mapping.matched and not mapping.lost and (is_enough or not mapping.rescan))

    def _drop_waiting(self, mappings: Events) -> None:
        for _ in mappings:
            pass

    def _is_flagged(self) -> bool:
        return self.scope.is_flagged(self.problem)
