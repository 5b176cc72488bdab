"""The simulated instrument: world, tip, feedback and noise; its driver; and the base of all emulated controllers.

**Theory of operation.** A simulated night is a function of its settings and its seed. The physics has no clock: every
call passes the time.

    inputs        settings, a seed, commands with their times, faults on demand
    state         the sample, its drift, the tip with its history, the present activity
    outputs       values of pixels and curves; the ground truth, written beside the record
    invariant     the same seed and commands give the same values; simulated data are marked wherever they are shown
"""

from __future__ import annotations

from afspm.simulation.scanning import SimulatedScan
from afspm.simulation.surfaces.picture import Heightmap
from afspm.simulation.tip import TipShape
from afspm.simulation.world import World, WorldSettings

__all__ = ["Heightmap", "SimulatedScan", "TipShape", "World", "WorldSettings"]
