"""The absolute velocity of drift from an up frame and a down frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.plugins.drift.trackers_lab import FRAME_S, SIZE_M, scan_at

from afspm.components import Array
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track import BankTracker
from afspm.plugins.drift.track.shear import (
    delay_per_length_s_m,
    row_delay_s,
    slow_axis,
    velocity_by_shear,
    velocity_from_up_down,
)

NM = 1e-9
VELOCITY = np.array([0.11, -0.07]) * NM


class Lattice:
    """Measures the exact shear, and a displacement that is off by lattice sites without a close prior."""

    def __init__(self, velocity_m_s: Array, *, spacing_m: float = np.inf, sd_m: float = 0.1 * NM) -> None:
        self.velocity_m_s = velocity_m_s
        self.spacing_m = spacing_m
        self.sd_m = sd_m
        self.priors: list[Prior | None] = []

    def matrix(self, scan: DriftScan, freed_m_s: Array) -> Array:
        """Return the map from a feature's place at the middle to its measured place, about the centre."""
        a = delay_per_length_s_m(scan)
        assert a is not None
        return np.asarray(np.linalg.inv(np.eye(2) - a * np.outer(self.velocity_m_s - freed_m_s, slow_axis(scan))))

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        self.priors.append(prior)
        between_s = scan.mid_s - reference.mid_s
        # Scans that were freed from a drift are expected where that lets them be.
        freed = np.zeros(2) if prior is None or np.isfinite(scan.values).all() else prior.mean_m / between_s
        first, second = self.matrix(reference, freed), self.matrix(scan, freed)
        between = self.velocity_m_s * between_s
        center = np.array(reference.region.center_m)
        moved = np.array(scan.region.center_m) - center
        # x_k = c_k + B_k (p - c_k), p_k = p_j + v dt, and p_j = c_j at the centre of the reference
        displacement = moved + second @ (between - moved)
        linear = second @ np.linalg.inv(first) - np.eye(2)
        if np.isfinite(self.spacing_m):
            expected = np.zeros(2) if prior is None else prior.mean_m
            displacement = displacement + self.spacing_m * np.round((expected - displacement) / self.spacing_m)
        return Registration(True, "", displacement, np.eye(2) * self.sd_m**2, linear, center)


def frames(angle_rad: float = 0.0, *, up_first: bool = True) -> tuple[DriftScan, DriftScan]:
    first = scan_at(FRAME_S, upwards=up_first, key="first", pixels=64)
    second = scan_at(2.2 * FRAME_S, (20 * NM, 10 * NM), upwards=not up_first, key="second", pixels=64)
    turn = [replace(one, region=replace(one.region, angle_rad=angle_rad)) for one in (first, second)]
    return turn[0], turn[1]


def test_row_times_follow_the_scan_direction() -> None:
    up = scan_at(1000.0, (0.0, 1e-6))
    top = np.array([0.0, 1e-6 + SIZE_M / 2])
    assert row_delay_s(up, top) == pytest.approx(FRAME_S / 2)
    assert row_delay_s(replace(up, upwards=False), top) == pytest.approx(-FRAME_S / 2)
    assert row_delay_s(replace(up, upwards=None), top) is None


def test_the_rows_of_a_rotated_scan_follow_its_own_axis() -> None:
    scan = scan_at(1000.0)
    turned = replace(scan, region=replace(scan.region, angle_rad=np.pi / 2))
    assert row_delay_s(turned, np.array([-SIZE_M / 2, 0.7e-6])) == pytest.approx(FRAME_S / 2)


@pytest.mark.parametrize("up_first", [True, False])
@pytest.mark.parametrize("angle_rad", [0.0, 0.6, 3.0])
@pytest.mark.parametrize("pixels_per_frame", [0.5, 2.0, 20.0])
def test_the_shear_gives_the_velocity(angle_rad: float, pixels_per_frame: float, *, up_first: bool) -> None:
    velocity = VELOCITY / np.linalg.norm(VELOCITY) * pixels_per_frame * SIZE_M / 128 / FRAME_S
    first, second = frames(angle_rad, up_first=up_first)
    sheared = velocity_by_shear(first, second, Lattice(velocity).register(first, second))
    assert sheared is not None
    assert sheared[0] == pytest.approx(velocity, rel=1e-6)


def test_scans_in_one_direction_give_no_velocity() -> None:
    first, second = frames()
    second = replace(second, upwards=True)
    assert velocity_by_shear(first, second, Lattice(VELOCITY).register(first, second)) is None
    refused = velocity_from_up_down(first, second, Lattice(VELOCITY))
    assert not refused.accepted
    assert "opposite slow-scan directions" in refused.reason


@pytest.mark.parametrize("up_first", [True, False])
def test_both_routes_together_are_better_than_either(*, up_first: bool) -> None:
    first, second = frames(0.3, up_first=up_first)
    found = velocity_from_up_down(second, first, Lattice(VELOCITY))
    assert found.accepted
    assert found.velocity_m_s == pytest.approx(VELOCITY, rel=1e-6)
    assert found.by_displacement_m_s == pytest.approx(VELOCITY, rel=1e-6)
    assert found.time_s == pytest.approx(1.6 * FRAME_S)
    assert np.trace(found.covariance) < np.trace(found.by_shear_covariance)
    assert found.covariance[0, 0] < (0.1 * NM / FRAME_S) ** 2


def test_uncertainty_of_the_shear_covers_a_duration_that_counts_the_last_row() -> None:
    first, second = frames()
    found = Lattice(VELOCITY, sd_m=1e-3 * NM).register(first, second)
    sheared = velocity_by_shear(first, second, replace(found, linear=found.linear * 63 / 64))
    assert sheared is not None
    off = sheared[0] - VELOCITY
    assert 0.1 < off @ np.linalg.solve(sheared[1], off) < 4.0


def test_the_shear_resolves_a_lattice() -> None:
    """The drift between the frames is more than half a lattice constant, so the nearest site is a wrong one."""
    lattice = Lattice(VELOCITY, spacing_m=30 * NM, sd_m=0.02 * NM)
    found = velocity_from_up_down(*frames(), lattice)
    assert lattice.priors[0] is None
    assert found.accepted
    assert found.velocity_m_s == pytest.approx(VELOCITY, rel=1e-3)


def test_contradicting_shear_and_displacement_are_refused() -> None:
    class Mistaken(Lattice):
        def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
            found = super().register(reference, scan, prior)
            return replace(found, displacement_m=found.displacement_m + 40 * NM)

    found = velocity_from_up_down(*frames(), Mistaken(VELOCITY))
    assert not found.accepted
    assert "contradicts" in found.reason


def test_a_refused_velocity_has_the_reason_of_the_registration() -> None:
    class Blind:
        def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
            return Registration.refused("nothing in common")

    found = velocity_from_up_down(*frames(), Blind())
    assert not found.accepted
    assert found.reason == "nothing in common"
    assert np.isnan(found.velocity_m_s).all()


def test_a_tracker_notices_an_up_frame_followed_by_a_down_frame() -> None:
    """On a lattice, the displacement alone would lead to the nearest site."""
    following = BankTracker(Lattice(VELOCITY, spacing_m=30 * NM, sd_m=0.02 * NM))
    for scan in frames():
        update = following.add(scan)
    assert update.after.rate_m_s == pytest.approx(VELOCITY, rel=0.05)
    drift = VELOCITY * 1.2 * FRAME_S
    assert -update.after.mapping.translation_m == pytest.approx(drift, abs=0.05 * float(np.linalg.norm(drift)))
