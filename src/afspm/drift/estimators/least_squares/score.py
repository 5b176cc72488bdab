"""Which candidate is likeliest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.acceptance import correlated
from afspm.drift.estimators.least_squares.align import SHIFT, Believed, least_squares
from afspm.drift.estimators.least_squares.prepare import Image
from afspm.drift.estimators.least_squares.rows import without_lines
from afspm.drift.estimators.least_squares.search import PixelPrior, channels
from afspm.drift.estimators.least_squares.spectra import independent_values
from afspm.drift.estimators.least_squares.warp import COUNT, Box, Pair, Spline

Array = NDArray[np.float64]

OTHER_PX = 2.0  # a second best nearer than this is the same match


@dataclass(frozen=True, eq=False)
class Scored:
    """A shift, px, and its log-likelihood, nats."""

    shift_px: Array
    likelihood: float


class Scorer:
    """Scores shifts of two images: L = sum over channels of -n/2 ln(1 - rho²), and the prior; n independent values."""

    def __init__(self, first: Image, second: Image, prior: PixelPrior | None):
        self._prior = prior
        self._channels = []
        self._shapes = first.values.shape, second.values.shape
        for one, two in [
            (a, b) for i, (a, b) in enumerate(zip(channels(first), channels(second), strict=True)) if i != 1
        ]:
            splines = Spline.of(Image(one, first.known)), Spline.of(Image(two, second.known))
            self._channels.append((*splines, independent_values(one, two)))

    def best(self, shifts: list[Array]) -> tuple[Scored, float] | None:
        """The likeliest, and by how many nats it is so before any other; None: they all overlap too little."""
        scored = [s for s in map(self._score, shifts) if s is not None]
        if not scored:
            return None
        best = max(scored, key=lambda s: s.likelihood)
        rest = [s.likelihood for s in scored if np.hypot(*(s.shift_px - best.shift_px)) > OTHER_PX]
        return best, float(best.likelihood - max(rest, default=0.0))

    def _score(self, shift: Array) -> Scored | None:
        box = Box.of_overlap(*self._shapes, shift)
        if box is None:
            return None
        flat = Believed(np.zeros(COUNT), np.zeros((COUNT, COUNT)))
        theta = np.concatenate([shift, np.zeros(COUNT - 2)])
        theta = least_squares(Pair(*self._channels[0][:2], box), theta, flat, SHIFT, steps=2)
        if np.hypot(*(theta[:2] - shift)) > 4.0:
            theta[:2] = shift
        likelihood = 0.0 if self._prior is None else -0.5 * float(self._prior.chi2(theta[:2]))
        for first, second, density in self._channels:
            one, two, known = Pair(first, second, box).warped(theta)
            rho = max(correlated(without_lines(one, known).ravel(), without_lines(two, known).ravel()), 0.0)
            likelihood -= 0.5 * density * known.sum() * np.log1p(-(min(rho, 0.99999) ** 2))
        return Scored(theta[:2], likelihood)
