"""Limits of what drift can do to an image between two scans."""

from __future__ import annotations

import numpy as np

from afspm.components import Array

_STRETCHED = 2.0  # generous: thermal expansion, creep and shear by drift stay below a few per cent


def unlike_drift(linear: Array) -> str:
    """Return the reason why drift can't cause a given 2 x 2 part between two scans; empty for a plausible part."""
    if np.linalg.det(linear) <= 0.0:
        return f"mirrored or flat: {linear.tolist()}"
    stretches = np.linalg.svd(linear, compute_uv=False)
    if stretches[0] > _STRETCHED or stretches[1] < 1.0 / _STRETCHED:
        return f"stretched by {stretches[0]:.3g} and {stretches[1]:.3g}"
    return ""
