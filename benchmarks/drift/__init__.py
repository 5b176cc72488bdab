"""Accuracy of drift estimation: pairs of scans with known drift, bounds for any estimator, and the estimators' errors.

`python -m benchmarks.drift` measures all of it; `pairs.pair` is the generator.
"""

from __future__ import annotations
