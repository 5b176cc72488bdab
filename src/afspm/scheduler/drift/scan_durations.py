"""How long a scan will take: as long as the last of its kind took."""

from __future__ import annotations

from typing import Any

XY = tuple[float, float]
Shape = tuple[int, int]

_KEPT = 16


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
        """How long a scan will take; 0 if nothing is known.

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

    def to_list(self) -> list[list[Any]]:
        """As plain JSON."""
        return [[*shape, *size_m, duration_s] for (shape, size_m), duration_s in self._known.items()]

    def restore(self, plain: list[list[Any]]) -> None:
        for rows, columns, width_m, height_m, duration_s in plain:
            self.learn((int(rows), int(columns)), (float(width_m), float(height_m)), float(duration_s))


def _key(shape: Shape, size_m: XY) -> tuple[Shape, XY]:
    """Sizes to six digits: a controller's rounding makes no other scan."""
    return shape, (float(f"{size_m[0]:.6g}"), float(f"{size_m[1]:.6g}"))
