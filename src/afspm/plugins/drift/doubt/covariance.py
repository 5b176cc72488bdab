"""Covariance of an alignment, enlarged by the signs that it is less certain than its noise model claims."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from afspm.components import Array
from afspm.plugins.drift.doubt.coefficients import DOUBT, SPREAD
from afspm.plugins.drift.pairs.images import Unusable
from afspm.plugins.drift.registration.alignment import Believed, Fit

FLOOR_PX = 1e-3
CLEAR_PX = 0.02  # a shift known better than this is as certain as its model says
EVEN = 0.2  # usual share of the information in one block of rows
LAGS = 2
"""Neighbours of a block of 8 rows that may wander with it.

With blocks of 16 rows as independent ones, pairs whose lines wander by 0.2 px over 16 rows had three times the variance
that was given."""


@dataclass(frozen=True)
class Doubt:
    """Signs that a shift is less certain than its noise model claims.

    Attributes:
        varied: variance of the shift when blocks of the image are left out in turn, over the model's variance, with the
            covariance of neighbouring blocks.
        shared: standard deviation of the shift, over its value if the rest of theta were known: unmodelled shear, creep
            and contrast act on the shift as well.
        sd_px: largest standard deviation by the model: the weaker the features, the more disturbances count.
        leverage: largest share, in any direction, of the information about the shift in one block of rows (MacKinnon,
            Nielsen and Webb, J. Econometrics 235, 2001, 2023). A disturbance of these rows does not average out, and
            remains unnoticed.
    """

    varied: float
    shared: float
    sd_px: float
    leverage: float

    def features(self) -> dict[str, float]:
        """Return the signs as logarithms, which are 0 without doubt."""
        return {
            "varied": math.log(max(self.varied, 1.0)),
            "shared": math.log(max(self.shared, 1.0)),
            "unclear": math.log(max(self.sd_px / CLEAR_PX, 1.0)),
            "leverage": math.log(max(self.leverage / EVEN, 1.0)),
        }

    @property
    def spread(self) -> float:
        """Factor on the model's covariance, fitted to pairs with and without lines that wander.

        The factor has no upper limit: where lines wander by a pixel, the variance is a thousand times the model's.
        """
        return self._factor(DOUBT)

    @property
    def spread_of_evidence(self) -> float:
        """Factor on the model's covariance in the evidence for a match, fitted to pairs without wander.

        Lines that wander make a match uncertain by a part of a pixel, but no more likely to be wrong. The factor is
        limited to the range of the fit.
        """
        return min(self._factor(SPREAD), SPREAD["most"])

    def _factor(self, table: Mapping[str, float]) -> float:
        return table["all"] * math.exp(sum(table[name] * value for name, value in self.features().items()))


def covariance(fit: Fit, believed: Believed) -> tuple[Array, Doubt]:
    """Return the covariance (COUNT, COUNT) of theta, enlarged by `Doubt.spread`, and the doubt.

    The covariance by the model is (M + P)^-1 (H'QH + P) (M + P)^-T with the curvature M = H'QJ and the precision P of
    the prior (White, Econometrica 50, 1, 1982).

    The variance of the shift with blocks left out is the cluster jackknife (CV3; MacKinnon, Nielsen and Webb,
    J. Appl. Econom. 38, 671, 2023), which allows for noise that is correlated within a block, and within `LAGS` blocks.
    A few blocks hold most of the features, so this variance scatters widely and is only one of the signs.

    Raises:
        Unusable: theta is not finite.
    """
    if not np.isfinite(fit.theta).all():
        raise Unusable("without a displacement that fits")
    used = np.abs(fit.curvature).max(axis=(1, 2)) > 0.0
    whole = fit.curvature.sum(axis=0) + believed.precision
    inverse = np.linalg.inv(whole)
    model = inverse @ (fit.spread.sum(axis=0) + believed.precision) @ inverse.T
    change = np.linalg.solve(whole - fit.curvature[used], fit.slope[used][:, :, None])[:, :, 0]
    n = max(len(change), 1)
    varied = _long_run(change) * (n - 1) / n + inverse @ believed.precision @ inverse.T
    model = (model + model.T) / 2
    shift, alone = model[:2, :2], whole[:2, :2]
    doubt = Doubt(
        varied=float(np.trace(np.linalg.solve(shift, varied[:2, :2]))) / 2,
        shared=abs(float(np.linalg.det(shift) * np.linalg.det(alone))) ** 0.25,
        sd_px=math.sqrt(float(np.linalg.eigvalsh(shift)[-1])),
        leverage=float(np.linalg.eigvals(np.linalg.solve(alone, fit.curvature[:, :2, :2])).real.max()),
    )
    return enlarged(model, doubt.spread), doubt


def _long_run(change: Array) -> Array:
    # with the weights of Bartlett it is never negative (Newey and West, Econometrica 55, 703, 1987)
    total = change.T @ change
    for lag in range(1, min(LAGS + 1, len(change))):
        across = change[lag:].T @ change[:-lag]
        total += (1.0 - lag / (LAGS + 1)) * (across + across.T)
    return np.asarray(total)


def enlarged(model: Array, factor: float) -> Array:
    """Return a covariance of theta, or of its shift, times a factor; the shift is known to `FLOOR_PX` at best."""
    total: Array = factor * model
    total[:2, :2] += FLOOR_PX**2 * np.eye(2)
    return total
