"""Registration by generalised least squares over all pixels (outline: `LeastSquares`).

Quintic splines in the last fit take 5 % more time than cubic ones, and errors are 13 % smaller on clear pairs (half on
lattices), 6 % on pairs like real ones, 2 % on hard ones. Tried without effect on the errors (at most 2 %): the true
noise of each row; weights that fall faster for rows that fit badly; larger patches where gradients are shrunk. Given
the gradient without noise, the fit reached 1.20 times the bound instead of 1.35: most of the rest is that the surface
must be learnt from the same two noisy scans.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from afspm.basics import ConfigError
from afspm.components import Array
from afspm.plugins.drift.doubt.acceptance import NARROW, WRONG_AT_MOST, MatchEvidence, above_repeats, agreement, texture
from afspm.plugins.drift.doubt.covariance import Doubt, covariance, mean_over_rows
from afspm.plugins.drift.doubt.nuisances import CREEP_SD_PX, Shear, averaged
from afspm.plugins.drift.pairs.images import CommonGrid, Unusable, onto_common_grid, prepare
from afspm.plugins.drift.pairs.noise import CrossingLines, FineFilter, without_lines
from afspm.plugins.drift.pairs.oversampling import with_larger_pixels
from afspm.plugins.drift.pairs.spikes import without_scars_of_one, without_spikes
from afspm.plugins.drift.pairs.warp import COUNT, CREEP, LINEAR, SLOPES, OverlapBox, Scene, WarpedPair
from afspm.plugins.drift.registration import DriftScan, LinearSeen, Prior, Registration
from afspm.plugins.drift.registration.alignment import Believed, generalised_least_squares
from afspm.plugins.drift.registration.search import (
    ExpectedShift,
    MaskedCorrelation,
    Scorer,
    candidates,
    distorted,
    shear_by_drift,
)

WIDEST = (0.01, 0.03)  # prior standard deviations of shear and rotation in the first stage, by x and by y
GAIN_SD = 1.0  # prior standard deviation of the logarithm of the gain
BEND_SD = 0.15
BORDER_PX = 1  # filters and splines have no data beyond the border
FARTHEST_PX = 8.0  # largest distance of a fit from the result of the search
TURNED = 0.03
"""Sine of the angle between the lines of two scans, above which the lines cross. Then a parabola of each line of either
scan is unknown; otherwise scans turned by 30° are wrong with confidence (95 % ellipses hold 81 % instead of 91 %).
It takes 250 ms instead of 110 ms for 128 pixels. Noise counts as white there, and creep of crossing lines is not
modelled."""
ELSEWHERE_PX = 32  # largest distance of repeats with which a match is compared
EXPECTED = 2.0
"""Factor on the allowed probability where a displacement is expected: nearly all wrong matches are of unrelated scans
without a prior, and most doubtful right matches are zooms with one."""
DISTRUST = 4.0
"""Factor on the noise model's variance where the images are weighed against nuisances. The factor of the ellipses,
which grows with doubt, would give the images too little weight there: errors on 80 stampers were 17 % larger. Constants
from 1 to 5 differ by 6 %."""


class LeastSquares:
    """Registration of two scans: I2(q + d/2) e^(-g/2) = I1(q - d/2) e^(g/2) + noise, d = u + A q + creep of the lines.

    1. `prepare`: flatten rows, clip outliers, refuse scans without information. `onto_common_grid`: resample both.
    2. `search`: candidates by normalised cross-correlation, and the most likely candidate.
    3. `alignment`: Gauss-Newton, coarse to fine; the fine stage without `spikes`, filtered and weighted by rows
       according to their `noise`.
    4. `covariance`: the uncertainty from noise, enlarged by doubt; `nuisances`: the average over possible shear,
       rotation, calibration and creep.
    5. `acceptance`: refuse likely false matches.

    Args:
        wrong_at_most: the largest accepted probability that a match is wrong by more than a pixel; doubled if a prior
            limits the displacement to a part of the scan.

    Raises:
        ConfigError: `wrong_at_most` is not between 0 and 1.
    """

    def __init__(self, wrong_at_most: float = WRONG_AT_MOST):
        if isinstance(wrong_at_most, bool) or not 0.0 < wrong_at_most < 1.0:
            raise ConfigError(f"{wrong_at_most!r} is not between 0 and 1", where="wrong_at_most")
        self._wrong_at_most = wrong_at_most

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        images = []
        for name, each in (("reference", reference), ("scan", scan)):
            try:
                images.append(prepare(each.values))
            except Unusable as reason:
                return Registration.refused(f"the {name} can't be registered: {reason}")
        grid, *on_grid = onto_common_grid(reference, images[0], scan, images[1])
        scene, expected = Scene(on_grid[0], on_grid[1]), None if prior is None else ExpectedShift.of(prior, grid)
        start = _coarse(scene, expected)
        if start is None:
            return Registration.refused("the scans overlap too little")
        coarse, likelihood, rival = start
        scene, grid, coarse = with_larger_pixels(scene, grid, coarse)
        expected = None if prior is None else ExpectedShift.of(prior, grid)
        box = scene.box(coarse[:2])
        if box is None:
            return Registration.refused("the scans overlap too little")
        try:
            shear = _expected_shear(prior, reference, scan, grid)
            lines = _Lines.of(reference, scan, grid)
            theta, model, seen, doubt, to_mean = _fine(scene, box, coarse, lines, expected, shear)
        except Unusable as reason:
            rows, columns = box.shape
            return Registration.refused(f"the overlap of {columns} x {rows} pixels is {reason}")
        if not (np.isfinite(model).all() and np.hypot(*(theta - coarse)[:2]) < FARTHEST_PX):
            return Registration.refused("no displacement fits: the scans have no features in common")
        by_model = model[:2, :2]
        found = _evidence(scene, box, theta, doubt.spread_of_evidence * by_model, (likelihood, rival), expected)
        shift = doubt.shift(model)
        theta[:2] += to_mean
        registration = self._registration(theta, shift, box, grid, found)
        wider = math.sqrt(float(np.linalg.det(shift) / np.linalg.det(by_model)))
        spreads = {"spread": wider, "spread_of_evidence": doubt.spread_of_evidence}
        quality = {**registration.quality, **doubt.features(), **spreads}
        return replace(registration, linear_seen=_in_m(seen, grid), quality=quality)

    def _registration(
        self, theta: Array, total: Array, box: OverlapBox, grid: CommonGrid, found: MatchEvidence
    ) -> Registration:
        expected = found.searched < 1.0
        reason = found.refusal(min(self._wrong_at_most * (EXPECTED if expected else 1.0), 0.99))
        return Registration(
            accepted=not reason,
            reason=reason,
            displacement_m=grid.displacement_m(theta[:2]),
            covariance_m2=grid.to_m @ total @ grid.to_m.T,
            linear=grid.linear_m(_from_reference(theta[LINEAR].reshape(2, 2))),
            center_m=grid.position_m(box.center - theta[:2] / 2),
            quality={**asdict(found), "wrong": found.wrong},
        )


def _coarse(scene: Scene, expected: ExpectedShift | None) -> tuple[Array, float, float] | None:
    # theta within a fraction of a pixel, its log-likelihood and the likelihood of the best rival
    small, factor, offset = scene.smaller()
    scaled = None if expected is None else expected.on_smaller(factor, offset)
    believed = _believed(scaled)
    best = Scorer(small, scaled).best(candidates(small, scaled), believed)
    box = None if best is None else small.box(best[0].shift_px)
    if best is None or box is None:
        return None
    theta = distorted(small, box, best[0].shift_px, believed)
    theta[:2] = theta[:2] * factor + offset
    return theta, best[0].likelihood, best[1]


def _fine(
    scene: Scene,
    box: OverlapBox,
    theta: Array,
    lines: _Lines,
    expected: ExpectedShift | None,
    shear: Shear,
) -> tuple[Array, Array, LinearSeen, Doubt, Array]:
    scene = without_spikes(without_scars_of_one(scene, theta), theta)
    fine = FineFilter.of(scene.first.values, scene.second.values)
    values = fine.applied(scene.first.values), fine.applied(scene.second.values)
    inner = box.without_border(BORDER_PX)
    splines = scene.splines(values, order=5)
    pair = WarpedPair(*splines, inner, theta[:2], lines.own_px, lines.crossing(inner, theta[:2]))
    believed = _believed(expected or ExpectedShift(theta[:2], FARTHEST_PX**2 * np.eye(2)))
    fit = generalised_least_squares(pair, theta, believed, fine)
    model, doubt = covariance(fit, believed, fine.sharpness)
    seen = LinearSeen(fit.theta[LINEAR].reshape(2, 2), doubt.linear(model))
    information, pull = (each / DISTRUST for each in fit.information(believed))
    free = believed.precision.copy()
    free[2:SLOPES] = 0.0
    theta, total = averaged(information, pull + free @ believed.mean, free, shear)
    return theta, total / DISTRUST, seen, doubt, mean_over_rows(fit)


def _in_m(seen: LinearSeen, grid: CommonGrid) -> LinearSeen:
    to_m = np.kron(grid.to_m, np.linalg.inv(grid.to_m).T)
    return LinearSeen(grid.linear_m(_from_reference(seen.linear)), to_m @ seen.covariance @ to_m.T)


def _from_reference(linear: Array) -> Array:
    # d = A q is given half-way between both scans; here by the position in the reference
    whole: Array = linear @ np.linalg.inv(np.eye(2) - linear / 2)
    return whole


def _believed(expected: ExpectedShift | None) -> Believed:
    mean, precision = np.zeros(COUNT), np.zeros((COUNT, COUNT))
    precision[2:, 2:] = np.diag(
        1.0 / np.square([*WIDEST, *WIDEST, *[CREEP_SD_PX] * (CREEP.stop - CREEP.start), GAIN_SD, BEND_SD])
    )
    if expected is not None:
        mean[:2], precision[:2, :2] = expected.mean, np.linalg.inv(expected.covariance)
    return Believed(mean, precision)


@dataclass(frozen=True, eq=False)
class _Lines:
    own_px: tuple[float, float]
    to_own: Array

    @classmethod
    def of(cls, reference: DriftScan, scan: DriftScan, grid: CommonGrid) -> _Lines:
        width_m = float(np.linalg.norm(grid.to_m[:, 0]))
        turned = abs(math.sin(scan.region.angle_rad - reference.region.angle_rad)) > TURNED
        return cls((reference.pixel_m[0] / width_m, 0.0 if turned else scan.pixel_m[0] / width_m), grid.to_own)

    def crossing(self, box: OverlapBox, shift_px: Array) -> CrossingLines | None:
        if self.own_px[1]:
            return None
        x, y = np.meshgrid(box.x + shift_px[0] / 2, box.y + shift_px[1] / 2)
        return CrossingLines.of(*np.tensordot(self.to_own, np.stack([x, y]), 1))


def _expected_shear(prior: Prior | None, reference: DriftScan, scan: DriftScan, grid: CommonGrid) -> Shear:
    mean_m, sd = shear_by_drift(prior, reference, scan)
    width, height = np.hypot(*grid.to_m)
    if sd is None:
        return Shear(float(height / width))
    angle = reference.region.angle_rad
    slow = np.array([-np.sin(angle), np.cos(angle)])
    return Shear(float(height / width), np.linalg.inv(grid.to_m) @ np.outer(mean_m, slow) @ grid.to_m, (sd,))


def _evidence(
    scene: Scene,
    box: OverlapBox,
    theta: Array,
    total: Array,
    likelihoods: tuple[float, float],
    expected: ExpectedShift | None,
) -> MatchEvidence:
    one, two, known = WarpedPair(*scene.smooth_splines, box, theta[:2]).warped(theta)
    one, two = without_lines(one, known), without_lines(two, known)
    elsewhere = MaskedCorrelation(known, known, ELSEWHERE_PX)
    searched = 1.0 if expected is None else min(expected.area_px2 / scene.least_known, 1.0)
    return MatchEvidence(
        overlap=float(known.sum() / scene.least_known),
        sd_px=float(np.sqrt(np.linalg.eigvalsh(total)[-1])),
        gap=likelihoods[0] - likelihoods[1],
        rival=likelihoods[1] / max(likelihoods[0], 1e-300),
        agreement=agreement(one, two, known),
        above_repeats=above_repeats(elsewhere.of(one, two), elsewhere.overlap, elsewhere.origin),
        texture=texture(one, two, known) if searched > NARROW else math.inf,
        surprise=0.0 if expected is None else expected.surprise(theta[:2], total),
        searched=searched,
    )
