"""The tutorial's survey on a drifting sample: each scan is registered, and dead reckoning is never silent."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from client_lab import run
from rotation import rotated
from tests.unit.components.drifting_survey_lab import DriftingLab

from afspm.basics.exit_codes import ExitCode
from afspm.model import RegistrationOutcome
from afspm.plugins.drift.estimators import PairFailure, estimator, unguarded
from afspm.plugins.drift.registration import DriftScan, Prior, Registration

pytestmark = pytest.mark.slow

pytest.importorskip("skimage")
PIXEL_M = 5e-6 / 207
"""Of the survey."""
Surveyed = Callable[..., list[dict[str, str]]]


@pytest.fixture
def surveyed(tmp_path: Path) -> Surveyed:
    """Run the survey of a laboratory, and return its table."""

    def surveyed(lab: DriftingLab, **settings: Any) -> list[dict[str, str]]:
        component = lab.survey(**settings)
        assert run(component, lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.ENDED
        with (tmp_path / "targets.csv").open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    return surveyed


@pytest.mark.parametrize("seed", rotated(range(5), 5))
def test_every_scan_of_the_tutorials_survey_is_registered(surveyed: Surveyed, tmp_path: Path, seed: int) -> None:
    lab = DriftingLab(tmp_path, seed)
    rows = surveyed(lab)
    assert [said.outcome for said in lab.registrations] == [RegistrationOutcome.REGISTERED] * len(lab.registrations)
    assert len(rows) >= 8
    assert [row["registration"] for row in rows] == ["registered"] * len(rows)
    assert all(0.0 < float(row["position_sd"]) < PIXEL_M / 2 for row in rows)
    assert max(lab.off_m) < PIXEL_M / 2


class Fails:
    """An estimator that raises an error for some pairs of scans."""

    def __init__(self, every: int) -> None:
        self.calls, self.every = 0, every

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        self.calls += 1
        if reference.values.shape != scan.values.shape and self.calls % self.every == 0:
            raise ZeroDivisionError("oh")
        return unguarded().register(reference, scan, prior)


def test_positions_without_a_registration_are_marked_in_the_table_with_their_uncertainty(
    surveyed: Surveyed, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("afspm.plugins.drift.estimators.guarded.Correlation.register", _refuses)
    failures: list[PairFailure] = []
    lab = DriftingLab(tmp_path, 0, estimator(Fails(every=1), failures.append), failures)
    caplog.set_level("INFO")
    rows = surveyed(lab, count=4)
    assert [row["registration"] for row in rows] == ["failed"] * 4
    sd_m = [float(row["position_sd"]) for row in rows]
    assert sd_m == sorted(sd_m), "the longer nothing is seen, the less is known"
    assert all(off < 3.0 * sd for off, sd in zip(lab.off_m[2:], sd_m, strict=True))
    assert "its position by dead reckoning" in caplog.text
    assert "zooms: registered 0 of 4 scans, 4 failed" in caplog.text


def test_coarse_estimate_bridges_a_failed_registration(surveyed: Surveyed, tmp_path: Path) -> None:
    failures: list[PairFailure] = []
    lab = DriftingLab(tmp_path, 1, estimator(Fails(every=1), failures.append), failures)
    rows = surveyed(lab, count=6)
    assert [row["registration"] for row in rows] == ["coarse"] * 6
    assert all("ZeroDivisionError: oh" in said.failures[0] for said in lab.registrations[2:])
    assert max(lab.off_m) < PIXEL_M


def _refuses(*_: object) -> Registration:
    return Registration.refused("not here")
