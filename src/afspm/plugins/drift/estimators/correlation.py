"""Registration by plain normalised cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.basics import ConfigError
from afspm.components import Array
from afspm.plugins.drift.pairs.images import CommonGrid, Image, Unusable, onto_common_grid, prepare
from afspm.plugins.drift.pairs.overlap import overlap_center_m
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.registration.search import MaskedCorrelation

_SMOOTH_PX = 1.0
_APART_PX = 4.0  # shifts nearer to the highest peak belong to this peak
# Edges of the overlap, and remains of row flattening around high features, pull by about this much at any noise where
# slopes are steepest, and by more in a direction in which the image changes less.
_SYSTEMATIC_PX = 0.2
# On a straight edge (0.01 to 0.05) this pull decides alone: the shift along it came out as 0 with any drift.
_ISOTROPY = 0.1
_GATE = 25.0  # chi² from the expectation, the limit of the search


@dataclass(frozen=True)
class Correlation:
    """Estimator of translations by masked normalised cross-correlation (Padfield 2012), with a parabola at the peak.

    Attributes:
        coefficient: least accepted correlation coefficient of the peak.
        height: least height of the peak, in standard deviations of all other shifts.
        rival: largest accepted ratio of the height at any other shift, outside the peak, to the height of the peak.
        overlap: least overlap, as share of the smaller scan; with a prior, two thirds of this value.

    Raises:
        ConfigError: a meaningless setting.
    """

    coefficient: float = 0.4
    height: float = 5.0
    rival: float = 0.8
    overlap: float = 0.3

    def __post_init__(self) -> None:
        for name in ("coefficient", "rival", "overlap"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ConfigError(f"{getattr(self, name)!r} must be above 0 and at most 1", where=name)
        if not self.height > 0.0:
            raise ConfigError(f"{self.height!r} must be above 0", where="height")

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        images: list[Image] = []
        for name, one in (("reference", reference), ("scan", scan)):
            try:
                images.append(prepare(one.values))
            except Unusable as error:
                return Registration.refused(f"the {name}: {error}")
        return self.register_images(reference, images[0], scan, images[1], prior)

    def register_images(
        self, reference: DriftScan, first: Image, scan: DriftScan, second: Image, prior: Prior | None = None
    ) -> Registration:
        """Return the registration of two scans whose prepared images are given."""
        grid, first, second = onto_common_grid(reference, first, scan, second)
        found = self._peak(first, second, grid, prior)
        if found is None:
            return Registration.refused("no shift leaves enough overlap")
        displacement = grid.displacement_m(found.shift_px)
        center = overlap_center_m(reference.region, scan.region, displacement)
        if center is None:
            return Registration.refused("at the best shift the scans have no features in common", found.quality)
        covariance_px2, isotropy = _covariance_px2(first, second, found)
        found.quality["isotropy"] = isotropy
        reason = self._objection(found.quality)
        covariance = grid.to_m @ covariance_px2 @ grid.to_m.T
        return Registration(
            accepted=not reason,
            reason=reason,
            displacement_m=displacement,
            covariance_m2=covariance,
            linear=np.zeros((2, 2)),
            center_m=center,
            quality=found.quality,
        )

    def _peak(self, first: Image, second: Image, grid: CommonGrid, prior: Prior | None) -> _Peak | None:
        coefficients = MaskedCorrelation(first.known, second.known)
        c = coefficients.of(_smooth(first), _smooth(second))
        index = np.moveaxis(np.indices(c.shape), 0, -1).astype(np.float64)
        shifts = coefficients.shifts_px(index)
        smaller = min(float(first.known.sum()), float(second.known.sum()))
        least = self.overlap if prior is None else self.overlap * 2 / 3
        enough = coefficients.overlap >= least * smaller
        allowed = enough if prior is None else enough & (_deviations(shifts, grid, prior) < _GATE)
        if not allowed.any():
            return None
        # Fisher's transform: the same spread for any overlap.
        height = np.arctanh(c) * np.sqrt(coefficients.overlap)
        at = np.unravel_index(int(np.where(allowed, height, -np.inf).argmax()), c.shape)
        away = np.hypot(*np.moveaxis(shifts - shifts[at], -1, 0)) > _APART_PX
        elsewhere = height[enough & away]
        rivals = height[allowed & away]
        quality = {
            "correlation": float(c[at]),
            "height": float(height[at] / max(np.sqrt(np.mean(elsewhere**2)), 1e-12)) if elsewhere.size else np.inf,
            "rival": float(max(rivals.max(initial=0.0), 0.0) / max(height[at], 1e-12)),
            "overlap": float(coefficients.overlap[at] / smaller),
        }
        return _Peak(shifts[at] + _top(c, at), tuple(np.subtract(at, coefficients.origin).tolist()), quality)

    def _objection(self, quality: dict[str, float]) -> str:
        if quality["correlation"] < self.coefficient:
            return f"the correlation is only {quality['correlation']:.2f}"
        if quality["rival"] > self.rival:
            return f"ambiguous: another shift reaches {quality['rival']:.0%} of the best"
        if quality["height"] < self.height:
            return f"the peak is only {quality['height']:.1f} standard deviations high"
        if quality["isotropy"] < _ISOTROPY:
            return "the scans change in one direction only: the displacement along a straight edge is unknown"
        return ""


@dataclass(frozen=True, eq=False)
class _Peak:
    shift_px: Array
    step_px: tuple[int, ...]  # (y, x), between pixels of the same index in the two images
    quality: dict[str, float]


def _smooth(image: Image) -> Array:
    from scipy.ndimage import gaussian_filter

    # only over measured pixels: filled gaps have edges of their own
    known = image.known.astype(np.float64)
    weight = gaussian_filter(known, _SMOOTH_PX, mode="nearest")
    smooth: Array = gaussian_filter(image.values * known, _SMOOTH_PX, mode="nearest") / np.maximum(weight, 1e-9)
    return smooth


def _deviations(shifts_px: Array, grid: CommonGrid, prior: Prior) -> Array:
    # half a pixel is added for the grid of shifts
    back = np.linalg.inv(grid.to_m)
    inverse = np.linalg.inv(back @ prior.covariance_m2 @ back.T + 0.25 * np.eye(2))
    off = shifts_px - grid.shift_px(prior.mean_m)
    return np.asarray(np.einsum("...i,ij,...j", off, inverse, off))


def _top(c: Array, at: tuple[np.intp, ...]) -> Array:
    # the top of the parabola through a peak and its neighbours, (x, y)
    offset = np.zeros(2)
    for axis, size in enumerate(c.shape):
        if not 0 < at[axis] < size - 1:
            continue
        step = np.eye(2, dtype=np.intp)[axis]
        before, after = c[tuple(np.array(at) - step)], c[tuple(np.array(at) + step)]
        bend = before - 2.0 * c[at] + after
        if bend < 0.0:
            offset[1 - axis] = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return offset


def _covariance_px2(first: Image, second: Image, found: _Peak) -> tuple[Array, float]:
    # Cramér-Rao bound for white noise of the size of the difference, times the area of the smoothing, plus errors that
    # no noise explains; and the information about the worst direction, as share of the best. Only slopes that both
    # images have are information: noise has slopes in all directions.
    both = list(zip(first.known.shape, second.known.shape, found.step_px, strict=True))
    here = tuple(slice(max(0, -step), min(one, two - step)) for one, two, step in both)
    there = tuple(slice(max(0, step), min(two, one + step)) for one, two, step in both)
    one, two = _smooth(first)[here], _smooth(second)[there]
    known = first.known[here] & second.known[there]
    a, b = _slopes(one)[:, known], _slopes(two)[:, known]
    information, axes = np.linalg.eigh((a @ b.T + b @ a.T) / 2.0)
    best = max(float(information[-1]), 1e-9 * float((a * a).sum()), 1e-300)
    shares = np.clip(information / best, 1e-3, 1.0)
    unlike = 2.0 * (1.0 - found.quality["correlation"]) * float(one[known].var())
    variances = 4.0 * np.pi * _SMOOTH_PX**2 * unlike / (best * shares) + (_SYSTEMATIC_PX / shares) ** 2
    return axes * variances @ axes.T, float(shares[0])


def _slopes(values: Array) -> Array:
    down, right = np.gradient(values)
    return np.stack([right, down])
