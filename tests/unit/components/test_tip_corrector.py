"""The corrector in the in-memory laboratory: its treatments of a tip, and treatments that it never makes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import REGION, SCAN_S, Kill9, Lab, LabPort, context_of, run
from small_disk import file_limit
from tests.unit.components.tip_scans_lab import ELSEWHERE, HOME, channels

from afspm import wire
from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.formatting import position_text
from afspm.components.tip_corrector import TipCorrector
from afspm.components.tip_experience import TipExperience
from afspm.components.tip_verdict import BAD, GOOD, MESSAGE, UNCLEAR, verdict_message
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Problem,
    Region,
    Request,
    Response,
    Scan,
    ScanParameters,
)
from afspm.model.snapshot import from_plain

TIP, MALFUNCTION = Problem.TIP_SHAPE_CHANGED, Problem.DEVICE_MALFUNCTION


class Repairs(Lab):
    """A microscope that can pulse and crash, and a classifier with given verdicts, then `UNCLEAR`."""

    def __init__(self, verdicts: list[float]) -> None:
        super().__init__("tip_corrector")
        self.verdicts: Iterator[float] = iter(verdicts)
        self.parameters = ScanParameters(REGION, (8, 8))
        self.publish(self.parameters)
        self.actions: list[tuple[str, tuple[float, float]]] = []
        self.values |= dict.fromkeys(("x-pulse-voltage", "x-pulse-duration", "x-crash-depth", "x-crash-speed"), "0")

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        super().publish_scan(region, shape)
        score = next(self.verdicts, UNCLEAR)
        scan = wire.decode("Scan2d", self.cached["Scan2d-Height"].payload)
        assert isinstance(scan, Scan)
        if score == GOOD:
            self.at(0.5, lambda: self.clear(TIP))
        self.at(0.6, lambda: self.publish(verdict_message(scan, score), f"{MESSAGE}_tip_classifier"))

    def execute(self, request: Request) -> Response:
        if request.subject in ("x-pulse", "x-crash"):
            if request.kind == ControlRequest.ACTION:
                self.actions.append((request.subject, self.position.xy_m))
                self.executed.append(request.id)
            return Response(ControlResponse.SUCCESS)
        return super().execute(request)

    def stand_at(self, xy_m: tuple[float, float]) -> None:
        """Let a person move the probe."""
        self.position = ProbePosition(xy_m)
        self.publish(self.position)

    @property
    def problems(self) -> tuple[int, ...]:
        return self.control.published().problems


def corrector(**settings: Any) -> TipCorrector:
    given: dict[str, Any] = {
        "workshop_center": (8e-6, 0.0),
        "pulse_voltages": (3.0, -4.0),
        "crash_depths": (5e-9,),
        **settings,
    }
    return TipCorrector(**given)


def repaired(verdicts: list[float], until_s: float = 5000.0, **settings: Any) -> Repairs:
    lab = Repairs(verdicts)
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(until_s, lab.kill)
    assert run(corrector(**settings), lab) == ExitCode.ENDED
    return lab


def test_pulses_come_first_each_with_a_test_scan_until_the_flag_is_cleared() -> None:
    lab = repaired([BAD, GOOD])
    assert [action for action, _ in lab.actions] == ["x-pulse", "x-pulse"]
    assert lab.finished == [REGION, REGION]
    assert lab.problems == ()
    assert lab.control.holder is None


def test_crashes_come_after_the_pulses() -> None:
    lab = repaired([BAD, BAD, GOOD])
    assert [action for action, _ in lab.actions] == ["x-pulse", "x-pulse", "x-crash"]
    assert lab.problems == ()


def test_treatments_are_made_at_fresh_places_away_from_scans_and_published() -> None:
    lab = repaired([BAD, BAD, GOOD])
    places = [place for _, place in lab.actions]
    assert len(set(places)) == 3
    assert all(x > 7e-6 for x, _ in places)
    told = [wire.decode("ActionMsg", p).action for e, p in lab.published if e.startswith("ActionMsg")]
    assert told == ["x-pulse", "x-pulse", "x-crash"]


class MovesInItsFrame(Repairs):
    """A microscope that, like GXSM, moves its tip only within the scan frame."""

    def execute(self, request: Request) -> Response:
        if request.kind == ControlRequest.SET_PROBE_POS:
            (x, y), region = request.subject.xy_m, self.parameters.region
            assert isinstance(region, Region)
            if not region.contains((x, y)):
                return Response(ControlResponse.PARAM_ERROR, reason="not in the frame")
        return super().execute(request)


def test_frame_moves_along_if_the_tip_moves_only_within_it() -> None:
    lab = MovesInItsFrame([BAD, BAD, GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)
    assert run(corrector(), lab) == ExitCode.ENDED
    assert [action for action, _ in lab.actions] == ["x-pulse", "x-pulse", "x-crash"]
    assert all(x > 7e-6 for _, (x, _) in lab.actions)
    assert lab.finished == [REGION] * 3
    assert lab.problems == ()


def test_microscope_must_have_the_allowed_treatments() -> None:
    assert corrector().needs_actions == ("start-scan", "x-pulse", "x-crash")
    assert corrector(crash_depths=()).needs_actions == ("start-scan", "x-pulse")
    assert corrector(pulse_voltages=()).needs_actions == ("start-scan", "x-crash")


def test_unclear_verdict_leads_to_another_test_scan_without_treatment() -> None:
    lab = repaired([UNCLEAR, GOOD])
    assert len(lab.actions) == 1
    assert len(lab.finished) == 2


def test_first_test_scan_is_at_test_center_and_the_next_at_the_known_place() -> None:
    lab = repaired([UNCLEAR, GOOD], test_center=(0.0, 4e-6))
    assert lab.finished == [REGION.moved_to((0.0, 4e-6)), REGION]


ZOOM = Region((1e-6, 1e-6), (2e-7, 2e-7))


def flagged_at_a_zoom(verdicts: list[float], *scores: float) -> Repairs:
    """Judge the zoom, then set the next region, then flag."""
    lab = Repairs(verdicts)

    def judged() -> None:
        lab.parameters = ScanParameters(ZOOM, (16, 16))
        scan = Scan(ZOOM, "Height", "m", np.zeros((16, 16)), time_ns=lab.clock.now_ns())
        lab.publish(scan)
        for score in scores:
            lab.publish(verdict_message(scan, score), f"{MESSAGE}_tip_classifier")
        lab.parameters = ScanParameters(REGION, (8, 8))
        lab.publish(lab.parameters)

    lab.at(10.0, judged)
    lab.at(11.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)
    assert run(corrector(), lab) == ExitCode.ENDED
    return lab


def test_a_repair_is_tested_at_the_region_and_pixels_of_the_scan_judged_bad() -> None:
    lab = flagged_at_a_zoom([BAD, GOOD], BAD)
    assert lab.finished == [ZOOM, ZOOM]
    assert lab.parameters.shape == (16, 16)
    assert lab.problems == ()


def test_later_good_verdict_discards_the_frame_of_the_fault() -> None:
    assert flagged_at_a_zoom([GOOD], BAD, GOOD).finished == [REGION]


def test_tip_that_stays_bad_is_given_up_after_the_allowed_treatments() -> None:
    lab = repaired([BAD] * 20, until_s=20_000.0)
    assert len(lab.actions) == 3
    assert lab.problems == (TIP, MALFUNCTION)
    assert lab.control.holder is None


def test_repair_is_allowed_again_after_a_person_cleared_the_flag() -> None:
    lab = Repairs([BAD] * 3 + [GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lambda: lab.clear(MALFUNCTION))
    lab.at(9000.0, lab.kill)
    run(corrector(), lab)
    assert len(lab.actions) == 4
    assert lab.problems == ()


def test_a_treatment_that_a_limit_refuses_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    lab = Repairs([GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(3000.0, lab.kill)

    def limit(request: Request) -> Response | str:
        subject = request.subject
        too_much = (
            isinstance(subject, Parameter) and subject.name == "x-pulse-voltage" and float(subject.value or 0) > 2
        )
        return Response(ControlResponse.PARAM_ERROR, reason="3 V is above the limit of 2 V") if too_much else "go on"

    lab.intercept = limit
    run(corrector(), lab)
    assert len(lab.actions) == 1  # the second pulse, of -4 V
    assert "above the limit of 2 V" in caplog.text


def test_refused_test_scan_is_logged_and_replaced_by_the_next(caplog: pytest.LogCaptureFixture) -> None:
    lab = Repairs([GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)
    lab.intercept = lambda request: out_of_limits(request, lambda region: region.center_m[1] > 3e-6)
    assert run(corrector(test_center=(0.0, 4e-6)), lab) == ExitCode.ENDED
    assert lab.finished == [REGION]
    assert lab.problems == ()
    assert "no test scan at (0, 4) µm" in caplog.text


def test_tip_without_a_possible_test_scan_is_not_treated_further() -> None:
    lab = Repairs([])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)
    lab.intercept = lambda request: (
        Response(ControlResponse.ACTION_ERROR, reason="outside") if request.subject == "start-scan" else "go on"
    )
    assert run(corrector(), lab) == ExitCode.ENDED
    assert len(lab.actions) == 1
    assert lab.problems == (TIP, MALFUNCTION)


def out_of_limits(request: Request, is_out: Callable[[Region], bool]) -> Response | str:
    frame = request.subject
    if isinstance(frame, ScanParameters) and isinstance(frame.region, Region) and is_out(frame.region):
        return Response(ControlResponse.PARAM_ERROR, reason="outside the limits")
    return "go on"


def test_its_own_judge_learns_nothing_from_the_test_scans_of_a_bad_tip() -> None:
    pairs = channels(1, "double", 6)

    class OfDoubleTip(Repairs):
        def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
            for scan in pairs[6 + len(self.finished) % 4]:
                self.publish(Scan(region, scan.channel, scan.unit, scan.values, self.clock.now_ns()))

    lab = OfDoubleTip([])
    lab.parameters = ScanParameters(HOME, (96, 96))
    lab.publish(lab.parameters)
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(400.0, lambda: lab.clear(TIP))
    lab.at(4000.0, lab.kill)
    repairing = corrector(judge="self", reference_scans=3, crash_depths=())
    run(repairing, lab)
    assert len(lab.finished) >= 3
    assert repairing.judge is not None
    assert repairing.judge.kinds == ()


def test_its_own_judge_clears_no_flag_by_a_test_scan_at_test_center() -> None:
    pairs = channels(1, "double", 5)

    class OfDoubleTip(Repairs):
        def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
            is_elsewhere = region.center_m == pytest.approx(ELSEWHERE.center_m)
            for scan in pairs[9] if is_elsewhere else pairs[5 + len(self.finished) % 4]:
                self.publish(Scan(region, scan.channel, scan.unit, scan.values, self.clock.now_ns()))

    lab = OfDoubleTip([])
    lab.parameters = ScanParameters(HOME, (96, 96))
    lab.publish(lab.parameters)
    for number, pair in enumerate(pairs[:3]):
        for scan in pair:
            lab.at(10.0 * (number + 1), partial(lab.publish, scan))
    lab.at(100.0, lambda: lab.flag(TIP))
    lab.at(9000.0, lab.kill)
    run(corrector(judge="self", reference_scans=3, crash_depths=(), test_center=ELSEWHERE.center_m), lab)
    assert lab.finished == [ELSEWHERE, HOME] * 2
    assert lab.problems == (TIP, MALFUNCTION)


def test_no_treatment_is_near_a_scanned_region() -> None:
    lab = repaired([], until_s=20_000.0, workshop_center=(0.6e-6, 0.0), keep_away=2e-6)
    assert lab.actions == []
    assert lab.problems == (TIP, MALFUNCTION)


def test_microscope_without_crash_is_given_up_without_one() -> None:
    lab = Repairs([BAD] * 9)
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(20_000.0, lab.kill)

    def no_crash(request: Request) -> Response | str:
        known = request.subject != "x-crash"
        return "go on" if known else Response(ControlResponse.ACTION_NOT_SUPPORTED, reason="no such action")

    lab.intercept = no_crash
    run(corrector(), lab)
    assert [action for action, _ in lab.actions] == ["x-pulse", "x-pulse"]
    assert MALFUNCTION in lab.problems


@pytest.mark.parametrize("is_late", [False, True])
def test_repair_never_exceeds_the_allowed_treatments_after_a_kill_anywhere(tmp_path: Path, is_late: bool) -> None:
    for call in range(1, 120, 6):
        lab = Repairs([BAD] * 30)
        lab.at(10.0, partial(lab.flag, TIP))
        lab.at(30_000.0, lab.kill)
        context = context_of(lab, tmp_path / f"{call}")
        context.open_port = partial(LabPort, lab, call, is_late=is_late)
        try:
            corrector().run_process(context)
        except Kill9:
            lab.restart_component()
            lab.at(30_000.0, lab.kill)  # the first may have been taken in by the one that was killed
            second_life = context_of(lab, tmp_path / f"{call}")
            second_life.session = "1"
            corrector().run_process(second_life)
        assert len(lab.actions) <= 3, f"killed at call {call}"
        assert lab.problems == (TIP, MALFUNCTION), f"killed at call {call}"


def test_invalid_settings_are_refused() -> None:
    for wrong in ({"pulse_voltages": (), "crash_depths": ()}, {"place_spacing": 0.0}, {"workshop_center": (1.0,)}):
        with pytest.raises((ConfigError, ValueError)):
            corrector(**wrong)


def is_of_treatment(request: Request) -> bool:
    return request.subject in ("x-pulse", "x-crash") and request.kind == ControlRequest.ACTION


def a_person_takes_over(lab: Repairs) -> None:
    """Set MANUAL, move the probe to the experiment's region, and set AUTOMATED again."""
    lab.set_mode(ControlMode.MANUAL)
    lab.at(60.0, lambda: lab.stand_at((0.0, 0.0)))
    lab.at(90.0, lambda: lab.set_mode(ControlMode.AUTOMATED))


