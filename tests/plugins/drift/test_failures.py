"""An error of an estimator means nothing about the scans: it is reported, bridged, and no scan is blamed."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from tests.plugins.drift.trackers_lab import INTERVAL_S, World, follow, scan_at, steady

from afspm.model import Region, RegistrationOutcome
from afspm.plugins.drift.estimators import PairFailure, estimator, unguarded
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track import tracker
from afspm.plugins.drift.track.shear import velocity_from_up_down

PIXEL_M = 10e-9
SHIFT_PX = (3, -2)
PRIOR = Prior(np.array([3.0, -2.0]) * PIXEL_M, np.eye(2) * (2.0 * PIXEL_M) ** 2)


class Broken:
    """Raises for every pair."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        raise ZeroDivisionError("oh")


def pair() -> tuple[DriftScan, DriftScan]:
    """Return two scans of one rough surface, displaced by `SHIFT_PX`."""
    random = np.random.default_rng(1)
    surface = gaussian_filter(random.standard_normal((96, 96)), 2.5)
    region, (x, y) = Region((0.0, 0.0), (63 * PIXEL_M, 63 * PIXEL_M)), SHIFT_PX
    first, second = surface[16:80, 16:80], surface[16 - y : 80 - y, 16 - x : 80 - x]
    noise = 0.02 * surface.std() * random.standard_normal((2, 64, 64))
    return (
        DriftScan(first + noise[0], region, 0.0, 60.0, True, "/run/first.nc"),
        DriftScan(second + noise[1], region, 100.0, 160.0, True, "/run/second.nc"),
    )


def test_an_error_is_reported_with_its_pair() -> None:
    failures: list[PairFailure] = []
    found = estimator(Broken(), failures.append).register(*pair())
    assert (found.accepted, found.outcome) == (False, RegistrationOutcome.FAILED)
    (failure,) = failures
    assert (failure.reference, failure.scan) == ("/run/first.nc", "/run/second.nc")
    assert str(failure) == (
        "Broken failed to register second.nc with first.nc: ZeroDivisionError: oh: "
        "an error of the estimator, not of the scans"
    )


def test_an_error_is_logged_where_no_caller_takes_it(caplog: pytest.LogCaptureFixture) -> None:
    estimator(Broken()).register(*pair())
    (record,) = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert "second.nc with first.nc: ZeroDivisionError: oh" in record.getMessage()


def test_an_unguarded_estimator_raises() -> None:
    with pytest.raises(ZeroDivisionError):
        unguarded(Broken()).register(*pair())


def test_with_an_expectation_an_error_is_bridged_by_a_coarse_estimate_with_a_wide_covariance() -> None:
    found = estimator(Broken(), lambda failure: None).register(*pair(), PRIOR)
    assert (found.accepted, found.outcome) == (True, RegistrationOutcome.COARSE)
    assert "ZeroDivisionError: oh" in found.failure
    off_px = found.displacement_m / PIXEL_M - SHIFT_PX
    assert np.hypot(*off_px) < 0.5
    assert np.sqrt(np.linalg.eigvalsh(found.covariance_m2)[0]) >= 0.5 * PIXEL_M


def test_without_an_expectation_nothing_is_bridged() -> None:
    """A plain correlation takes one particle for the next."""
    assert estimator(Broken(), lambda failure: None).register(*pair()).outcome is RegistrationOutcome.FAILED


def test_a_failed_pair_gives_no_velocity() -> None:
    """A coarse estimate has no shear, which is not a shear of zero."""
    first, second = pair()
    down = DriftScan(second.values, second.region, second.start_s, second.end_s, False, second.key)
    assert not velocity_from_up_down(first, down, estimator(Broken(), lambda failure: None)).accepted


class Failing(World):
    """Raises for some pairs, by the keys of their scans."""

    references: frozenset[str] = frozenset()
    scans: frozenset[str] = frozenset()

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        found = super().register(reference, scan, prior)
        if reference.key in self.references or scan.key in self.scans:
            return Registration.failed("numbers failed: LinAlgError")
        return found


@pytest.mark.parametrize("kind", ["bank", "paper"])
def test_errors_of_the_estimator_do_not_mean_that_the_sample_is_lost(kind: str) -> None:
    world = Failing(steady((2e-12, 0.0)))
    following = tracker(kind, world)
    follow(following, 6)
    world.scans = frozenset(f"scan {k}" for k in range(6, 11))
    failed = follow(following, 5, first=6)
    assert [update.outcome for update in failed] == [RegistrationOutcome.FAILED] * 5
    assert not any(update.lost for update in failed)
    assert {update.reason for update in failed} == {"numbers failed: LinAlgError"}
    if kind == "bank":
        sd_m = [update.after.sd_m for update in failed]
        assert sd_m == sorted(sd_m), "the position is dead reckoning, which gets less certain"
    assert follow(following, 1, first=11)[0].outcome is RegistrationOutcome.REGISTERED


def test_errors_of_the_estimator_are_not_held_against_a_reference() -> None:
    """After three errors the overview was dropped, and later zooms had no reference."""
    world = Failing(steady((2e-12, 0.0)))
    following = tracker("bank", world)
    follow(following, 3)
    world.references = frozenset({"scan 0"})
    assert all(update.matched for update in follow(following, 6, first=3))
    world.references = frozenset()
    assert "scan 0" in follow(following, 1, first=9)[0].registrations


def test_a_coarse_result_counts_only_where_there_is_no_exact_one() -> None:
    class Coarse(World):
        def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
            found = super().register(reference, scan, prior)
            if not found.accepted or (reference.key, scan.key) == ("scan 0", "scan 4"):
                return found
            wide = found.covariance_m2 + np.eye(2) * (20e-9) ** 2
            return replace(found, covariance_m2=wide, failure="numbers failed")

    following = tracker("bank", Coarse(steady((2e-12, 0.0))))
    updates = follow(following, 5)
    assert [update.outcome.name for update in updates] == ["REGISTERED", *["COARSE"] * 3, "REGISTERED"]
    assert updates[4].after.sd_m < 2e-9 < updates[3].after.sd_m
    assert updates[3].reason == "numbers failed"


def test_a_scan_of_a_new_place_is_neither_refused_nor_failed() -> None:
    following = tracker("bank", World())
    follow(following, 2)
    elsewhere = following.add(scan_at(3 * INTERVAL_S, (9e-6, 0.0)))
    assert elsewhere.outcome is RegistrationOutcome.NEW
