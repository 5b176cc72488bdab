"""Search for a better gain in the in-memory laboratory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import Lab, run

from afspm.basics.errors import MeasurementFailed, Refused
from afspm.basics.exit_codes import ExitCode
from afspm.components.feedback_tuner import FeedbackTuner
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    Packet,
    Problem,
    Region,
    Request,
    Response,
    Scan,
    ScopeState,
    names,
)
from afspm.model.events import ControlEvent
from afspm.model.requests import LEND_REQUEST, RETURN_REQUEST
from afspm.testing import Bench

SETPOINT = 0.5
BEFORE = 1.0
HEIGHT = 1e-6 * np.random.default_rng(1).normal(size=(10, 10)).cumsum(axis=1)


class Rig(Lab):
    """A laboratory whose amplitude follows from the integral gain by `amplitude`; what is lent is set back."""

    def __init__(self, amplitude: Callable[[float], np.ndarray], setpoint: float = SETPOINT, on: bool = True) -> None:
        super().__init__("tuner")
        self.amplitude, self.setpoint, self.height = amplitude, setpoint, HEIGHT
        self.values |= {names.ZCTRL_SETPOINT: str(setpoint), names.ZCTRL_IGAIN: str(BEFORE)}
        self.gains: list[float] = []
        self.publish(Feedback(on=on, integral_gain=BEFORE))
        self.flag(Problem.FEEDBACK_NON_OPTIMAL)
        self.scanned = 0

    def answer(self, request: Request) -> Response:
        """Note the gains that come into force, in order, also those that are set back."""
        lent = names.ZCTRL_IGAIN in self.bases
        response = super().answer(request)
        is_set = request.kind in (LEND_REQUEST, ControlRequest.SET_ZCTRL_PARAMS)
        if response.ok and isinstance(request.subject, Feedback):
            self.values[names.ZCTRL_IGAIN] = str(request.subject.integral_gain)
            self.bases.pop(names.ZCTRL_IGAIN, None)
        if response.ok and (is_set or (lent and request.kind == RETURN_REQUEST)):
            self.gains.append(float(self.values[names.ZCTRL_IGAIN]))
            self.publish(Feedback(on=True, integral_gain=self.gains[-1]))
        return response

    @property
    def problems(self) -> tuple[int, ...]:
        return self.control.published().problems

    def publish(self, thing: Any, envelope: str | None = None) -> Packet:
        return super().publish(
            replace(thing, setpoint=self.setpoint) if isinstance(thing, Feedback) else thing, envelope
        )

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        self.scanned += 1
        self.publish(Scan(region, "Amplitude", "V", self.amplitude(self.gains[-1]), self.clock.now_ns()))
        self.publish(Scan(region, "Height", "m", self.height, self.clock.now_ns()))


def tuner(**settings: Any) -> FeedbackTuner:
    return FeedbackTuner(lowest_gain=0.1, highest_gain=10.0, **settings)


def tuned(lab: Rig, **settings: Any) -> Rig:
    lab.at(5000.0, lab.kill)
    assert run(tuner(**settings), lab) == ExitCode.ENDED
    return lab


def off_by(share: float) -> np.ndarray:
    """Return 100 pixels; this share of them deviates from the setpoint by half of it."""
    values = np.full((10, 10), SETPOINT)
    values.flat[: round(100 * share)] = 1.5 * SETPOINT
    return values


@pytest.mark.parametrize("height", ["Height", ""])
def test_the_gain_is_raised_until_the_feedback_follows_well_and_the_flag_removed(height: str) -> None:
    lab = tuned(Rig(lambda gain: off_by(0.4 / gain**2)), height=height)
    assert lab.gains == [1.0, 2.0, 4.0, 4.0]
    assert lab.problems == ()


def test_original_gain_is_restored_if_none_is_good_and_the_experiment_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = tuned(Rig(lambda gain: off_by(0.5)))
    assert max(lab.gains) == 10.0
    assert lab.gains[-1] == BEFORE
    assert lab.problems == ()
    (record,) = [one for one in caplog.records if "no gain is good from 0.1 to 10" in one.message]
    assert record.levelname == "CRITICAL", "[notify] sends it"


@pytest.mark.parametrize(("values", "setpoint"), [(np.full((10, 10), np.nan), SETPOINT), (off_by(0.0), 0.0)])
def test_scan_without_an_error_value_changes_nothing(values: np.ndarray, setpoint: float) -> None:
    lab = tuned(Rig(lambda gain: values, setpoint))
    assert lab.gains == [BEFORE, BEFORE]
    assert (lab.scanned, lab.problems) == (1, ())


def test_no_gain_is_tried_with_the_feedback_off() -> None:
    lab = tuned(Rig(lambda gain: off_by(0.5), on=False))
    assert (lab.gains, lab.scanned, lab.problems) == ([], 0, ())


def test_refused_gain_ends_the_search_there() -> None:
    lab = Rig(lambda gain: off_by(0.5))

    def refuse(request: Request) -> Response | str:
        if request.kind == LEND_REQUEST and float(request.subject.parameters[0].value) > 3.0:
            return Response(ControlResponse.PARAM_ERROR, reason="out of [limits]")
        return "go on"

    lab.intercept = refuse
    tuned(lab)
    assert lab.gains == [1.0, 2.0, BEFORE]  # paper F3: nothing beyond the bound after the first refusal


def test_signal_held_beside_the_setpoint_is_named_before_the_tip_oscillates(caplog: pytest.LogCaptureFixture) -> None:
    # paper F3: a wrong sensitivity was taken for a slow feedback, up to an oscillation
    relief = 20e-9 * np.sin(np.linspace(0.0, 12.0, 64)) * np.ones((32, 1))
    lab = Rig(lambda gain: 1.4 * SETPOINT - 0.05 / gain * relief / 50e-9)
    lab.height = relief
    tuned(lab)
    assert lab.gains == [1.0, 2.0, BEFORE]
    assert "Amplitude stays +40% off the setpoint while the height follows, so that both are calibrated" in caplog.text


@pytest.mark.parametrize("good", [False, True])
def test_original_or_good_gain_is_set_after_control_was_lost(good: bool) -> None:
    lab = Rig(lambda gain: off_by(0.06 if good and gain == 4.0 else 0.5))
    lab.at(350.0, lambda: lab.clear(Problem.FEEDBACK_NON_OPTIMAL))  # a person says that it is well
    tuned(lab)
    assert lab.gains[-3:] == ([8.0, BEFORE, 4.0] if good else [4.0, 8.0, BEFORE])


def test_good_gain_is_set_after_a_kill(tmp_path: Path) -> None:
    killed = Rig(lambda gain: off_by(0.06 if gain == 4.0 else 0.5))
    killed.at(350.0, killed.kill)
    run(tuner(), killed, tmp_path)
    assert killed.gains[-1] == 8.0
    later = Rig(lambda gain: off_by(0.5))
    later.clear(Problem.FEEDBACK_NON_OPTIMAL)
    later.at(250.0, later.kill)
    run(tuner(), later, tmp_path)
    assert later.gains == [4.0]


def test_gain_of_a_person_stays_after_a_kill(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    killed = Rig(lambda gain: off_by(0.06 if gain == 4.0 else 0.5))
    killed.at(350.0, killed.kill)
    run(tuner(), killed, tmp_path)
    later = Rig(lambda gain: off_by(0.5))
    later.values[names.ZCTRL_IGAIN] = "0.3"
    later.clear(Problem.FEEDBACK_NON_OPTIMAL)
    later.at(250.0, later.kill)
    run(tuner(), later, tmp_path)
    assert later.gains == []
    assert "integral gain 0.3 stays: others have set it since" in caplog.text


class Unscannable(Rig):
    """A laboratory whose scans break off while the integral gain is above 3."""

    def finish_scan(self) -> None:
        if self.gains[-1] > 3.0:
            self.go(ScopeState.INTERRUPTED)
        else:
            super().finish_scan()


def test_gain_is_set_back_when_the_scans_fail_with_it(tmp_path: Path) -> None:
    lab = Unscannable(lambda gain: off_by(0.5))
    with pytest.raises(MeasurementFailed):
        run(tuner(), lab, tmp_path)
    assert max(lab.gains) == 4.0
    assert lab.gains[-1] == BEFORE
    assert Problem.DEVICE_MALFUNCTION in lab.problems


def test_gain_is_set_back_when_a_scan_is_refused_with_it() -> None:
    lab = Rig(lambda gain: off_by(0.5))

    def refuse(request: Request) -> Response | str:
        if request.subject == names.START_SCAN and lab.gains[-1] > 3.0:
            return Response(ControlResponse.ACTION_ERROR, reason="the tip swings")
        return "go on"

    lab.intercept = refuse
    with pytest.raises(Refused):
        run(tuner(), lab)
    assert max(lab.gains) == 4.0
    assert lab.gains[-1] == BEFORE


def test_good_gain_is_set_in_steps_if_a_limit_refuses_the_whole_way() -> None:
    lab = Rig(lambda gain: off_by(0.06 if gain == 4.0 else 0.5))

    def refuse(request: Request) -> Response | str:
        far = (
            request.kind == ControlRequest.SET_ZCTRL_PARAMS and abs(request.subject.integral_gain - lab.gains[-1]) > 4.0
        )
        return Response(ControlResponse.PARAM_ERROR, reason="a step of 6") if far else "go on"

    lab.intercept = refuse
    tuned(lab)
    assert max(lab.gains) == 10.0
    assert lab.gains[-2:] == [8.0, 4.0]
    assert lab.problems == ()


def test_a_gain_that_cannot_be_set_back_stops_the_scans_until_a_person_has_looked(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = Rig(lambda gain: off_by(0.5))

    def refuse(request: Request) -> Response | str:
        return Response(ControlResponse.SUCCESS) if request.kind == RETURN_REQUEST else "go on"

    lab.intercept = refuse
    tuned(lab)
    assert set(lab.problems) == {Problem.FEEDBACK_NON_OPTIMAL, Problem.DEVICE_MALFUNCTION}
    assert "integral gain 1 can't be set again: the log of the scheduler says why" in caplog.text
    assert "as before" not in caplog.text


@pytest.mark.slow
def test_gain_of_a_plan_that_is_found_bad_is_searched_for_once(tmp_path: Path) -> None:
    sample = (Path(__file__).parents[3] / "experiments" / "feedback_gains" / "experiment.toml").read_text("utf-8")
    (file := tmp_path / "experiment.toml").write_text(sample, encoding="utf-8")
    (plan := tmp_path / "plan.toml").write_text(
        """
        [microscope]
        panel = []
        initial = { zctrl-igain = 600.0, scan-speed = "4 um/s" }
        [series]
        parameters = { zctrl-igain = 5.0 }
        """,
        encoding="utf-8",
    )
    bench = Bench.of(str(file), str(plan), component="series", without=("night",))
    bench.run(until="35 min")
    entries = [one for batch in bench.published("JournalEntries") for one in batch.entries]
    (loans,) = bench.published("Loans")[-1:]
    bench.close()
    assert sum(one.event is ControlEvent.PROBLEM_FLAGGED for one in entries) == 1
    (rule,) = loans.overruled
    assert (rule.lender, rule.planned.value, rule.by) == ("series", "5.0", "by tuner")
