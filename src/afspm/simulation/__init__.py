"""The physics behind the simulated microscope: pure, seeded, in SI units and experiment time.

    world = World.from_settings({"surface": {"kind": "steps"}}, seed=1, start_s=0.0)
    scan = world.scan(Region((0.0, 0.0), (1e-6, 1e-6)), (128, 128), line_s=1.0, start_s=0.0)
    unit, height = scan.channels()["Height"]

A feature at `x_sample` is found at `x_tip = world.sample.to_tip(x_sample, t)`; that is
`x_sample + world.drift_m(t)` where the sample neither turns nor expands.
"""

from __future__ import annotations

from afspm.simulation.scanning import SimulatedScan
from afspm.simulation.surfaces.picture import Heightmap
from afspm.simulation.tip import TipShape
from afspm.simulation.world import World, WorldSettings

__all__ = ["Heightmap", "SimulatedScan", "TipShape", "World", "WorldSettings"]