def just_before(lab: Repairs, kind: ControlRequest, happens: Callable[[], None], number: int = 1) -> None:
    """Call a function just before the scheduler gets the `number`-th request of a kind."""
    heard = 0

    def intercept(request: Request) -> Response | str:
        nonlocal heard
        if request.kind == kind and request.subject != "start-scan":
            heard += 1
            if heard == number:
                happens()
        return "go on"

    lab.intercept = intercept


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        (ControlRequest.SET_PROBE_POS, 1),
        (ControlRequest.PARAM, 1),
        (ControlRequest.PARAM, 2),
        (ControlRequest.ACTION, 1),
    ],
)
def test_probe_moved_by_a_person_is_moved_back_before_a_treatment(
    kind: ControlRequest, number: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    lab = Repairs([GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)
    just_before(lab, kind, lambda: a_person_takes_over(lab), number)
    run(corrector(), lab)
    ((action, (x, y)),) = lab.actions
    assert action == "x-pulse"
    assert x > 7e-6
    assert f"pulse of +3 V, 50 ms at {position_text((x, y))}" in caplog.text
    assert lab.problems == ()


def test_treatments_keep_away_from_a_region_chosen_by_a_person(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = Repairs([BAD] * 9)
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(20_000.0, lab.kill)

    def person() -> None:
        a_person_takes_over(lab)
        lab.publish(ScanParameters(REGION.moved_to((8e-6, 0.0)), (8, 8)))

    just_before(lab, ControlRequest.PARAM, person)
    run(corrector(crash_depths=(), pulse_voltages=(3.0,)), lab)
    assert lab.actions == []
    assert "away from a scanned region" in caplog.text
    assert MALFUNCTION in lab.problems


def test_no_treatment_is_made_unless_the_published_probe_position_fits(caplog: pytest.LogCaptureFixture) -> None:
    lab = Repairs([])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(20_000.0, lab.kill)

    def somebody(request: Request) -> Response | str:  # by the software of the controller
        if request.kind == ControlRequest.PARAM:
            lab.stand_at((0.0, 0.0))
        return "go on"

    lab.intercept = somebody
    run(corrector(), lab)
    assert lab.actions == []
    assert "pulse of +3 V, 50 ms was not done: the probe is at (0, 0) nm, and not at (8, 0) µm" in caplog.text
    assert lab.problems == (TIP, MALFUNCTION)


@pytest.mark.parametrize("is_done", [False, True])
def test_treatment_without_an_answer_is_not_requested_again(is_done: bool) -> None:
    lab = Repairs([BAD, GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)

    def silent(request: Request) -> Response | str:
        if not is_of_treatment(request):
            return "go on"
        lab.intercept = lambda request: "go on"
        if is_done:
            lab.answer_once(request)
        a_person_takes_over(lab)
        return Response(ControlResponse.NO_RESPONSE, reason="the translator is not connected")

    lab.intercept = silent
    run(corrector(), lab)
    assert len(lab.actions) == 1 + is_done  # the next one, after the test scan that was bad
    assert all(x > 7e-6 for _, (x, _) in lab.actions)
    assert len(lab.finished) == 2
    assert lab.problems == ()


def test_treatment_that_can_not_be_saved_is_not_made(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lab = Repairs([BAD] * 9)
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, lab.kill)
    with file_limit(0):
        run(corrector(), lab, tmp_path)
    assert lab.actions == []
    assert lab.problems == (TIP, MALFUNCTION)
    assert "the tip can't be repaired: the disk is full" in caplog.text


def test_tip_is_repaired_once_the_disk_has_room_and_a_person_cleared_the_flag(
    tmp_path: Path,
) -> None:
    full = ExitStack()

    def person() -> None:
        full.close()
        lab.clear(MALFUNCTION)

    lab = Repairs([BAD, GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(5000.0, person)
    lab.at(9000.0, lab.kill)
    with full:
        full.enter_context(file_limit(0))
        run(corrector(), lab, tmp_path)
    assert len(lab.actions) == 2
    assert lab.problems == ()


def _experience(repairing: TipCorrector) -> TipExperience:
    found: TipExperience = from_plain(TipExperience, repairing.memory["experience"])
    return found


def learner(**settings: Any) -> TipCorrector:
    return corrector(policy="learn", **settings)


def life(
    lab: Repairs, folder: Path, until_s: float = 5000.0, *, simulated: bool = False, **settings: Any
) -> TipCorrector:
    """Run a learning corrector in a run folder until a time."""
    folder.mkdir(parents=True)
    context = context_of(lab, folder, run_dir=str(folder), simulated=simulated)
    lab.at(until_s, lab.kill)
    repairing = learner(**settings)
    assert repairing.run_process(context) == ExitCode.ENDED
    return repairing


def test_learning_repair_tries_again_beyond_the_list_until_the_tip_is_good(tmp_path: Path) -> None:
    lab = Repairs([BAD] * 5 + [GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    repairing = life(lab, tmp_path / "runs" / "night")
    assert len(lab.actions) == 6
    assert lab.problems == ()
    outcomes = [_experience(repairing).of("unknown", one) for one in repairing.allowed]
    assert sum(one.cured for one in outcomes) == 1.0
    assert sum(one.unchanged for one in outcomes) == 5.0


def test_what_was_learnt_is_kept_for_the_next_night(tmp_path: Path) -> None:
    for number, night in enumerate(("first", "second")):
        lab = Repairs([GOOD])
        lab.at(10.0, partial(lab.flag, TIP))
        repairing = life(lab, tmp_path / "runs" / night)
        assert _experience(repairing).nights == number + 1
    assert (tmp_path / "runs" / "tip_experience.toml").exists()
    assert sum(_experience(repairing).of("unknown", one).cured for one in repairing.allowed) == 2.0


def test_experience_of_a_simulated_night_is_not_used_on_a_real_tip(tmp_path: Path) -> None:
    for night, simulated in (("simulated", True), ("real", False), ("simulated again", True)):
        lab = Repairs([GOOD])
        lab.at(10.0, partial(lab.flag, TIP))
        repairing = life(lab, tmp_path / "runs" / night, simulated=simulated)
        assert _experience(repairing).nights == (2 if night == "simulated again" else 1)
    names = {file.name for file in (tmp_path / "runs").glob("*.toml")}
    assert names == {"tip_experience.toml", "tip_experience_simulated.toml"}


def test_unreadable_experience_is_left_as_it_is(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "runs").mkdir(parents=True)
    file = tmp_path / "runs" / "tip_experience.toml"
    file.write_text("[double", encoding="utf-8")
    lab = Repairs([GOOD])
    lab.at(10.0, lambda: lab.flag(TIP))
    life(lab, tmp_path / "runs" / "night")
    assert lab.problems == ()
    assert file.read_text(encoding="utf-8") == "[double"
    assert "begins without experience" in caplog.text


def test_learning_repair_gives_up_after_its_most_treatments(tmp_path: Path) -> None:
    lab = Repairs([BAD] * 40)
    lab.at(10.0, lambda: lab.flag(TIP))
    life(lab, tmp_path / "runs" / "night", 20_000.0, most_treatments=5)
    assert len(lab.actions) == 5
    assert lab.problems == (TIP, MALFUNCTION)


@pytest.mark.parametrize(
    ("budget", "most"),
    [
        ({"night_pulses": 2, "night_depth": 0.0}, 2),
        ({"night_depth": 10e-9, "night_pulses": 0}, 2),
        ({"night_places": 3}, 3),
    ],
)
def test_budget_of_the_night_holds_over_several_repairs(
    budget: dict[str, Any], most: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Repairs([BAD, GOOD] + [BAD] * 40)
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(6000.0, lambda: lab.flag(TIP))
    life(lab, tmp_path / "runs" / "night", 30_000.0, **budget)
    assert len(lab.actions) == most
    assert lab.problems == (TIP, MALFUNCTION)
    assert "the budget of the night is spent" in caplog.text
    assert any(f"into the rest of {name}" in caplog.text for name in budget)  # the setting's name in the file
    assert "`afspm end`" in caplog.text


@pytest.mark.parametrize("policy", ["list", "learn"])
def test_budget_holds_after_a_kill_anywhere(policy: str, tmp_path: Path) -> None:
    for call in range(1, 110, 9):
        lab = Repairs([BAD] * 30)
        lab.at(10.0, partial(lab.flag, TIP))
        lab.at(30_000.0, lab.kill)
        (tmp_path / f"{call}").mkdir()
        context = context_of(lab, tmp_path / f"{call}" / "night", run_dir=str(tmp_path / f"{call}" / "night"))
        context.open_port = partial(LabPort, lab, call)
        settings: dict[str, Any] = {"policy": policy, "night_pulses": 2, "night_depth": 5e-9}
        try:
            corrector(**settings).run_process(context)
        except Kill9:
            lab.restart_component()
            lab.at(30_000.0, lab.kill)
            second_life = context_of(lab, tmp_path / f"{call}" / "night", run_dir=str(tmp_path / f"{call}" / "night"))
            second_life.session = "1"
            corrector(**settings).run_process(second_life)
        done = [action for action, _ in lab.actions]
        assert done.count("x-pulse") <= 2, f"killed at call {call}"
        assert done.count("x-crash") <= 1, f"killed at call {call}"
        assert lab.problems == (TIP, MALFUNCTION), f"killed at call {call}"


def test_refused_treatment_costs_no_budget(tmp_path: Path) -> None:
    lab = Repairs([BAD] * 40)
    lab.at(10.0, lambda: lab.flag(TIP))
    refused = 0

    def limit(request: Request) -> Response | str:
        nonlocal refused
        subject = request.subject
        too_much = isinstance(subject, Parameter) and subject.name == "x-pulse-voltage" and subject.value == "-4.0"
        refused += too_much
        return Response(ControlResponse.PARAM_ERROR, reason="below the limit") if too_much else "go on"

    lab.intercept = limit
    life(lab, tmp_path / "runs" / "night", 30_000.0, crash_depths=(), night_pulses=4)
    assert refused == 1
    assert len(lab.actions) == 4


def test_time_of_repairs_counts_until_the_budget_is_spent(tmp_path: Path) -> None:
    lab = Repairs([BAD] * 60)
    lab.at(10.0, lambda: lab.flag(TIP))
    um_s = 2.0 * REGION.size_m[0] * 1e6 * 8 / SCAN_S
    speed = Response(ControlResponse.SUCCESS, wire.encode(Parameter("scan-speed", f"{um_s}", "um/s"))[1])
    lab.intercept = lambda request: (
        speed if isinstance(request.subject, Parameter) and request.subject.name == "scan-speed" else "go on"
    )
    repairing = life(lab, tmp_path / "runs" / "night", 30_000.0, night_time=1000.0)
    assert 0 < len(lab.actions) < 12
    assert 0.0 < repairing._account.spent.time_s <= 1000.0
    assert lab.problems == (TIP, MALFUNCTION)
