"""Runs as earlier versions wrote them still open: two scans and a curve on the simulator, recorded on the day named."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest

import afspm
from afspm.report import night_report

RUNS = Path(__file__).parent / "earlier_runs"
DAYS = sorted(file.name.removesuffix(".tar.xz") for file in RUNS.iterdir())


@pytest.fixture(params=DAYS)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    with tarfile.open(RUNS / f"{request.param}.tar.xz") as packed:
        packed.extractall(tmp_path, filter="data")
    return tmp_path / "night"


def test_there_is_a_run_of_each_earlier_form() -> None:
    # without start and holder in its results; without the state of the panel; with one room for the whole record
    assert DAYS == ["2026-11-25", "2026-11-26", "2026-11-28"]


def test_scans_and_curves_of_an_earlier_run_open(folder: Path) -> None:
    with afspm.open_run(folder) as run:
        assert [row.holder for row in run.scans] == ["own", "own"]
        assert [row.region and row.region.angle_rad for row in run.scans] == pytest.approx([0.3, 0.3])
        for row in run.scans:
            assert row.began_ns is not None
            assert row.began_ns < row.time_ns
            values = run.scan(row)["Height"].values
            assert values.shape == (12, 16)
            assert np.isfinite(values).all()
        (curve,) = run.spectra
        assert run.spectrum(curve).of("current").std() > 0.0
        assert any("the last scan is done" in line.text for line in run.log)


def test_an_earlier_run_has_its_report(folder: Path) -> None:
    text = night_report.write(folder).read_text(encoding="utf-8")
    assert "2 scans, 1 spectrum" in text
    assert "own ended the experiment" in text
