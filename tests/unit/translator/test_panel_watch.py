"""What a person does at the panel is told as such, and what the run asked for, or nobody knows, is not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from afspm.model import (
    ActByHand,
    ControlRequest,
    ControlResponse,
    Feedback,
    MeasurementConditions,
    PanelAct,
    Parameter,
    Region,
    ScanParameters,
    ScopeState,
    Spectrum,
    TipStatus,
    names,
)
from afspm.model.panel import ChangedValue

OK = ControlResponse.SUCCESS
ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
EVIDENCE = "the panel's own button was pressed"


@pytest.fixture
def bench(make_bench: Any) -> Any:
    made = make_bench({"parameters": {"x-engaged": {"vendor": "Engaged", "type": "bool", "read_only": True}}})
    made.look()
    made.heard()
    made.beside.clear()
    return made


def acts(bench: Any) -> list[PanelAct]:
    bench.heard()
    return [one.act for one in bench.beside if isinstance(one, ActByHand)]


def begin_scan(bench: Any) -> None:
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    bench.look()


def end_scan(bench: Any, scan: Any) -> None:
    bench.microscope.files["a"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look()


def test_a_value_changed_at_the_panel_is_published_once_with_old_and_new_value(bench: Any) -> None:
    bench.microscope.values["Setpoint"] = 2.0
    bench.look()
    bench.look()
    assert acts(bench) == [PanelAct.VALUES]
    (change,) = next(one for one in bench.beside if isinstance(one, ActByHand)).changes
    assert (change.parameter, float(change.before), float(change.after)) == ("zctrl-setpoint", 1e-9, 2e-9)


def test_a_row_of_the_table_may_be_watched(make_bench: Any) -> None:
    # results M4: the second electrode
    rows = {"x-sample-bias": {"vendor": "P", "unit": "V", "watched": True}, "x-other": {"vendor": "Bias", "unit": "V"}}
    bench = make_bench({"parameters": rows})
    bench.look()
    bench.microscope.values |= {"P": 2.5, "Bias": 3.0}
    bench.look()
    bench.heard()
    changes = [change for one in bench.beside if isinstance(one, ActByHand) for change in one.changes]
    assert ChangedValue("x-sample-bias", "1", "2.5", "V") in changes
    assert "x-other" not in {change.parameter for change in changes}


def test_a_value_set_by_the_run_is_no_act_by_hand(bench: Any) -> None:
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(setpoint=2e-9)).code == OK
    bench.look()
    bench.look()
    assert acts(bench) == []


def test_a_value_set_back_at_the_panel_is_an_act_by_hand_too(bench: Any) -> None:
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(setpoint=2e-9)).code == OK
    bench.look()
    bench.microscope.values["Setpoint"] = 5.0
    bench.look()
    bench.look()
    # another request in between sets something else
    assert bench.ask(PARAM, Parameter("tip-bias-voltage", "0.3", "V")).code == OK
    bench.look()
    bench.look()
    bench.microscope.values["Setpoint"] = 2.0
    bench.look()
    bench.heard()
    changes = [change for one in bench.beside if isinstance(one, ActByHand) for change in one.changes]
    assert [(float(one.before), float(one.after)) for one in changes] == [(2e-9, 5e-9), (5e-9, 2e-9)]


def test_what_changed_while_the_controller_was_lost_is_no_act_by_hand(bench: Any) -> None:
    bench.microscope.lost = True
    bench.look()
    bench.microscope.lost = False
    bench.microscope.values |= {"Setpoint": 2.0, "Engaged": False}
    bench.look(5.0)
    assert acts(bench) == []


def test_a_tip_withdrawn_in_a_scan_spoils_it_and_begins_nothing(bench: Any, scan: Any) -> None:
    begin_scan(bench)
    bench.microscope.values["Engaged"] = False
    bench.look()
    assert acts(bench) == [PanelAct.WITHDRAW]
    bench.heard()
    end_scan(bench, scan)
    assert bench.heard() == ["INTERRUPTED", "FREE"]
    refused = bench.ask(ACTION, names.START_SCAN)
    assert refused.code == ControlResponse.NOT_FREE
    assert "approach at the panel" in refused.reason
    bench.microscope.values["Engaged"] = True
    bench.look()
    assert bench.ask(ACTION, names.START_SCAN).code == OK


def take_spectrum(bench: Any, meanwhile: dict[str, Any], afterwards: dict[str, Any]) -> None:
    """Take a spectrum, in which the controller shows some values, and later others."""
    assert bench.ask(ACTION, names.START_SPEC).code == OK
    bench.microscope.values |= meanwhile
    bench.look(2.0)
    assert acts(bench) == []
    bench.microscope.files["a"] = [Spectrum((0.0, 0.0), "IV", ("V", "I"), ("V", "A"), np.ones((4, 2)))]
    bench.microscope.values |= afterwards
    bench.microscope.state = ScopeState.FREE


def test_a_value_changed_in_a_spectrum_is_published_once_the_controller_has_put_back_its_own(bench: Any) -> None:
    take_spectrum(bench, {"Setpoint": 2.0, "Loop": False}, {"Loop": True})
    for _ in range(4):
        bench.look(2.0)
    assert acts(bench) == [PanelAct.VALUES]


def test_a_feedback_switched_off_in_a_spectrum_is_seen_although_another_request_follows(bench: Any) -> None:
    take_spectrum(bench, {"Loop": False}, {})
    bench.look(2.0)
    assert acts(bench) == []
    assert bench.ask(PARAM, Parameter("zctrl-setpoint", "2e-9")).code == OK
    for _ in range(3):
        bench.look(2.0)
    assert acts(bench) == [PanelAct.FEEDBACK_OFF]


def test_a_feedback_that_the_run_switches_off_after_a_spectrum_is_no_act_by_hand(bench: Any) -> None:
    take_spectrum(bench, {"Loop": False}, {})
    bench.look(2.0)
    assert bench.ask(PARAM, Parameter(names.FEEDBACK_ON, "false")).code == OK
    for _ in range(3):
        bench.look(2.0)
    assert acts(bench) == []


@pytest.mark.parametrize("name", ["Engaged", "Loop"])
def test_a_scan_is_spoiled_from_its_very_beginning(bench: Any, scan: Any, name: str) -> None:
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    bench.heard()
    bench.microscope.values[name] = False
    bench.look()
    end_scan(bench, scan)
    assert bench.heard()[-2:] == ["INTERRUPTED", "FREE"]


def test_a_tip_withdrawn_just_before_the_end_of_a_scan_spoils_it(bench: Any, scan: Any) -> None:
    begin_scan(bench)
    bench.heard()
    bench.microscope.values["Engaged"] = False
    end_scan(bench, scan)
    assert bench.heard() == ["INTERRUPTED", "FREE"]


def test_withdrawn_tip_spoils_the_running_scan_and_not_the_one_before_it(bench: Any, scan: Any) -> None:
    bench.microscope.state = ScopeState.SCANNING  # at the panel, which repeats it
    bench.look()
    bench.microscope.files["a"] = [scan()]
    bench.look()
    bench.heard()
    bench.microscope.values["Engaged"], bench.microscope.state = False, ScopeState.FREE
    bench.look()
    assert bench.heard() == ["Scan2d", "FREE", "SCANNING"]
    assert acts(bench) == [PanelAct.SCAN, PanelAct.WITHDRAW]
    bench.microscope.files["b"] = [scan()]  # of the stopped scan, as if it were whole
    bench.look()
    assert bench.heard() == ["INTERRUPTED", "FREE"]


def test_a_tip_withdrawn_within_the_look_that_shows_the_end_spoils_the_scan(bench: Any, scan: Any) -> None:
    begin_scan(bench)
    bench.heard()
    bench.microscope.files["a"] = [scan()]

    def withdraw() -> None:  # the values are read before the state
        bench.microscope.values["Engaged"], bench.microscope.state = False, ScopeState.FREE

    bench.microscope.at_status = withdraw
    bench.look()
    assert bench.heard() == ["INTERRUPTED", "FREE"]
    assert acts(bench) == [PanelAct.WITHDRAW]


def test_a_tip_withdrawn_just_before_a_start_is_seen_by_the_start(bench: Any) -> None:
    bench.microscope.values["Engaged"] = False
    assert bench.ask(ACTION, names.START_SCAN).code == ControlResponse.NOT_FREE
    assert bench.microscope.done == []
    assert acts(bench) == [PanelAct.WITHDRAW]


def test_a_tip_withdrawn_just_after_a_request_is_by_hand(bench: Any) -> None:
    # results M5
    assert bench.ask(PARAM, Parameter("tip-bias-voltage", "0.3", "V")).code == OK
    bench.microscope.values["Engaged"] = False
    assert bench.ask(ACTION, names.START_SCAN).code == ControlResponse.NOT_FREE
    assert acts(bench) == [PanelAct.WITHDRAW]


def person_after_each_set(bench: Any, *acts_of_person: dict[str, float]) -> None:
    """Let a person set values right after each setting by a request, in turn."""
    left = list(acts_of_person)
    bench.microscope.after_set = lambda _: bench.microscope.values.update(left.pop(0) if left else {})


# results M5
def test_value_set_by_a_person_in_the_middle_of_a_request_is_an_act_and_the_request_succeeds(bench: Any) -> None:
    person_after_each_set(bench, {"Bias": 1000.0})
    assert bench.ask(PARAM, Parameter("tip-bias-voltage", "0.3", "V")).code == OK
    assert bench.microscope.values["Bias"] == 300.0
    bench.look()
    bench.heard()
    assert [one.changes for one in bench.beside if isinstance(one, ActByHand)] == [
        (ChangedValue("tip-bias-voltage", "0.3", "1", "V"),),
        (ChangedValue("tip-bias-voltage", "1", "0.3", "V"),),
    ]


# results M5
def test_frame_moved_by_a_person_in_the_middle_of_a_request_is_an_act_and_the_request_succeeds(bench: Any) -> None:
    person_after_each_set(bench, {"X": 300.0})
    wanted = ScanParameters(Region((0.0, 0.0), (1e-6, 0.5e-6)), (4, 8))
    assert bench.ask(ControlRequest.SET_SCAN_PARAMS, wanted).code == OK
    assert bench.microscope.values["X"] == -500.0
    assert acts(bench) == [PanelAct.VALUES, PanelAct.VALUES]


# results M5
def test_person_who_keeps_changing_a_value_is_waited_for_twice_and_never_set_back(bench: Any) -> None:
    person_after_each_set(bench, *({"Bias": 500.0 + number} for number in range(6)))
    wanted = Parameter("tip-bias-voltage", "0.3", "V")
    answers = [bench.ask(PARAM, wanted) for _ in range(4)]
    assert [one.code for one in answers] == [
        *[ControlResponse.NOT_FREE] * 2,
        ControlResponse.PARAM_ERROR,
        OK,
    ]
    assert answers[2].reason.startswith("tip-bias-voltage: a person at the panel keeps changing it")
    bench.look()
    assert acts(bench) == [PanelAct.VALUES] * 3


def test_value_that_the_controller_rounds_is_set_twice_and_no_act(bench: Any) -> None:
    rounded = {"Bias": 250.0}
    person_after_each_set(bench, rounded, rounded)
    refused = bench.ask(PARAM, Parameter("tip-bias-voltage", "0.3", "V"))
    assert refused.code == ControlResponse.PARAM_ERROR
    assert "set 250 mV instead of 300 mV; the former values were restored" in refused.reason
    assert bench.microscope.values["Bias"] == 100.0
    assert acts(bench) == []


# results m2
def test_translator_that_begins_in_a_scan_takes_the_way_of_its_tip_for_no_act(bench: Any, scan: Any) -> None:
    begin_scan(bench)
    bench.microscope.values["PX"] = 0.046
    bench.start()
    bench.look()
    bench.microscope.values["PX"] = 0.0
    end_scan(bench, scan)
    bench.look()
    assert acts(bench) == []
    bench.clock.t_s += 10.0
    bench.look()
    bench.microscope.values["PX"] = 0.1  # by a person
    bench.look()
    assert acts(bench) == [PanelAct.VALUES]


def test_a_withdrawal_that_takes_time_gives_one_act(bench: Any) -> None:
    bench.microscope.state = ScopeState.COARSE_MOTOR
    bench.look()
    bench.microscope.values["Engaged"] = False
    bench.look()
    bench.microscope.values["Loop"] = False
    bench.microscope.state = ScopeState.FREE
    bench.look()
    bench.look()
    assert acts(bench) == [PanelAct.WITHDRAW], "the feedback of a withdrawn tip is no act of its own"


def test_a_scan_that_a_withdrawal_ends_gives_no_stop_as_well(bench: Any) -> None:
    bench.microscope.evidence = EVIDENCE
    begin_scan(bench)
    bench.heard()
    bench.microscope.values["Engaged"] = False
    bench.microscope.state = ScopeState.INTERRUPTED
    bench.look()
    assert acts(bench) == [PanelAct.WITHDRAW]


def test_a_tip_that_the_controller_itself_withdrew_is_no_act_by_hand(bench: Any) -> None:
    bench.microscope.withdrawal = "the safe tip withdrew it"
    bench.microscope.values["Engaged"] = False
    bench.look()
    assert acts(bench) == []
    refused = bench.ask(ACTION, names.START_SCAN)
    assert (refused.code, refused.reason) == (ControlResponse.ACTION_ERROR, "the safe tip withdrew it")


def test_a_spoiled_scan_stays_spoiled_over_a_restart_of_the_translator(bench: Any, scan: Any) -> None:
    begin_scan(bench)
    bench.microscope.values["Engaged"] = False
    bench.look()
    bench.microscope.values["Engaged"] = True
    bench.start()
    bench.heard()
    end_scan(bench, scan)
    assert bench.heard() == ["INTERRUPTED", "FREE"]


def test_feedback_switched_off_by_the_run_is_no_act_by_hand(bench: Any, scan: Any) -> None:
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False)).code == OK
    begin_scan(bench)
    bench.heard()
    end_scan(bench, scan)
    assert bench.heard() == ["Scan2d", "FREE"]
    assert acts(bench) == []


def test_feedback_switched_off_at_the_panel_is_an_act_until_it_is_on_again(bench: Any) -> None:
    bench.microscope.values["Loop"] = False
    bench.look()
    assert acts(bench) == [], "one reading is no proof"
    assert bench.ask(ACTION, names.START_SCAN).code == ControlResponse.NOT_FREE
    bench.look()
    assert acts(bench) == [PanelAct.FEEDBACK_OFF]
    refused = bench.ask(ACTION, names.START_SCAN)
    assert refused.code == ControlResponse.NOT_FREE
    assert "switch it on" in refused.reason
    bench.microscope.values["Loop"] = True
    bench.look()
    assert bench.ask(ACTION, names.START_SCAN).code == OK


def test_a_tip_withdrawn_by_the_run_is_no_act_by_hand(bench: Any) -> None:
    assert bench.ask(ACTION, names.RETRACT).code == OK
    bench.look()  # a slow withdrawal shows at a later look
    bench.microscope.values["Engaged"] = False
    bench.look()
    assert acts(bench) == []
    refused = bench.ask(ACTION, names.START_SCAN)
    assert refused.code == ControlResponse.ACTION_ERROR
    assert "bring it to the sample" in refused.reason


# results M5
def test_tip_found_withdrawn_after_a_lost_controller_is_waited_for(bench: Any) -> None:
    begin_scan(bench)
    bench.microscope.state = ScopeState.FREE
    bench.look()
    bench.microscope.lost = True
    bench.look()
    bench.microscope.values["Engaged"], bench.microscope.lost = False, False
    bench.look(60.0)
    refused = bench.ask(ACTION, names.START_SCAN)
    assert refused.code == ControlResponse.NOT_FREE
    assert "bring it to the sample" in refused.reason
    assert acts(bench) == []


def test_tip_withdrawn_by_the_run_before_a_restart_is_an_error(bench: Any) -> None:
    assert bench.ask(ACTION, names.RETRACT).code == OK
    bench.microscope.values["Engaged"] = False
    bench.look()
    bench.start()
    assert bench.ask(ACTION, names.START_SCAN).code == ControlResponse.ACTION_ERROR
    assert acts(bench) == []


def test_a_run_begun_with_a_withdrawn_tip_measures_in_the_air_until_the_tip_was_engaged(
    bench: Any, scan: Any, caplog: Any
) -> None:
    (bench.folder / "translator.json").unlink()
    bench.microscope.values["Engaged"] = False
    bench.start()
    begin_scan(bench)
    end_scan(bench, scan)
    assert "Scan2d" in bench.heard()
    assert "the measurement is in the air" in caplog.text
    for engaged in (True, False):
        bench.microscope.values["Engaged"] = engaged
        bench.look()
    assert bench.ask(ACTION, names.START_SCAN).code == ControlResponse.NOT_FREE


@pytest.mark.parametrize("evidence", [EVIDENCE, ""])
def test_a_stop_is_by_hand_only_with_evidence(bench: Any, evidence: str) -> None:
    bench.microscope.evidence = evidence
    begin_scan(bench)
    bench.heard()
    bench.microscope.state = ScopeState.INTERRUPTED
    bench.look()
    assert acts(bench) == ([PanelAct.STOP] if evidence else [])


def test_a_stop_after_a_pause_is_by_hand(bench: Any) -> None:
    bench.microscope.evidence = EVIDENCE
    begin_scan(bench)
    bench.microscope.paused = True
    bench.look()
    bench.microscope.paused = False
    bench.microscope.state = ScopeState.INTERRUPTED
    bench.look()
    assert acts(bench) == [PanelAct.PAUSE, PanelAct.STOP]


def test_a_stop_asked_for_is_not_by_hand(bench: Any) -> None:
    bench.microscope.evidence = EVIDENCE
    begin_scan(bench)
    assert bench.ask(ACTION, names.STOP_SCAN).code == OK
    bench.look()
    assert acts(bench) == []


def test_a_stop_of_a_scan_of_before_a_restart_is_unknown(bench: Any) -> None:
    begin_scan(bench)
    bench.start()
    bench.microscope.evidence = EVIDENCE
    bench.heard()
    bench.microscope.state = ScopeState.INTERRUPTED
    bench.look()
    assert acts(bench) == []


def test_a_scan_begun_at_the_panel_is_published_once_until_the_run_acts(bench: Any, scan: Any) -> None:
    for number in range(2):
        bench.microscope.state = ScopeState.SCANNING
        bench.look()
        bench.microscope.files[f"{number}"] = [scan()]
        bench.microscope.state = ScopeState.FREE
        bench.look()
    assert acts(bench) == [PanelAct.SCAN]


def test_each_scan_has_the_tip_at_its_begin_and_end(bench: Any, scan: Any) -> None:
    begin_scan(bench)
    bench.microscope.values["Setpoint"] = 2.0
    bench.look()
    end_scan(bench, scan)
    bench.heard()
    found = [one for one in bench.beside if isinstance(one, MeasurementConditions)]
    at_sample = TipStatus(engaged=True, feedback_on=True)
    assert [(one.filename, one.begin, one.end) for one in found] == [("one.dat", at_sample, at_sample)]
    assert [act.act for act in found[0].acts] == [PanelAct.VALUES]


@pytest.mark.parametrize("shown", [ScopeState.INTERRUPTED, ScopeState.FREE])
def test_a_scan_that_a_restarted_controller_lost_is_no_act_by_hand(bench: Any, shown: ScopeState) -> None:
    bench.microscope.evidence = EVIDENCE
    begin_scan(bench)
    bench.microscope.lost = True
    bench.look()
    bench.microscope.lost = False
    bench.look(5.0)
    bench.microscope.state = shown
    bench.look()
    bench.microscope.state = ScopeState.FREE
    for _ in range(20):  # a result is awaited meanwhile
        bench.look(1.0)
    assert bench.heard()[-2:] == ["INTERRUPTED", "FREE"]
    assert acts(bench) == []


def test_rounding_of_a_corner_at_zero_is_shown_as_zero() -> None:
    change = ChangedValue(names.SCAN_TOP_LEFT_X, "5e-09", "3.308722e-24", "m")
    assert str(change) == "scan-top-left-x = 0 m (before: 5 nm)"


def test_spoiled_earlier_scan_of_a_repeating_panel_is_not_published(bench: Any, scan: Any) -> None:
    bench.microscope.state = ScopeState.SCANNING  # at the panel, which repeats it
    bench.look()
    for engaged in (False, True):
        bench.microscope.values["Engaged"] = engaged
        bench.look()
    bench.microscope.files["a"] = [scan()]  # of the scan in which the tip was withdrawn
    bench.look()
    bench.heard()
    bench.microscope.values["Engaged"] = False
    bench.look()
    assert "Scan2d" not in bench.heard()
