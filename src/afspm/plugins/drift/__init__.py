"""Thermal drift: registration of scans, tracking of drift, and mapping between tip and sample coordinates.

Theory of operation
-------------------

The folders are in the order in which the data goes, and a module imports only its own folder and those before it
(import-linter checks this). `docs/explanation/drift.md` draws the stages, with units and signs.

| folder | content |
| --- | --- |
| `pairs/` | two scans on one pixel grid, levelled, freed from spikes; overlap of regions; noise of lines |
| `registration/` | the result of a registration, the interface of all estimators, and the fits |
| `doubt/` | the covariance of a fit, and the probability that its match is wrong |
| `estimators/` | fits joined with their doubt, by name; your own are found here too |
| `track/` | trackers by name: drift, its rate and its forecast from many registrations; the mapping M_tot |
| `frame/` | the coordinate frame of the Drift Compensated Scheduler, its worker, and the Rescanner |
| `report/` | components, figures, tables and commands for a night or recorded files |
| `study/` | simulated nights over a grid of settings |

`commands` is the command line `afspm drift`, `workers` the execution of many registrations or nights on all cores. The
folders from `pairs/` to `track/` are pure decisions.

Sign: drift D(t) is the displacement of the sample under the tip since the start. A feature at `x_sample` is found at
`x_tip = x_sample + D(t)`; the mapping M_tot from tip to sample coordinates is the translation by -D(t) (paper, "Drift
Correction Algorithm").
"""

from __future__ import annotations
