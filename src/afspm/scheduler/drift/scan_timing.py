"""The timing of scans: when the running scan began, and how long a scan will take."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from afspm.model import ScopeState, ScopeStatus

XY = tuple[float, float]
Shape = tuple[int, int]

_KEPT = 16


@dataclass(frozen=True)
class ScanStart:
    """A scan that has begun.

    Attributes:
        time_s: experiment time.
        upwards: direction of its slow axis; None: not known.
        was_paused: not all of its rows followed each other at once.
    """

    time_s: float
    upwards: bool | None
    was_paused: bool = False


class ScanStartTracker:
    """Follows the state. That it scans is told again after a pause, and to a scheduler that was started anew: then the
    scan began before."""

    def __init__(self) -> None:
        self._begun: ScanStart | None = None
        self._is_scanning = False

    def state(self, status: ScopeStatus, time_s: float, upwards: bool | None) -> None:
        """The microscope has told its state; `upwards`: the direction in force. One that is lost scans on."""
        if status.state is ScopeState.UNDEFINED:
            return
        is_new, self._is_scanning = not self._is_scanning, status.state is ScopeState.SCANNING
        if not self._is_scanning:
            return
        if is_new:
            self._begun = ScanStart(time_s, upwards, status.paused is True)
        elif self._begun is not None and status.paused is True:
            self._begun = replace(self._begun, was_paused=True)

    def scan_came(self) -> None:
        """It is over: should it scan on without another state between them, that is the next one."""
        self._is_scanning = False

    def of_scan(self, end_s: float) -> ScanStart | None:
        """That of the scan which ended at a time; None: it is not known."""
        return self._begun if self._begun is not None and self._begun.time_s < end_s else None

    def middle_s(self, end_s: float, expected_s: float) -> float:
        """Return the middle of the scan that ended then: of what was seen, or of as long as is expected."""
        begun = self.of_scan(end_s)
        return end_s - expected_s / 2 if begun is None else (begun.time_s + end_s) / 2


class ScanDurations:
    """Learnt from finished scans; empty again when the speed is set."""

    def __init__(self) -> None:
        self._known: dict[tuple[Shape, XY], float] = {}

    def learn(self, shape: Shape, size_m: XY, duration_s: float) -> None:
        """A scan of this shape and size took so long."""
        key = _key(shape, size_m)
        self._known.pop(key, None)
        self._known[key] = duration_s
        while len(self._known) > _KEPT:
            del self._known[next(iter(self._known))]

    def forget(self) -> None:
        """Another speed was set."""
        self._known.clear()

    def expected_s(self, shape: Shape | None, size_m: XY) -> float:
        """Return the expected duration of a scan; 0 if nothing is known.

        One of another size or shape is reckoned from the latest: its time goes as the length of its lines.
        """
        if not self._known:
            return 0.0
        (known_shape, known_size_m), known_s = next(reversed(self._known.items()))
        if shape is None:
            shape = known_shape
        exact_s = self._known.get(_key(shape, size_m))
        if exact_s is not None:
            return exact_s
        return known_s * (shape[0] * size_m[0]) / (known_shape[0] * known_size_m[0])

    def to_list(self) -> list[list[object]]:
        """As plain JSON."""
        return [[*shape, *size_m, duration_s] for (shape, size_m), duration_s in self._known.items()]

    def restore(self, plain: list[list[Any]]) -> None:
        for rows, columns, width_m, height_m, duration_s in plain:
            self.learn((int(rows), int(columns)), (float(width_m), float(height_m)), float(duration_s))


def _key(shape: Shape, size_m: XY) -> tuple[Shape, XY]:
    """Sizes to six digits: a controller's rounding makes no other scan."""
    return shape, (float(f"{size_m[0]:.6g}"), float(f"{size_m[1]:.6g}"))
