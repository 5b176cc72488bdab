"""Covariance of an alignment: its noise model, and the scatter of its result without some blocks of rows.

The covariance of a shift is of the mean displacement of the sample under the tip over the rows of the overlap, during
these two frames: not of the sample between two times. Lines wander (vibration, hysteresis, creep, thermal motion), and
their mean over a frame moves the whole picture as drift does. No pair of scans can tell one from the other. So the mean
counts as displacement (`mean_over_rows`), and a tracker adds what its models of motion say of it. The covariance thus
does not depend on the spectrum of the wander, below or above a frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from afspm.components import Array
from afspm.plugins.drift.doubt.coefficients import SPREAD
from afspm.plugins.drift.pairs.images import Unusable
from afspm.plugins.drift.pairs.warp import LINEAR
from afspm.plugins.drift.registration.alignment import Believed, Fit

FLOOR_PX = 2e-3
"""Least standard deviation: errors of interpolation and of the shape of noise, which no scatter of blocks shows."""
ALIASED_PX = 0.05
"""Standard deviation by features finer than two pixels, times `FineFilter.sharpness`: they fold onto lower frequencies.

On sharp pictures of the second generator (sharpness 0.13 to 0.22) and of another program (0.06 to 0.5) errors are 0.006
to 0.016 px, where the rest of the covariance gives 0.003. A picture blurred over two pixels has a sharpness of 0.01."""
REACH_PX = 2.0
"""Largest displacement of a block of rows from the shift: beyond, a linear step fails on rows with few features. In a
scan of lead titanate such rows gave 66 px, and moved the mean by 1.7 px."""
CLEAR_PX = 0.02  # a shift known better than this is as certain as its model says
EVEN = 0.2  # usual share of the information in one block of rows
LAGS = 2
"""Neighbours of a block of 8 rows that may wander with it.

With blocks of 16 rows as independent ones, pairs whose lines wander by 0.2 px over 16 rows had three times the variance
that was given."""
OF_MODEL, OF_BLOCKS, BY_LEVERAGE = 3.0, 0.8, 0.8
"""Factors on both parts of a shift's covariance, and exponent of `leverage`: chosen on pairs of three programs."""
LINEAR_OF_MODEL, LINEAR_BY_VARIED, LINEAR_BY_LEVERAGE = 2.0, 1.27, 0.64
"""Factor on the model's covariance of the linear part, and its exponents.

A trend of the wander over a frame is no steady drift of the sample, and the whole variance of the blocks counts, which
four times `Doubt.blocks` would give, too: but a factor of the model scatters less, and stays smaller without wander.
Squares of errors over this variance are 1.0 on average for pairs of the families with wander, and 0.5 without."""


@dataclass(frozen=True)
class Doubt:
    """Signs that a shift is less certain than its noise model claims.

    Attributes:
        varied: trace of `blocks` over the model's covariance, per direction.
        shared: standard deviation of the shift, over its value if the rest of theta were known: unmodelled shear, creep
            and contrast act on the shift as well.
        sd_px: largest standard deviation by the model: the weaker the features, the more disturbances count.
        leverage: largest share, in any direction, of the information about the shift in one block of rows (MacKinnon,
            Nielsen and Webb, J. Econometrics 235, 2001, 2023). A disturbance of these rows does not average out, and
            remains unnoticed.
        blocks: (COUNT, COUNT) covariance of theta when blocks of rows are left out in turn, with the covariance of
            neighbouring blocks. In a direction in which lines do not wander it is as small as the model's.
        sharpness: of both scans; see `FineFilter`.
    """

    varied: float
    shared: float
    sd_px: float
    leverage: float
    blocks: Array
    sharpness: float

    def features(self) -> dict[str, float]:
        """Return the signs as logarithms, which are 0 without doubt."""
        return {
            "varied": math.log(max(self.varied, 1.0)),
            "shared": math.log(max(self.shared, 1.0)),
            "unclear": math.log(max(self.sd_px / CLEAR_PX, 1.0)),
            "leverage": math.log(max(self.leverage / EVEN, 1.0)),
        }

    @property
    def spread_of_evidence(self) -> float:
        """Factor on the model's covariance in the evidence for a match, fitted to pairs without wander.

        Lines that wander make a match uncertain by a part of a pixel, but no more likely to be wrong. The factor is
        limited to the range of the fit.
        """
        doubts = sum(SPREAD[name] * value for name, value in self.features().items())
        return min(SPREAD["all"] * math.exp(doubts), SPREAD["most"])

    def shift(self, model: Array) -> Array:
        """Return the covariance (2, 2) of the shift, given the model's covariance of theta."""
        factor = max(self.leverage / EVEN, 1.0) ** BY_LEVERAGE
        total: Array = factor * (OF_MODEL * model + OF_BLOCKS * self.blocks)[:2, :2]
        return total + (FLOOR_PX**2 + (ALIASED_PX * self.sharpness) ** 2) * np.eye(2)

    def linear(self, model: Array) -> Array:
        """Return the covariance (4, 4) of the linear part, given the model's covariance of theta."""
        leverage = max(self.leverage / EVEN, 1.0) ** LINEAR_BY_LEVERAGE
        total: Array = LINEAR_OF_MODEL * max(self.varied, 1.0) ** LINEAR_BY_VARIED * leverage * model[LINEAR, LINEAR]
        return total


