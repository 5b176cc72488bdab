"""The one simulated instrument: world, tip, feedback and noise; its driver; and the rig of all emulated controllers.

**Theory of operation.** A night on it is a function of its settings and its seed. Nothing here has a clock: the
instrument is asked what it is at a time.

    comes in      settings, a seed, commands with their times, faults on demand
    state         the sample, its drift, the tip with its history, what is being measured
    goes out      values of pixels and curves; the truth, which is written beside the record
    always holds  the same seed and commands give the same values; what is simulated is marked so wherever it is shown
"""

from __future__ import annotations

from afspm.simulation.scanning import SimulatedScan
from afspm.simulation.surfaces.picture import Heightmap
from afspm.simulation.tip import TipShape
from afspm.simulation.world import World, WorldSettings

__all__ = ["Heightmap", "SimulatedScan", "TipShape", "World", "WorldSettings"]
