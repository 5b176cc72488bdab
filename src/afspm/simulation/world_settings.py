"""The settings of a whole world, and what suits each kind of sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from afspm.errors import ConfigError, ErrorCollector
from afspm.simulation import spectra
from afspm.simulation.drift import DriftSettings
from afspm.simulation.feedback import FeedbackSettings
from afspm.simulation.noise import NoiseSettings
from afspm.simulation.scanning import ScannerSettings
from afspm.simulation.settings import build, nearest
from afspm.simulation.signals import SignalSettings
from afspm.simulation.surfaces import surface_from
from afspm.simulation.tip import TipChangeSettings, TipSettings

# What suits a sample better than the general defaults; the user's settings go on top.
_FITTING: dict[str, dict[str, dict[str, Any]]] = {
    # Atoms are seen by the foremost atom of the tip, not by its apex as a whole.
    "lattice": {
        "tip": {"radius_m": 0.12e-9, "half_angle_deg": 35.0},
        "noise": {"white_m": 3e-12, "one_over_f_m": 3e-12, "line_offset_m": 3e-12, "scar_m": 0.05e-9},
        "feedback": {"mode": "current", "setpoint": 100e-12},
    },
    "steps": {"tip": {"second_below_radii": 0.015, "debris_radii": 1.0, "length_jump_radii": 0.1}},
    "stamper": {
        # Bumps this large only show what is wrong with a tip when that is large as well.
        "tip": {"blunt_radii": 18.0, "second_distance_radii": 30.0, "second_below_radii": 2.0, "debris_radii": 4.0},
        "noise": {"white_m": 0.3e-9, "one_over_f_m": 0.5e-9, "line_offset_m": 0.5e-9, "scar_m": 8e-9},
    },
    "particles": {"noise": {"white_m": 0.2e-9, "one_over_f_m": 0.2e-9, "line_offset_m": 0.2e-9, "scar_m": 4e-9}},
}


@dataclass(frozen=True)
class WorldSettings:
    """All but the surface, which has settings of its kind."""

    tip: TipSettings = field(default_factory=TipSettings)
    tip_changes: TipChangeSettings = field(default_factory=TipChangeSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    feedback: FeedbackSettings = field(default_factory=FeedbackSettings)
    scanner: ScannerSettings = field(default_factory=ScannerSettings)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    signals: SignalSettings = field(default_factory=SignalSettings)
    iv: spectra.IVSettings = field(default_factory=spectra.IVSettings)
    force: spectra.ForceSettings = field(default_factory=spectra.ForceSettings)


def read_settings(settings: Mapping[str, Any]) -> tuple[object, WorldSettings]:
    """The surface's table and the rest, from one table of all.

    Raises:
        ConfigError: unknown names or values without sense, of all tables at once; FileError: the surface's file.
    """
    tables = dict(settings)
    names = ["surface", *WorldSettings.__dataclass_fields__]
    errors = ErrorCollector()
    for name in [name for name in tables if name not in names]:
        errors.add(ConfigError(f"no setting named {name!r}", where=f"simulation.{name}", hint=nearest(name, names)))
        del tables[name]
    surface = tables.pop("surface", "steps")
    kind = surface.get("kind", "steps") if isinstance(surface, Mapping) else surface
    for name, fitting in _FITTING.get(str(kind), {}).items():
        own = tables.get(name, {})
        tables[name] = {**fitting, **own} if isinstance(own, Mapping) else own
    with errors:
        built = build(WorldSettings, tables, "simulation")
    if errors.errors:
        with errors:  # else it is made later
            surface_from(surface)
    errors.raise_all()
    return surface, built