def covariance(fit: Fit, believed: Believed, sharpness: float) -> tuple[Array, Doubt]:
    """Return the covariance (COUNT, COUNT) of theta by the model, and the doubt.

    The covariance by the model is (M + P)^-1 (H'QH + P) (M + P)^-T with the curvature M = H'QJ and the precision P of
    the prior (White, Econometrica 50, 1, 1982).

    The covariance with blocks left out is the cluster jackknife (CV3; MacKinnon, Nielsen and Webb,
    J. Appl. Econom. 38, 671, 2023), which allows for noise that is correlated within a block, and within `LAGS` blocks.

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
    model, varied = (model + model.T) / 2, (varied + varied.T) / 2
    shift, alone = model[:2, :2], whole[:2, :2]
    doubt = Doubt(
        varied=float(np.trace(np.linalg.solve(shift, varied[:2, :2]))) / 2,
        shared=abs(float(np.linalg.det(shift) * np.linalg.det(alone))) ** 0.25,
        sd_px=math.sqrt(float(np.linalg.eigvalsh(shift)[-1])),
        leverage=float(np.linalg.eigvals(np.linalg.solve(alone, fit.curvature[:, :2, :2])).real.max()),
        blocks=varied,
        sharpness=sharpness,
    )
    return model, doubt


def mean_over_rows(fit: Fit) -> Array:
    """Return the mean displacement over the rows of the overlap minus the fitted shift, (2,) in px.

    Least squares weighs rows by their features. Where lines wander or the sample relaxes, its shift is the displacement
    of the rows with the most features. Slope and curvature of a block of rows give the displacement of the block; with
    few features it is drawn towards the shift, by the variance of the displacement over all blocks.
    """
    slope = fit.slope[:, :2]
    curvature, noise = (
        np.maximum(np.diagonal(each[:, :2, :2], axis1=1, axis2=2), 0.0) for each in (fit.curvature, fit.spread)
    )
    slope = slope - curvature * (slope.sum(axis=0) / np.maximum(curvature.sum(axis=0), 1e-300))  # less the prior's pull
    squares = np.maximum((curvature**2).sum(axis=0), 1e-300)
    variance = np.maximum((slope**2 - noise).sum(axis=0) / squares, 0.0)
    moved = variance * curvature * slope / np.maximum(noise + variance * curvature**2, 1e-300)
    return np.asarray(-np.clip(moved, -REACH_PX, REACH_PX).mean(axis=0))


def _long_run(change: Array) -> Array:
    # with the weights of Bartlett it is never negative (Newey and West, Econometrica 55, 703, 1987)
    total = change.T @ change
    for lag in range(1, min(LAGS + 1, len(change))):
        across = change[lag:].T @ change[:-lag]
        total += (1.0 - lag / (LAGS + 1)) * (across + across.T)
    return np.asarray(total)
