"""Registration by generalised least squares over all pixels (an outline is in `LeastSquares`)."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares import shear
from afspm.drift.estimators.least_squares.acceptance import (
    Evidence,
    Limits,
    above_surrogates,
    agreement,
    outliers,
)
from afspm.drift.estimators.least_squares.align import (
    ALL,
    SHIFT,
    Believed,
    generalised_least_squares,
    least_squares,
)
from afspm.drift.estimators.least_squares.covariance import covariance
from afspm.drift.estimators.least_squares.grid import Grid, onto_common_grid
from afspm.drift.estimators.least_squares.prepare import Image, Unusable, decimated, decimation, prepare
from afspm.drift.estimators.least_squares.rows import without_lines
from afspm.drift.estimators.least_squares.score import Scorer
from afspm.drift.estimators.least_squares.search import PixelPrior, candidates, channels
from afspm.drift.estimators.least_squares.spectra import fine_filtered, shared_information
from afspm.drift.estimators.least_squares.warp import COUNT, LINEAR, Box, Pair, Spline
from afspm.drift.registration import DriftScan, Prior, Registration

Array = NDArray[np.float64]

WIDEST = (0.01, 0.03)  # of what shear and turn are thought possible at first, by x and by y
GAIN_SD = 1.0  # of the logarithm
BEND_SD = 0.15


class LeastSquares:
    """Registers two scans as I2(q + d/2) e^(-g/2) = I1(q - d/2) e^(g/2) + noise with d = u + A q.

    1. `prepare`: rows flattened, outliers cut; scans that hold nothing refused. `grid`: a common pixel.
    2. `search` and `score`: candidates by normalised cross-correlation, the likeliest of them.
    3. `align`: Gauss-Newton, coarse to fine; the fine stage through the filter of `spectra`, weighted by `rows`.
    4. `covariance`: by the jackknife; `shear`: the shift, given what shear is plausible.
    5. `acceptance`: is it a match at all?

    Args:
        limits: what a match must reach.
    """

    def __init__(self, limits: Limits | None = None):
        self._limits = limits or Limits()

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        """See `afspm.drift.registration.Estimator`."""
        images = []
        for name, each in (("reference", reference), ("scan", scan)):
            try:
                images.append(prepare(each.values))
            except Unusable as reason:
                return Registration.refused(f"the {name} can't be registered: {reason}")
        grid, *on_grid = onto_common_grid(reference, images[0], scan, images[1])
        expected = None if prior is None else _pixel_prior(prior, grid)
        return self._match((on_grid[0], on_grid[1]), grid, expected)

    def _match(self, images: tuple[Image, Image], grid: Grid, prior: PixelPrior | None) -> Registration:
        start = _coarse(images, prior)
        if start is None:
            return Registration.refused("the scans overlap too little, or hold nothing in common")
        shift, gap = start
        box = Box.of_overlap(images[0].values.shape, images[1].values.shape, shift)
        if box is None:
            return Registration.refused("the scans overlap too little")
        believed = _believed(prior)
        smooth = _pair((channels(images[0])[0], channels(images[1])[0]), images, box)
        theta = np.concatenate([shift, np.zeros(COUNT - 2)])
        theta = least_squares(smooth, theta, believed, SHIFT, steps=4)
        theta = least_squares(smooth, theta, believed, ALL, steps=4)
        fine = fine_filtered(images)
        fit = generalised_least_squares(_pair((fine[0].values, fine[1].values), images, box), theta, believed)
        theta, total = shear.averaged(fit.theta, covariance(fit, believed), shear.models(), np.zeros(4))
        found = _evidence(images, smooth, theta, total, gap, prior)
        return self._registration(theta, total, box, grid, found, expected=prior is not None)

    def _registration(
        self, theta: Array, total: Array, box: Box, grid: Grid, found: Evidence, *, expected: bool
    ) -> Registration:
        linear = theta[LINEAR].reshape(2, 2)
        reason = self._limits.reason(found, expected=expected)
        return Registration(
            accepted=not reason,
            reason=reason,
            displacement_m=grid.displacement_m(theta[:2]),
            covariance_m2=grid.to_m @ total[:2, :2] @ grid.to_m.T,
            linear=grid.linear_m(linear @ np.linalg.inv(np.eye(2) - linear / 2)),
            center_m=grid.position_m(box.center - theta[:2] / 2),
            quality=asdict(found),
        )


def _coarse(images: tuple[Image, Image], prior: PixelPrior | None) -> tuple[Array, float] | None:
    """The likeliest shift, px, and its gap to the next, nats; on smaller images where they are large."""
    factor = decimation(images)
    small = decimated(images[0], factor), decimated(images[1], factor)
    offset = _cut(images[1], factor) - _cut(images[0], factor)
    scaled = None
    if prior is not None:
        scaled = PixelPrior((prior.mean - offset) / factor, prior.covariance / factor**2 + 0.3 * np.eye(2))
    best = Scorer(small[0], small[1], scaled).best(candidates(small[0], small[1], scaled))
    return None if best is None else (best[0].shift_px * factor + offset, best[1])


def _cut(image: Image, factor: int) -> Array:
    """By how much the centre moves, px, when only whole blocks of `factor` pixels are kept."""
    ny, nx = image.values.shape
    return -np.array([nx % factor, ny % factor]) / 2


def _pair(values: tuple[Array, Array], images: tuple[Image, Image], box: Box) -> Pair:
    return Pair(Spline.of(Image(values[0], images[0].known)), Spline.of(Image(values[1], images[1].known)), box)


def _pixel_prior(prior: Prior, grid: Grid) -> PixelPrior:
    inverse = np.linalg.inv(grid.to_m)
    return PixelPrior(grid.shift_px(prior.mean_m), inverse @ prior.covariance_m2 @ inverse.T)


def _believed(prior: PixelPrior | None) -> Believed:
    mean, precision = np.zeros(COUNT), np.zeros((COUNT, COUNT))
    precision[2:, 2:] = np.diag(1.0 / np.square([*WIDEST, *WIDEST, GAIN_SD, BEND_SD]))
    if prior is not None:
        mean[:2], precision[:2, :2] = prior.mean, np.linalg.inv(prior.covariance)
    return Believed(mean, precision)


def _evidence(
    images: tuple[Image, Image], smooth: Pair, theta: Array, total: Array, gap: float, prior: PixelPrior | None
) -> Evidence:
    one, two, known = smooth.warped(theta)
    one, two = without_lines(one, known), without_lines(two, known)
    edge1, edge2, _ = _pair((channels(images[0])[2], channels(images[1])[2]), images, smooth.box).warped(theta)
    share, correlation = agreement(one, two, known)
    return Evidence(
        overlap=float(known.sum() / min(image.known.sum() for image in images)),
        sd_px=float(np.sqrt(np.linalg.eigvalsh(total[:2, :2])[-1])),
        gap=gap,
        information=shared_information(one, two),
        agreement=share,
        correlation=correlation,
        correlation_gap=above_surrogates(one, two, known),
        edges_gap=above_surrogates(edge1, edge2, known),
        outliers=outliers((two - one)[known]),
        surprise=0.0 if prior is None else prior.surprise(theta[:2], total[:2, :2]),
    )
