"""Samples to scan: generated without bounds, or read from a file."""

from __future__ import annotations

from collections.abc import Mapping

from afspm.basics.errors import ConfigError
from afspm.simulation.settings import build, one_of
from afspm.simulation.surfaces.ground import Flat, Particles, Rough, Steps
from afspm.simulation.surfaces.patterns import Lattice, Stamper
from afspm.simulation.surfaces.picture import PictureSurface
from afspm.simulation.surfaces.relief import Relief, Surface

KINDS: dict[str, type[Surface]] = {
    "steps": Steps,
    "particles": Particles,
    "stamper": Stamper,
    "lattice": Lattice,
    "rough": Rough,
    "flat": Flat,
    "file": PictureSurface,
}

__all__ = ["KINDS", "Relief", "Surface", "surface_from"]


def surface_from(settings: object, where: str = "surface") -> Surface:
    """Create a surface from a table with its `kind` and the settings of that kind.

    Raises:
        ConfigError: an unknown kind or setting, or an invalid value.
        FileError: the surface's file can't be read.
    """
    if isinstance(settings, str):
        settings = {"kind": settings}
    if not isinstance(settings, Mapping):
        raise ConfigError(f"expected a table, got {settings!r}", where=where)
    kind = settings.get("kind", "steps")
    cls = KINDS[one_of(str(kind), KINDS, f"{where}.kind")]
    surface = build(cls, {key: value for key, value in settings.items() if key != "kind"}, where)
    if isinstance(surface, PictureSurface):
        surface.load()
    return surface
