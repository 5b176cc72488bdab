"""An estimator of drift, for a sample that never moves."""

from __future__ import annotations

import numpy as np

from afspm.plugins.drift.registration import DriftScan, Prior, Registration


class Standstill:
    """Reports no movement, to within a nanometre."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        """Return a displacement of zero at the middle of the reference."""
        center_m = np.array(reference.region.center_m)
        return Registration(True, "", np.zeros(2), np.eye(2) * 1e-18, np.zeros((2, 2)), center_m)
