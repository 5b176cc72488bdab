"""Calibration gratings: pits on a lattice with a few grains of dirt, whose match a period away is nearly as good.

`python -m benchmarks.drift.gratings` counts the accepted pairs that are a period off. A pair relaxes thermally: the
second frame is displaced most in its first lines. Noise and flattening are those of the second generator.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy import ndimage

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import DriftScan
from benchmarks.drift.foreign_pairs import HEIGHT_M, LINE_S, PIXEL_M, PIXELS, Random, circumstances, field, recorded
from benchmarks.drift.trials import ELLIPSE_95, FAILED_PX
from benchmarks.drift.workers import done

FINE = 3  # points of the sample for each pixel
KINDS = ("still", "relaxing", "elsewhere")


@dataclass(frozen=True)
class Grating:
    """A pair, and the true displacement (2,) of a feature, px: the mean over the rows of the overlap."""

    reference: DriftScan
    scan: DriftScan
    moved_px: Array
    linear: Array
    center_px: Array


def grating(kind: str, seed: int) -> Grating:
    """Return the pair of a kind, one of `KINDS`; "elsewhere" shows another place of the same grating."""
    random = np.random.default_rng([61_803, seed, KINDS.index(kind)])
    how = circumstances("real", random)
    share = random.uniform(*how.overlap)
    shift = PIXELS * (1.0 - np.sqrt(share)) * random.choice((-1.0, 1.0), 2) * random.uniform(0.3, 1.0, 2)
    drift = how.drift_px * random.standard_normal((2, 2))
    relaxed = random.uniform(1.5, 6.0) * (kind == "relaxing")
    turn, rows = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.1, 0.5) * PIXELS
    at = np.arange(PIXELS) - (PIXELS - 1) / 2
    ways = [np.outer(each, at / PIXELS) for each in drift]
    ways[1] += relaxed * np.outer((np.cos(turn), np.sin(turn)), np.exp(-np.arange(PIXELS) / rows))
    half = PIXELS / 2 + float(np.abs(shift).max()) / 2 + 12.0
    pits, ground = _pits(random), random.uniform(0.0, 2.0 * np.pi)
    scans = []
    for k, way in enumerate(ways):
        place = np.random.default_rng([61_803, seed, 9, k * (kind == "elsewhere")])
        heights = _surface(place, np.random.default_rng([61_803, seed, 8]), pits, half, ground)
        q = np.stack(np.meshgrid(at, at)) - (k - 0.5) * shift[:, None, None] - way[:, :, None]
        seen = ndimage.map_coordinates(heights, (q[::-1] + half) * FINE, order=3, mode="nearest")
        values = recorded((seen - seen.mean()) / seen.std(), how, random)
        size_m = (PIXELS - 1) * PIXEL_M
        region = Region((0.0, 0.0), (size_m, size_m))
        scans.append(DriftScan(HEIGHT_M * values, region, 900.0 * k, 900.0 * k + LINE_S * PIXELS, upwards=True))
    y = at[(at + shift[1] <= at[-1]) & (at + shift[1] >= at[0])]
    means = [np.array([np.interp(y + k * shift[1], at, one).mean() for one in way]) for k, way in enumerate(ways)]
    center = np.array([-shift[0] / 2, float(y.mean())])
    slopes = [np.outer(each, (0.0, 1.0 / PIXELS)) for each in drift]
    return Grating(scans[0], scans[1], shift + means[1] - means[0], slopes[1] - slopes[0], center)


def _pits(random: Random) -> tuple[float, float, float, float]:
    # period, turn, share of the pits, flank
    return random.uniform(14.0, 40.0), random.uniform(-0.3, 0.3), random.uniform(0.4, 0.6), random.uniform(0.6, 2.0)


def _surface(
    place: Random, sample: Random, pits: tuple[float, float, float, float], half: float, ground: float
) -> Array:
    period, turn, share, flank = pits
    axis = np.arange(-half, half, 1.0 / FINE)
    x, y = np.meshgrid(axis, axis)
    within = []
    for across in (x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)):
        off = np.abs((across + ground) / period % 1.0 - 0.5) * period
        within.append((1.0 + np.tanh((share * period / 2 - off) / flank)) / 2)
    height = -within[0] * within[1] + sample.uniform(0.005, 0.03) * field(place, x.shape, 4.0, 3.0)
    for at in place.uniform(-half, half, (place.poisson(sample.uniform(3.0, 10.0)) + 1, 2)):
        radius, tall = sample.uniform(1.5, 4.0), sample.uniform(0.2, 1.0)
        height += tall * np.exp(-(((x - at[0]) ** 2 + (y - at[1]) ** 2) / radius**2))
    return np.asarray(ndimage.maximum_filter(height, 5))  # the tip is blunt


@dataclass(frozen=True)
class Judged:
    """The result of a pair."""

    kind: str
    seed: int
    accepted: bool
    off_px: float
    chi2: float
    probability: float
    reason: str


@dataclass(frozen=True)
class GratingTrial:
    """A job: one pair, registered by the default estimator without a prior."""

    kind: str
    seed: int

    def run(self) -> list[Judged]:
        made = grating(self.kind, self.seed)
        found = LeastSquares().register(made.reference, made.scan)
        error = (
            found.displacement_m / PIXEL_M - made.moved_px - made.linear @ (found.center_m / PIXEL_M - made.center_px)
        )
        off, chi2 = math.inf, math.nan
        if self.kind != "elsewhere" and np.isfinite(error).all():
            off = float(np.hypot(*error))
            chi2 = float(error @ np.linalg.solve(found.covariance_m2 / PIXEL_M**2, error))
        return [Judged(self.kind, self.seed, found.accepted, off, chi2, found.quality.get("wrong", 1.0), found.reason)]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift.gratings", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=100, help="of each kind")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args(arguments)
    jobs = [GratingTrial(kind, asked.seed + k) for kind in KINDS for k in range(asked.pairs)]
    found = [one for each in done(jobs, asked.processes).values() for one in each]
    for kind in KINDS:
        here = [one for one in found if one.kind == kind]
        right, sure = [o for o in here if o.off_px <= FAILED_PX], [o for o in here if o.accepted]
        held = [o for o in sure if o.off_px <= FAILED_PX]
        print(
            f"{kind:10} {len(here)} pairs, {len(right)} right, {len(sure)} accepted, "
            f"{sum(o.off_px > FAILED_PX for o in sure)} accepted and more than {FAILED_PX:g} px off; "
            f"ellipses hold {np.mean([o.chi2 <= ELLIPSE_95 for o in held] or [np.nan]):.0%}"
        )
        for one in sure:
            if one.off_px > FAILED_PX:
                print(f"    seed {one.seed}: {one.off_px:.1f} px, probability of being wrong {one.probability:.1%}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
