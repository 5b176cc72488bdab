"""Studies of drift: simulated nights over a grid of settings, on this computer's cores or a Dask cluster.

settings = NightSettings.of({"tracker": "paper", "paper.queue": 3})
metrics = night(settings, seed=1)
"""

from __future__ import annotations

from afspm.plugins.drift.workers import TaskOutcome, on_cores
from afspm_lab.study.cluster import on_cluster
from afspm_lab.study.grid import SettingsGrid
from afspm_lab.study.night import SimulatedNight, night
from afspm_lab.study.settings import NightSettings
from afspm_lab.study.summary import Summary, summarised

__all__ = [
    "NightSettings",
    "SettingsGrid",
    "SimulatedNight",
    "Summary",
    "TaskOutcome",
    "night",
    "on_cluster",
    "on_cores",
    "summarised",
]
