"""Adaptive maps: spectra where a map of a quantity is still uncertain, at the least cost in seconds.

**Theory of operation.** An optimiser suggests positions, the component takes a spectrum at each, evaluates it, and
returns the value with its time. The protocol of optimisers comes from bluesky-adaptive 1.0 (`suggest`, `ingest`, and if
there are any `register_failures`, `should_stop`), so its Ax and Xopt backends fit, and any of your own.

| module | content |
| --- | --- |
| `gaussian_process` | the map and its expected error, from values with their times; also the drift of the sample |
| `refinement` | the optimisers: the largest variance per second, or complete nested lattices |
| `quantities` | from a curve to a number |
| `mapping` | the loop, for the component and for scripts |
| `adaptive`, `map_picture` | the component, and its picture |

The first two are pure: the same measurements give the same suggestions. Invariants: a position is suggested once; the
component's memory suffices to continue after a kill, since a map follows from its measurements alone.
"""

from __future__ import annotations

from afspm.plugins.adaptive.adaptive import Adaptive
from afspm.plugins.adaptive.mapping import MapProgress, measure_map
from afspm.plugins.adaptive.refinement import AdaptiveMap, NestedGrid, Optimizer

__all__ = ["Adaptive", "AdaptiveMap", "MapProgress", "NestedGrid", "Optimizer", "measure_map"]
