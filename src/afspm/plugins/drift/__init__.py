"""Thermal drift: registration of scans, tracking of drift, and mapping between tip and sample coordinates.

Theory of operation
-------------------

An *estimator* registers a scan with a reference scan and returns the displacement with its covariance
(`registration`). A *tracker* keeps references, combines registrations over time, and predicts where the sample will be
(`tracking`). `mapping` holds the mapping between tip and sample coordinates.

| folder | content |
| --- | --- |
| `estimators/`, `trackers/`, and the modules beside them | pure decisions |
| `scheduler/` | the coordinate frame of the Drift Compensated Scheduler, with its worker |
| `study/` | simulated nights over a grid of settings |
| `figures/` | figures from a record of drift |

The other modules are components and commands.

Sign: drift D(t) is the displacement of the sample under the tip since the start. A feature at `x_sample` is found at
`x_tip = x_sample + D(t)`; the mapping M_tot from tip to sample coordinates is the translation by -D(t) (paper, "Drift
Correction Algorithm").
"""

from __future__ import annotations
