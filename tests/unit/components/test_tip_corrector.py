"""The corrector in the laboratory in memory: what it does to a tip, and what it never does."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from runtime_lab import REGION, Kill9, Lab, LabPort, context_of, run

from afspm import wire
from afspm.components.tip_corrector import TipCorrector
from afspm.components.verdicts import BAD, GOOD, MESSAGE, UNCLEAR, verdict_message
from afspm.errors import ConfigError
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    Problem,
    Region,
    Request,
    Response,
    Scan,
    ScanParameters,
)
from afspm.runtime.exit_codes import ExitCode

TIP, MALFUNCTION = Problem.TIP_SHAPE_CHANGED, Problem.DEVICE_MALFUNCTION


class Repairs(Lab):
    """A microscope that can pulse and crash, and a classifier that gives the verdicts it is told to, then `UNCLEAR`."""

    def __init__(self, verdicts: list[float]) -> None:
        super().__init__("tip_corrector")
        self.verdicts: Iterator[float] = iter(verdicts)
        self.parameters = ScanParameters(REGION, (8, 8))
        self.publish(self.parameters)
        self.actions: list[tuple[str, tuple[float, float]]] = []
        self.values |= dict.fromkeys(("x-pulse-voltage", "x-pulse-duration", "x-crash-depth", "x-crash-speed"), "0")
        self.values |= dict.fromkeys(("scan-size-x", "scan-size-y", "scan-top-left-x", "scan-top-left-y"), "0")

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        super().publish_scan(region, shape)
        score = next(self.verdicts, UNCLEAR)
        scan = wire.decode("Scan2d", self.cached["Scan2d-Height"].payload)
        assert isinstance(scan, Scan)
        if score == GOOD:
            self.at(0.5, lambda: self.clear(TIP))
        self.at(0.6, lambda: self.publish(verdict_message(scan, score), f"{MESSAGE}_tip_classifier"))

    def _execute(self, request: Request) -> Response:
        if request.subject in ("x-pulse", "x-crash"):
            if request.kind == ControlRequest.ACTION:
                self.actions.append((request.subject, self.position.xy_m))
                self.executed.append(request.id)
            return Response(ControlResponse.SUCCESS)
        return super()._execute(request)

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


def test_what_is_done_is_done_away_from_the_scans_at_a_fresh_place_and_told() -> None:
    lab = repaired([BAD, BAD, GOOD])
    places = [place for _, place in lab.actions]
    assert len(set(places)) == 3
    assert all(x > 7e-6 for x, _ in places)
    told = [wire.decode("ActionMsg", p).action for e, p in lab.published if e.startswith("ActionMsg")]
    assert told == ["x-pulse", "x-pulse", "x-crash"]


def test_what_it_may_do_to_a_tip_the_microscope_has_to_be_able_to() -> None:
    assert corrector().needs_actions == ("start-scan", "x-pulse", "x-crash")
    assert corrector(crash_depths=()).needs_actions == ("start-scan", "x-pulse")
    assert corrector(pulse_voltages=()).needs_actions == ("start-scan", "x-crash")


def test_an_unclear_verdict_is_looked_at_again_without_another_treatment() -> None:
    lab = repaired([UNCLEAR, GOOD])
    assert len(lab.actions) == 1
    assert len(lab.finished) == 2


def test_the_first_test_scan_is_apart_and_the_next_where_the_sample_is_known() -> None:
    lab = repaired([UNCLEAR, GOOD], test_center=(0.0, 4e-6))
    assert lab.finished == [REGION.moved_to((0.0, 4e-6)), REGION]


def test_a_tip_that_stays_bad_is_given_up_on_loudly_after_what_is_allowed_and_no_more() -> None:
    lab = repaired([BAD] * 20, until_s=20_000.0)
    assert len(lab.actions) == 3
    assert lab.problems == (TIP, MALFUNCTION)
    assert lab.control.holder is None


def test_after_a_person_has_looked_it_may_try_again() -> None:
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


def test_no_treatment_near_what_is_scanned() -> None:
    lab = repaired([], until_s=20_000.0, workshop_center=(0.6e-6, 0.0), keep_away=2e-6)
    assert lab.actions == []
    assert lab.problems == (TIP, MALFUNCTION)


def test_a_microscope_that_cannot_crash_is_given_up_on_without_one() -> None:
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
def test_killed_anywhere_it_never_does_more_than_is_allowed(tmp_path: Path, is_late: bool) -> None:
    for call in range(1, 120, 6):
        lab = Repairs([BAD] * 30)
        lab.at(10.0, lambda lab=lab: lab.flag(TIP))
        lab.at(30_000.0, lab.kill)
        context = context_of(lab, tmp_path / f"{call}")
        context.open_port = lambda lab=lab, call=call: LabPort(lab, call, is_late=is_late)  # type: ignore[misc]
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


def test_settings_without_sense_are_refused() -> None:
    for wrong in ({"pulse_voltages": (), "crash_depths": ()}, {"place_spacing": 0.0}, {"workshop_center": (1.0,)}):
        with pytest.raises((ConfigError, ValueError)):
            corrector(**wrong)
