"""A survey in the in-memory laboratory: every target once, over kills and refusals."""

from __future__ import annotations

import csv
import math
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from client_lab import Kill9, LabPort, context_of, run
from tests.unit.components.survey_lab import PARTICLES, ParticleLab

from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.components.survey import Survey
from afspm.model import (
    ControlRequest,
    Problem,
    Scan,
)
from afspm.model.requests import LEND_REQUEST

pytest.importorskip("skimage")
CURVES: Any = {"top": 0.0, "beside": 200e-9, "left": (-100e-9, 0.0)}
HIGHEST_FIRST = [place for place, _ in sorted(PARTICLES.items(), key=lambda one: -one[1])]


def survey(**settings: Any) -> Survey:
    given = {"size": 5e-6, "zoom": 500e-9, "curves": CURVES, "pixels": (96, 96), "zoom_pixels": (48, 48)}
    return Survey(**{**given, "end_when_done": True, **settings})


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "targets.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def ran(tmp_path: Path) -> Any:
    def ran(lab: ParticleLab, component: Survey | None = None) -> list[dict[str, str]]:
        code = run(component or survey(), lab, tmp_path / "state", run_dir=str(tmp_path))
        assert code == ExitCode.ENDED
        return table(tmp_path)

    return ran


def test_the_targets_are_zoomed_highest_first_with_a_curve_at_each_place(ran: Any) -> None:
    lab = ParticleLab()
    rows = ran(lab)
    wide, *zooms = lab.finished
    assert wide.size_m == (5e-6, 5e-6)
    assert [math.dist(zoom.center_m, at) < 30e-9 for zoom, at in zip(zooms, HIGHEST_FIRST, strict=True)] == [True] * 3
    tops, besides, lefts = (lab.spots[start::3] for start in range(3))
    for at, top, beside, left in zip(HIGHEST_FIRST, tops, besides, lefts, strict=True):
        assert math.dist(top, at) < 5e-9, "the target is found again in its zoom"
        assert math.dist(beside, top) == pytest.approx(200e-9)
        assert (left[0] - top[0], left[1] - top[1]) == pytest.approx((-100e-9, 0.0))
    assert [row["outcome"] for row in rows] == ["measured"] * 3
    assert [row["zoom"] for row in rows] == ["scan-2.nc", "scan-3.nc", "scan-4.nc"]


def test_survey_leaves_a_picture(ran: Any, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    ran(ParticleLab())
    assert (tmp_path / "targets.png").stat().st_size > 50_000
    assert (tmp_path / "targets.pdf").read_bytes().startswith(b"%PDF")


def test_target_outside_limits_is_refused_in_the_table_and_the_next_follows(ran: Any) -> None:
    lab = ParticleLab(limit_m=1e-6)
    rows = ran(lab)
    assert [row["outcome"] for row in rows] == ["refused", "measured", "measured"]
    assert rows[0]["reason"].endswith("the region leaves the limits")
    assert len(lab.finished) == 3


def test_survey_whose_targets_are_all_refused_ends_with_the_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # paper F4: it ended with 0
    lab = ParticleLab(limit_m=-2e-6, zoom_alone=True)
    assert run(survey(), lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.OWN_FAULT
    assert "the region leaves the limits" in caplog.text
    assert "no target could be zoomed: all 3 were refused" in caplog.text
    assert [row["outcome"] for row in table(tmp_path)] == ["refused"] * 3


def test_survey_without_targets_logs_that_and_ends(ran: Any, caplog: pytest.LogCaptureFixture) -> None:
    rows = ran(ParticleLab(), survey(min_height=1e-6))
    assert rows == []
    assert "no target found" in caplog.text


def test_survey_carries_its_settings_and_the_zooms_theirs(ran: Any) -> None:
    lab = ParticleLab()
    bias = "tip-bias-voltage"
    ran(lab, survey(parameters={bias: "1 V"}, zoom_parameters={bias: "2 V"}, count=1, curves={}))
    done = [
        request.subject.parameters[0].value if request.kind == LEND_REQUEST else request.subject
        for request in lab.requests
        if request.kind in (LEND_REQUEST, ControlRequest.ACTION)
    ]
    assert done == ["1.0", "start-scan", "2.0", "start-scan"]


def test_problem_in_between_only_delays_the_survey(ran: Any) -> None:
    lab = ParticleLab()
    lab.at(250.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(900.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert [row["outcome"] for row in ran(lab)] == ["measured"] * 3
    assert (len(lab.finished), len(lab.spots)) == (4, 9)


def test_table_after_an_early_end_has_the_results_so_far(ran: Any, tmp_path: Path) -> None:
    lab = ParticleLab()
    lab.at(350.0, lab.kill)
    rows = ran(lab)
    assert [row["outcome"] for row in rows] == ["incomplete", "not-reached", "not-reached"]


@pytest.mark.parametrize("is_late", [False, True])
def test_no_scan_or_curve_is_missing_or_repeated_after_a_kill_anywhere(tmp_path: Path, is_late: bool) -> None:
    for call in range(3, 260, 37):
        lab, folder = ParticleLab(), tmp_path / str(call)
        folder.mkdir()
        context = context_of(lab, folder / "state", run_dir=str(folder))
        context.open_port = partial(LabPort, lab, call, is_late=is_late)
        made = survey()
        made.on_end = lambda: None  # type: ignore[method-assign]
        try:
            made.run_process(context)
        except Kill9:
            lab.restart_component()
            again = survey()
            again.on_end = lambda: None  # type: ignore[method-assign]
            context = context_of(lab, folder / "state", run_dir=str(folder))
            context.session = "1"
            again.run_process(context)
        assert (len(lab.finished), len(lab.spots)) == (4, 9), f"killed at call {call}"
        assert [row["outcome"] for row in table(folder)] == ["measured"] * 3


def corners(scan: Scan) -> list[tuple[float, float]]:
    """A user's finder: two places of the survey, and nothing in zooms."""
    return [(1e-6, 1e-6), (-1e-6, 1e-6)] if scan.shape == (96, 96) else []


def test_user_function_finds_the_targets(ran: Any) -> None:
    lab = ParticleLab()
    rows = ran(lab, survey(targets=f"{__name__}.corners"))
    assert [(row["x"], row["y"], row["height"]) for row in rows] == [("1e-06", "1e-06", ""), ("-1e-06", "1e-06", "")]
    assert lab.spots[0] == (1e-6, 1e-6)


def test_invalid_survey_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="0 is not at least 1"):
        survey(count=0)
    with pytest.raises(ConfigError, match="applies to particles only"):
        survey(targets="my.function", min_height=1e-9)
    with pytest.raises(ConfigError, match="lies outside its zoom"):
        survey(curves={"beside": 300e-9})
    with pytest.raises(ConfigError, match="has no function nowhere"):
        survey(targets="math.nowhere").check()
