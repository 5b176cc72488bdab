"""The doubt of registrations of real scans, tested from both sides.

Channels that are recorded together, and frames in a ring, agree within their ellipses, but share the wander of their
lines. Odd and even bands of rows do not share it: their ellipses are neither too small nor too wide for what differs.
"""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from benchmarks.data_folder import DATA

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.storage.formats import read

ELLIPSE_95 = 5.991
PAIRS = (
    ("asylum/PZT_final0001.h5", "asylum/PZT_final0002.h5"),
    ("asylum/PZT_final0002.h5", "asylum/PZT_final0003.h5"),
    ("asylum/PMN28Pt0001.h5", "asylum/PMN28Pt0002.h5"),
    ("nanonis/Si_7x7_028.sxm", "nanonis/Si_7x7_032.sxm"),
)
MOVIE = "movies/pyfastspm_test_multi_frame.npy"  # of a fast STM; bands of 8 rows wander by 0.2 px
HIGH_SPEED = "movies/playnano_asd_sample_0.npz"  # of an AFM; bands of 8 rows wander by 0.45 px
BAND = 16  # rows


def _scans(name: str, at_s: float) -> dict[str, DriftScan]:
    found = {}
    for scan in read(DATA / name).scans:
        if scan.values.shape[0] > 64:
            found[scan.channel] = DriftScan(scan.values, scan.region, at_s, at_s + 256.0, key=name)
    return found


def _registered(first: DriftScan, second: DriftScan) -> Registration:
    return LeastSquares().register(first, second)


def _chi2(one: Registration, other: Registration) -> float:
    # at the centre of the first; both see the same lines wander, so the sum of their covariances is an upper bound
    moved = other.displacement_m + other.linear @ (one.center_m - other.center_m)
    apart = one.displacement_m - moved
    return float(apart @ np.linalg.solve(one.covariance_m2 + other.covariance_m2, apart))


def test_channels_of_the_same_pair_agree_within_their_doubt() -> None:
    chi2 = []
    for names in PAIRS:
        first, second = (_scans(name, 1000.0 * k) for k, name in enumerate(names))
        found = [_registered(first[channel], second[channel]) for channel in first.keys() & second.keys()]
        accepted = [one for one in found if one.accepted]
        chi2 += [_chi2(one, other) for one, other in combinations(accepted, 2)]
    within = sum(one <= ELLIPSE_95 for one in chi2)
    assert len(chi2) >= 9
    assert within >= 0.8 * len(chi2)


def test_registrations_of_a_movie_close_within_their_doubt() -> None:
    frames = np.load(DATA / MOVIE)[:8]
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    scans = [DriftScan(values, region, float(k), k + 1.0) for k, values in enumerate(frames.astype(float))]
    chi2 = []
    for k in range(len(scans) - 2):
        there, on, both = (_registered(scans[k + a], scans[k + b]) for a, b in ((0, 1), (1, 2), (0, 2)))
        if there.accepted and on.accepted and both.accepted:
            at_m = both.center_m
            first_m = there.displacement_m + there.linear @ (at_m - there.center_m)
            second_m = on.displacement_m + on.linear @ (at_m + first_m - on.center_m)
            missed = first_m + second_m - both.displacement_m
            covariance = there.covariance_m2 + on.covariance_m2 + both.covariance_m2
            chi2.append(float(missed @ np.linalg.solve(covariance, missed)))
    assert len(chi2) >= 3
    assert np.mean(chi2) / 2 < 1.0


def _between_halves(frames: Array) -> Array:
    """Return differences between displacements by the odd and by the even bands of rows, over their deviations."""
    found = []
    rows = len(frames[0]) // (2 * BAND) * 2 * BAND
    odd = (np.arange(rows) // BAND % 2 == 1)[:, None]
    for first, second in pairwise(frames[:, :rows]):
        region = Region((0.0, 0.0), (1e-6, 1e-6))
        scan = DriftScan(second, region, 1.0, 2.0)
        halves = [DriftScan(np.where(odd == which, first, np.nan), region, 0.0, 1.0) for which in (False, True)]
        one, other = (_registered(half, scan) for half in halves)
        if one.accepted and other.accepted:
            moved = other.displacement_m + other.linear @ (one.center_m - other.center_m)
            apart = one.displacement_m - moved
            found.append(apart / np.sqrt(np.diag(one.covariance_m2 + other.covariance_m2)))
    return np.array(found)


@pytest.mark.parametrize(("name", "frames"), [(MOVIE, 10), (HIGH_SPEED, 12)])
def test_halves_of_real_frames_differ_by_their_doubt(name: str, frames: int) -> None:
    loaded = np.load(DATA / name)
    off = _between_halves((loaded["frames"] if name == HIGH_SPEED else loaded)[:frames].astype(float))
    assert len(off) >= 5
    assert 0.3 < np.sqrt(np.mean(off**2)) < 1.5
