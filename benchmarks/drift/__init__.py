"""How well drift is estimated: pairs of scans of known drift, what no estimator can do better, and what ours do.

`python -m benchmarks.drift` measures all of it; `pairs.pair` is the generator.
"""

from __future__ import annotations
