"""A scan drawn with matplotlib: as an image, as contour lines or as a surface (needs the extra `plot`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from afspm.errors import InvalidValue

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from afspm.model.scan import Scan

KINDS: Final = ("image", "contour", "surface")
_LEVELS: Final = 12
_COLOURS: Final = "afmhot"


def draw(scan: Scan, kind: str = "image", axes: Axes | None = None) -> Axes:
    """Draw a scan; see `Scan.plot`."""
    if kind not in KINDS:
        raise InvalidValue(f"a scan can't be drawn as {kind!r}", hint=f"one of {', '.join(KINDS)}")
    if not scan.values.size or not np.isfinite(scan.values).any():
        raise InvalidValue(f"the scan {scan.channel!r} has no values to draw")
    import matplotlib.pyplot as plt

    if axes is None:
        axes = plt.figure().add_subplot(projection="3d" if kind == "surface" else None)
    ny, nx = scan.shape
    (left, low), (width, height) = scan.region.top_left_m, scan.region.size_m
    x, y = (
        1e9 * np.linspace(start, start + size, count) for start, size, count in ((left, width, nx), (low, height, ny))
    )
    values = np.ma.masked_invalid(scan.values)
    given: Any = axes
    if kind == "surface":
        drawn = given.plot_surface(*np.meshgrid(x, y), values, cmap=_COLOURS)
        given.set_zlabel(f"{scan.channel} [{scan.unit}]")
    else:
        drawn = (
            given.contour(x, y, values, _LEVELS, cmap=_COLOURS)
            if kind == "contour"
            else given.pcolormesh(x, y, values, cmap=_COLOURS)
        )
        given.set_aspect("equal")
        given.figure.colorbar(drawn, ax=given, label=f"{scan.channel} [{scan.unit}]")
    given.set_xlabel("x [nm]")
    given.set_ylabel("y [nm]")
    return axes
