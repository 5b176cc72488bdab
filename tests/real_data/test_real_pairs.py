"""Pairs of scans of a real microscope, with the drift known from other channels and exhaustive search."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from benchmarks.data_folder import DATA

from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.storage.formats import read

FOLDER = DATA / "asylum"


def scanned(name: str, channel: str) -> DriftScan:
    (scan,) = (scan for scan in read(FOLDER / f"{name}.h5").scans if scan.channel == channel)
    assert scan.time_ns is not None
    start_s = scan.time_ns / 1e9
    return DriftScan(scan.values, scan.region, start_s, start_s + 256.0, key=name)


Registered = Callable[..., tuple[Registration, np.ndarray]]


@pytest.fixture(scope="module")
def registered() -> Registered:
    """Each pair once; and the displacement in pixels of the reference."""

    @cache
    def registered(reference: str, scan: str, channel: str) -> tuple[Registration, np.ndarray]:
        first, second = scanned(reference, channel), scanned(scan, channel)
        found = LeastSquares().register(first, second)
        return found, found.displacement_m / first.pixel_m

    return lambda reference, scan, channel="HeightRetrace": registered(reference, scan, channel)


PZT = ("PZT_final0001", "PZT_final0002", "PZT_final0003")
PMN = ("PMN28Pt0001", "PMN28Pt0002")


@pytest.mark.parametrize(
    ("reference", "scan", "channel", "expected_px"),
    [
        (PZT[0], PZT[1], "HeightRetrace", (-1.5, 2.6)),
        (PZT[1], PZT[2], "HeightRetrace", (-2.6, 0.9)),
        (PZT[0], PZT[1], "DeflectionRetrace", (-1.5, 2.6)),
        (PZT[1], PZT[2], "DeflectionRetrace", (-2.6, 0.9)),
        (*PMN, "HeightRetrace", (-5.2, 13.2)),
        (*PMN, "DeflectionRetrace", (-5.2, 13.2)),
    ],
)
def test_the_drift_between_real_scans_is_found(
    registered: Registered, reference: str, scan: str, channel: str, expected_px: tuple[float, float]
) -> None:
    found, shift_px = registered(reference, scan, channel)
    assert found.accepted, found.reason
    assert np.hypot(*(shift_px - expected_px)) < 1.0


def test_two_registrations_add_up_to_one(registered: Registered) -> None:
    first, second, both = (registered(a, b)[1] for a, b in ((PZT[0], PZT[1]), (PZT[1], PZT[2]), (PZT[0], PZT[2])))
    assert np.hypot(*(first + second - both)) < 0.3


def test_swapping_the_scans_reverses_the_displacement(registered: Registered) -> None:
    """Both scans are treated alike; only the place of the displacement differs."""
    there, back = registered(*PMN)[0], registered(*PMN[::-1])[0]
    at_m = there.center_m + there.displacement_m
    back_m = back.displacement_m + back.linear @ (at_m - back.center_m)
    assert np.hypot(*(there.displacement_m + back_m)) < 0.1 * scanned(PMN[0], "HeightRetrace").pixel_m[0]


@pytest.mark.parametrize(
    ("reference", "scan"),
    [
        (PZT[0], PMN[0]),
        (PMN[1], PZT[1]),
        ("PTO_Funakubo0004", PZT[1]),
        ("PMN28Pt0000", PZT[1]),
    ],
)
def test_scans_of_different_samples_are_refused(registered: Registered, reference: str, scan: str) -> None:
    found, _ = registered(reference, scan)
    assert not found.accepted
    assert found.reason


def test_a_channel_with_too_little_information_is_refused(registered: Registered) -> None:
    found, _ = registered(*PMN, "PhaseRetrace")
    assert not found.accepted
    assert found.reason
