"""Table and picture of a survey, for every outcome of its targets."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.unit.surveying.surfaces import scanned

from afspm.components.surveying import Outcome, SurveyRecord, Target, Visit
from afspm.components.surveying.figure import draw_survey
from afspm.model import Region, Spectrum

PLACES = np.array([(-1e-6, 0.0), (1e-6, 1e-6), (0.0, -1e-6), (1e-6, -1e-6)])
RADII = np.array([60e-9, 90e-9, 75e-9, 50e-9])


def measured(visit: Visit, *curves: str) -> None:
    region = Region(visit.target.position_m, (400e-9, 400e-9))
    visit.zoom = scanned(PLACES, RADII, region=region, pixels=32)
    bias = np.linspace(-1.0, 1.0, 20)
    for name in curves:
        values = np.stack([bias, 1e-9 * bias], axis=1)
        visit.curves[name] = Spectrum(visit.center_m, "IV", ("Bias", "Current"), ("V", "A"), values, 0, f"{name}.dat")


@pytest.fixture
def record() -> SurveyRecord:
    """A record with one target of each outcome."""
    targets = [Target((float(x), float(y)), 2.0 * float(r)) for (x, y), r in zip(PLACES, RADII, strict=True)]
    made = SurveyRecord(scanned(PLACES, RADII), targets, ("top", "beside"))
    measured(made.visits[0], "top", "beside")
    made.visits[1].refusals.append("zoom: outside")
    measured(made.visits[2], "top")
    return made


def test_each_target_has_an_outcome(record: SurveyRecord) -> None:
    assert [record.outcome(visit) for visit in record.visits] == [
        Outcome.MEASURED, Outcome.REFUSED, Outcome.INCOMPLETE, Outcome.NOT_REACHED,
    ]  # fmt: skip


def test_table_has_positions_heights_and_files(record: SurveyRecord, tmp_path: Path) -> None:
    record.visits[0].curves["beside"] = replace(
        record.visits[0].curves["beside"], filename=str(tmp_path / "a" / "b.dat")
    )
    record.write(tmp_path / "targets.csv")
    with (tmp_path / "targets.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["number"] for row in rows] == ["1", "2", "3", "4"]
    assert (rows[0]["x"], rows[0]["y"], rows[0]["length_units"]) == ("-1e-06", "0", "m")
    assert (rows[0]["height"], rows[0]["height_units"], rows[0]["top"]) == ("1.2e-07", "m", "top.dat")
    assert rows[0]["beside"] == "a/b.dat", "the folder may be copied"
    assert (rows[1]["outcome"], rows[1]["reason"]) == ("refused", "zoom: outside")
    assert (rows[2]["top"], rows[2]["beside"]) == ("top.dat", "")


@pytest.mark.parametrize("targets", [0, 1, 4, 20])
def test_the_picture_is_drawn_with_as_many_targets_as_there_are(tmp_path: Path, targets: int) -> None:
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    record = SurveyRecord(scanned(PLACES, RADII), [Target((0.0, 1e-8 * i)) for i in range(targets)], ("top",))
    for visit in record.visits[:-1]:
        measured(visit, "top")
    draw_survey(record, tmp_path / "survey.png", title="particles", simulated=True)
    with image.open(tmp_path / "survey.png") as drawn:
        width, height = drawn.size
    assert width >= 1000
    assert height >= 1000


def test_each_outcome_is_drawn(record: SurveyRecord, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_survey(record, tmp_path / "survey.svg")
    drawn = (tmp_path / "survey.svg").read_text(encoding="utf-8")
    assert drawn.startswith("<?xml")
