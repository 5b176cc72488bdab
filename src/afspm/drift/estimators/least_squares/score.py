"""Which candidate is likeliest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.acceptance import correlated
from afspm.drift.estimators.least_squares.align import SHIFT, Believed, least_squares
from afspm.drift.estimators.least_squares.expected import Expected
from afspm.drift.estimators.least_squares.rows import without_lines
from afspm.drift.estimators.least_squares.scene import Scene
from afspm.drift.estimators.least_squares.spectra import independent_values
from afspm.drift.estimators.least_squares.warp import COUNT, Pair

Array = NDArray[np.float64]

NOTHING_BELIEVED = Believed(np.zeros(COUNT), np.zeros((COUNT, COUNT)))
OTHER_PX = 2.0  # a second best nearer than this is the same match


@dataclass(frozen=True, eq=False)
class Scored:
    """A shift, px, and its log-likelihood, nats."""

    shift_px: Array
    likelihood: float


class Scorer:
    """Scores shifts of two images: L = sum over channels of -n/2 ln(1 - rho²), and the prior; n independent values."""

    def __init__(self, scene: Scene, expected: Expected | None):
        self._scene = scene
        self._expected = expected
        self._channels = [
            (splines, independent_values(*values))
            for splines, values in ((scene.smooth_splines, scene.smooth), (scene.band_splines, scene.band))
        ]

    def best(self, shifts: list[Array]) -> tuple[Scored, float] | None:
        """The likeliest, and the likelihood of the best of the others; None: they all overlap too little."""
        scored = [s for s in map(self._score, shifts) if s is not None]
        if not scored:
            return None
        best = max(scored, key=lambda s: s.likelihood)
        rest = [s.likelihood for s in scored if np.hypot(*(s.shift_px - best.shift_px)) > OTHER_PX]
        return best, max(rest, default=0.0)

    def _score(self, shift: Array) -> Scored | None:
        box = self._scene.box(shift)
        if box is None:
            return None
        theta = np.concatenate([shift, np.zeros(COUNT - 2)])
        theta = least_squares(Pair(*self._scene.smooth_splines, box), theta, NOTHING_BELIEVED, SHIFT, steps=2)
        if np.hypot(*(theta[:2] - shift)) > 4.0:
            theta[:2] = shift
        likelihood = 0.0 if self._expected is None else -0.5 * float(self._expected.chi2(theta[:2]))
        for splines, density in self._channels:
            one, two, known = Pair(*splines, box).warped(theta)
            rho = max(correlated(without_lines(one, known).ravel(), without_lines(two, known).ravel()), 0.0)
            likelihood -= 0.5 * density * known.sum() * np.log1p(-(min(rho, 0.99999) ** 2))
        return Scored(theta[:2], likelihood)
