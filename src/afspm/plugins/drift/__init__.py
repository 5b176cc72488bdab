"""Drift: register two scans, track over time, map between tip and sample coordinates.

Estimators, trackers and what stands beside them are pure. `scheduler/` is the coordinate frame of the Drift Compensated
Scheduler with its worker, `study/` simulates many nights, and the other modules are components and commands.

The sign, once and for all: drift D(t) is the displacement of the sample under the tip since the start, so a feature at
`x_sample` is found at `x_tip = x_sample + D(t)`; the mapping M_tot from tip to sample coordinates is the translation by
-D(t) (paper, "Drift Correction Algorithm").
"""

from __future__ import annotations
