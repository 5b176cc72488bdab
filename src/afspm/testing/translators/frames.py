"""The frames that checks set: parts of the frame that is set at the beginning, and nothing outside of it.

Whoever runs the checks has chosen that frame, and knows that the probe may go there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from afspm.model import Region, RegionChange, ScanParameters, names

if TYPE_CHECKING:
    from afspm.testing.translators.support import Support

NEAR = 1e-3
"""Of a frame's size: closer than that is the same. Half a pixel of the largest frame here is more."""
TURN_RAD = math.radians(20.0)


@dataclass(frozen=True)
class Frame:
    """A region and its pixels, (rows, columns)."""

    region: Region
    shape: tuple[int, int]

    def request(self, support: Support) -> ScanParameters:
        """What to ask for; without the angle, where the microscope has none."""
        (left, low), (width, height) = self.region.top_left_m, self.region.size_m
        angle = self.region.angle_rad if support.has(names.SCAN_ANGLE) else None
        return ScanParameters(RegionChange(left, low, width, height, angle), self.shape)


@dataclass(frozen=True)
class Frames:
    """The frames of one pass. Columns are multiples of 16: some controllers take no others.

    Attributes:
        whole: as it was set at the beginning.
    """

    whole: Region

    @property
    def plain(self) -> Frame:
        """Square, beside the middle in both directions."""
        return self._part((0.1, -0.15), (0.5, 0.5), (32, 32))

    @property
    def other(self) -> Frame:
        """Square as well, elsewhere and smaller."""
        return self._part((-0.2, 0.2), (0.3, 0.3), (32, 32))

    @property
    def wide(self) -> Frame:
        """Twice as wide as high, and of other pixels."""
        return self._part((-0.1, 0.15), (0.6, 0.3), (16, 64))

    @property
    def turned(self) -> Frame:
        """Turned counter-clockwise."""
        return self._part((0.1, 0.05), (0.5, 0.4), (32, 48), TURN_RAD)

    def _part(
        self, offset: tuple[float, float], size: tuple[float, float], shape: tuple[int, int], turn_rad: float = 0.0
    ) -> Frame:
        """`offset` of the middle and `size` in units of the whole, in its own directions."""
        width, height = self.whole.size_m
        side = min(width, height)
        cos, sin = math.cos(self.whole.angle_rad), math.sin(self.whole.angle_rad)
        right, up = offset[0] * side, offset[1] * side
        x, y = self.whole.center_m
        center = (x + cos * right - sin * up, y + sin * right + cos * up)
        return Frame(Region(center, (size[0] * side, size[1] * side), self.whole.angle_rad + turn_rad), shape)


def difference(expected: Region, came: Region) -> str:
    """In which respect two regions differ; empty where they are the same to a controller's precision."""
    size = math.hypot(*expected.size_m)
    if math.dist(expected.size_m, came.size_m) > NEAR * size:
        return f"a size of {in_words(came.size_m)} instead of {in_words(expected.size_m)}"
    turned = math.remainder(came.angle_rad - expected.angle_rad, math.tau)
    if abs(turned) > NEAR:
        return f"an angle of {math.degrees(came.angle_rad):.4g}° instead of {math.degrees(expected.angle_rad):.4g}°"
    if math.dist(expected.center_m, came.center_m) > NEAR * size:
        moved = tuple(b - a for a, b in zip(expected.center_m, came.center_m, strict=True))
        of_size = ", ".join(f"{m / s:+.2f}" for m, s in zip(moved, expected.size_m, strict=True))
        return (
            f"a centre at {in_words(came.center_m)} instead of {in_words(expected.center_m)}: off by ({of_size}) frames"
        )
    return ""


def in_words(xy_m: tuple[float, float]) -> str:
    """Two lengths, in nm."""
    return "({:.6g}, {:.6g}) nm".format(*(value * 1e9 for value in xy_m))
