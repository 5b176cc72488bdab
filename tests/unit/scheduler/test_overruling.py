"""What takes the place of a value that a plan states: a person's, or the one that the solver of a problem has found."""

from __future__ import annotations

import pytest
from tests.unit.scheduler.test_lending import BIAS, GAIN, PARAM, QUICK, SPEED, A, B, Desk, limited

from afspm.model import (
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    PanelAct,
    Parameter,
    Problem,
    ProcessCondition,
    ProcessState,
    names,
)
from afspm.model.bias import BiasReference
from afspm.model.panel import ChangedValue
from afspm.model.requests import AS_PLANNED_REQUEST, KEEP_REQUEST, LEND_REQUEST, Setting, Settings
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import TranslatorDown
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.settings import ControlSettings, SchedulerSettings

BAD = Problem.FEEDBACK_NON_OPTIMAL
LEFT = "a sets tip-bias-voltage 500 mV again (you left 700 mV)"


def overruled(desk: Desk) -> list[str]:
    return [one.text for one in desk.core.state.plans.in_force]


def shown(desk: Desk) -> list[str]:
    """Return what the newest `Loans` says."""
    found = desk.core.state.loans.shown
    assert found is not None
    return [one.text for one in found.overruled]


def solves(desk: Desk, *values: str, solver: str = "tuner") -> None:
    """Flag, get control as the solver, set the gain to these values, and clear the problem."""
    desk.says("watch", ControlRequest.ADD_EXP_PRBLM, int(BAD))
    desk.says(solver, ControlRequest.REQUEST_CTRL, int(BAD))
    desk.serve()
    for value in values:
        assert desk.asked(solver, PARAM, Parameter(GAIN, value)).ok
    desk.says(solver, ControlRequest.RMV_EXP_PRBLM, int(BAD))
    desk.says(solver, ControlRequest.RELEASE_CTRL)
    desk.serve()


def acts(desk: Desk, value: float, before: float = 0.5, name: str = BIAS) -> None:
    """Turn a knob that the translator watches."""
    desk.panel[name] = value
    change = ChangedValue(name, f"{before:g}", f"{value:g}", "V")
    desk.publish("ActByHand", ActByHand(desk.now_ns, PanelAct.VALUES, "", (change,)))
    desk.serve()


# --- by a person ---


@pytest.mark.parametrize("is_watched", [True, False])
def test_value_at_the_panel_takes_the_place_of_the_plans_until_the_run_ends(*, is_watched: bool) -> None:
    desk = Desk()
    desk.measures("a", **A)
    if is_watched:
        acts(desk, 0.7)
    else:
        desk.panel[BIAS] = 0.7
    for _ in range(2):
        desk.measures("a", **A)
        desk.measures("b", **B)
        desk.measures("c")
    assert [one[BIAS] for one in desk.measured[1:]] == [0.7, -1.0, 0.7] * 2
    said = "a measures at tip-bias-voltage 700 mV, set at the microscope; it states 500 mV"
    assert desk.log().count(said) == 1
    assert shown(desk) == [said]


def test_answer_to_a_lend_has_the_value_with_which_it_is_measured() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.7
    desk.take_control("a")
    (found,) = desk.codec.decode_packet("LentSettings", desk.lends("a", **A).payload).parameters
    assert float(found.value) == 0.7
    assert desk.sets == [(BIAS, 0.5)]


def test_value_at_the_panel_is_for_all_that_state_the_same_and_others_are_named() -> None:
    desk = Desk()
    for name, settings in (("d", A), ("b", B), ("a", A)):
        desk.measures(name, **settings)
    desk.panel[BIAS] = 0.7
    for name, settings in (("d", A), ("b", B), ("a", A)):
        desk.measures(name, **settings)
    assert [one[BIAS] for one in desk.measured[3:]] == [0.7, -1.0, 0.7]
    assert "b still sets tip-bias-voltage -1 V" in desk.log()


def test_person_beside_the_one_in_control_overrules_and_a_program_does_not() -> None:
    desk = Desk(
        SchedulerSettings(control=QUICK, rules=Rules(RoleTable(operate=("page",)), adjustable=frozenset((BIAS,))))
    )
    desk.measures("a", **A)
    desk.take_control("script")
    assert desk.asked("script", PARAM, Parameter(BIAS, "0.3", "V")).ok
    desk.says("script", ControlRequest.RELEASE_CTRL)
    desk.measures("a", **A)
    assert overruled(desk) == []
    assert desk.asked("page:ada", PARAM, Parameter(BIAS, "0.7", "V")).ok
    assert overruled(desk) == ["a measures at tip-bias-voltage 700 mV, set by page:ada; it states 500 mV"]
    desk.measures("a", **A)
    assert [one[BIAS] for one in desk.measured] == [0.5, 0.5, 0.7]


def test_newer_decision_takes_the_place_and_the_stated_value_ends_it() -> None:
    desk = Desk()
    desk.measures("a", **A)
    for value in (0.7, 0.8):
        desk.panel[BIAS] = value
        desk.measures("a", **A)
    assert overruled(desk) == ["a measures at tip-bias-voltage 800 mV, set at the microscope; it states 500 mV"]
    desk.panel[BIAS] = 0.5
    desk.measures("a", **A)
    assert overruled(desk) == []
    assert "a measures at tip-bias-voltage 500 mV again, as it states" in desk.log()


def test_knob_turned_and_turned_back_to_the_base_overrules_nothing() -> None:
    desk = Desk()
    desk.measures("a", **A)
    acts(desk, 0.7)
    acts(desk, 0.1, before=0.7)
    desk.measures("a", **A)
    assert desk.measured[-1][BIAS] == 0.5
    assert overruled(desk) == []


@pytest.mark.parametrize("unseen", ["manual", "translator", "scheduler"])
def test_value_that_was_set_unseen_is_a_base_alone(unseen: str) -> None:
    desk = Desk()
    desk.measures("a", **A)
    if unseen == "manual":
        desk.mode("ada", ControlMode.MANUAL)
        desk.mode("ada", ControlMode.AUTOMATED)
    elif unseen == "translator":
        desk.step(TranslatorDown())
        desk.translator()
    else:
        desk = desk.restarted()
    desk.panel[BIAS] = 0.7
    desk.measures("a", **A)
    desk.measures("c")
    assert [one[BIAS] for one in desk.measured[-2:]] == [0.5, 0.7]


def test_point_of_a_sweep_is_never_overruled() -> None:
    desk = Desk()
    desk.take_control("iv")
    for _ in range(2):
        point = Settings((Setting(Parameter(BIAS, "0.5", "V"), is_swept=True),))
        assert desk.asked("iv", LEND_REQUEST, point).ok
        assert desk.panel[BIAS] == 0.5
        desk.panel[BIAS] = 0.7
    assert overruled(desk) == []


def test_value_beyond_the_limits_takes_no_place() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(low=-1.0, high=1.0, unit="V")))
    desk.measures("a", **A)
    desk.panel[BIAS] = 3.0
    desk.measures("a", **A)
    assert desk.measured[-1][BIAS] == 0.5
    assert "3 V is its base from now on" in desk.log()


def test_overruling_outlives_kills_and_ends_with_its_plan() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.7
    desk.measures("a", **A)
    again = desk.restarted()
    again.measures("a", **A)
    assert again.measured[-1][BIAS] == 0.7
    assert again.sets == [(BIAS, 0.5)]
    again.gives_back("a")
    assert overruled(again) == []


# --- by the solver of a problem ---


def test_gain_that_a_tuner_found_takes_the_place_of_the_plans() -> None:
    desk = Desk()
    desk.measures("a", zctrl_igain="5")
    solves(desk, "300", "40")
    for _ in range(2):
        desk.measures("a", zctrl_igain="5")
        desk.measures("c")
    assert [one[GAIN] for one in desk.measured] == [5.0, 40.0, 40.0, 40.0, 40.0]
    assert overruled(desk) == ["a measures at zctrl-igain 40, set by tuner; it states 5"]


def test_gain_found_by_the_wire_of_the_paper_counts_too() -> None:
    desk = Desk()
    desk.measures("a", zctrl_igain="5")
    desk.says("watch", ControlRequest.ADD_EXP_PRBLM, int(BAD))
    desk.says("tuner", ControlRequest.REQUEST_CTRL, int(BAD))
    desk.serve()
    assert desk.asked("tuner", ControlRequest.SET_ZCTRL_PARAMS, Feedback(integral_gain=40.0)).ok
    desk.says("tuner", ControlRequest.RMV_EXP_PRBLM, int(BAD))
    desk.says("tuner", ControlRequest.RELEASE_CTRL)
    desk.measures("a", zctrl_igain="5")
    assert desk.measured[-1][GAIN] == 40.0


@pytest.mark.parametrize("values", [("300", "600"), ()])
def test_what_a_solver_sets_and_sets_back_overrules_nothing(values: tuple[str, ...]) -> None:
    desk = Desk()
    desk.measures("a", zctrl_igain="5")
    solves(desk, *values)
    desk.measures("a", zctrl_igain="5")
    assert desk.measured[-1][GAIN] == 5.0
    assert overruled(desk) == []


def test_finding_is_for_the_plan_that_was_found_bad_alone() -> None:
    desk = Desk()
    for name in ("b", "a", "a"):
        desk.measures(name, zctrl_igain="5")
    solves(desk, "40")
    desk.measures("b", zctrl_igain="5")
    desk.measures("a", zctrl_igain="5")
    assert [one[GAIN] for one in desk.measured[-2:]] == [5.0, 40.0]


def test_solver_that_loses_control_has_found_nothing() -> None:
    desk = Desk()
    desk.measures("a", zctrl_igain="5")
    desk.says("watch", ControlRequest.ADD_EXP_PRBLM, int(BAD))
    desk.says("tuner", ControlRequest.REQUEST_CTRL, int(BAD))
    desk.serve()
    desk.asked("tuner", PARAM, Parameter(GAIN, "40"))
    desk.says("tuner", ControlRequest.RELEASE_CTRL)
    desk.says("watch", ControlRequest.RMV_EXP_PRBLM, int(BAD))
    desk.measures("a", zctrl_igain="5")
    assert desk.measured[-1][GAIN] == 5.0


# --- MANUAL ---


def manual_with_a_value(desk: Desk) -> None:
    desk.measures("a", **A)
    desk.measures("b", **B)
    desk.mode("ada", ControlMode.MANUAL)
    acts(desk, 0.7, before=-1.0)


def test_what_a_person_leaves_is_listed_with_the_plans_that_set_their_own_again() -> None:
    desk = Desk()
    manual_with_a_value(desk)
    assert shown(desk) == [LEFT, "b sets tip-bias-voltage -1 V again (you left 700 mV)"]
    desk.mode("ada", ControlMode.AUTOMATED)
    desk.measures("a", **A)
    assert desk.measured[-1][BIAS] == 0.5
    assert shown(desk) == []


def test_what_a_person_keeps_overrules_from_then_on() -> None:
    desk = Desk()
    manual_with_a_value(desk)
    assert desk.asked("terminal:ada", KEEP_REQUEST, Settings()).ok
    assert "a measures at tip-bias-voltage 700 mV, set by terminal:ada; it states 500 mV" in shown(desk)
    desk.mode("ada", ControlMode.AUTOMATED)
    for name, settings in (("a", A), ("b", B)):
        desk.measures(name, **settings)
        assert desk.measured[-1][BIAS] == 0.7
    assert desk.asked("terminal:ada", AS_PLANNED_REQUEST, Settings.of(Parameter(BIAS))).ok
    desk.measures("a", **A)
    assert desk.measured[-1][BIAS] == 0.5


def test_as_planned_of_one_parameter_leaves_the_others() -> None:
    desk = Desk()
    more = {**A, "scan_speed": "1000 nm/s"}
    desk.measures("a", **more)
    desk.panel.update({BIAS: 0.7, SPEED: 3e-6})
    desk.measures("a", **more)
    desk.asked("page:ada", AS_PLANNED_REQUEST, Settings.of(Parameter(SPEED)))
    desk.measures("a", **more)
    assert (desk.measured[-1][BIAS], desk.measured[-1][SPEED]) == (0.7, 1e-6)


def test_values_are_kept_in_manual_alone() -> None:
    desk = Desk()
    refused = desk.asked("page:ada", KEEP_REQUEST, Settings())
    assert refused.code == ControlResponse.FAILURE
    assert "before the run continues" in refused.reason


# --- the second name of a bias ---


def test_lend_under_the_name_of_the_samples_bias_is_answered_and_refused_under_it() -> None:
    limits = ExperimentLimits(
        {BIAS: Limit(low=-1.0, high=1.0, unit="V")}, bias=BiasReference("tip", may_have_second=True)
    )
    desk = Desk(SchedulerSettings(control=QUICK, limits=limits))
    desk.panel[names.SAMPLE_BIAS] = 0.0
    desk.take_control("a")
    answer = desk.lends("a", sample_bias="0.5 V")
    assert answer.ok, answer.reason
    (found,) = desk.codec.decode_packet("LentSettings", answer.payload).parameters
    assert (found.name, float(found.value), desk.panel[BIAS]) == (names.BIAS_OF_SAMPLE, 0.5, -0.5)
    desk.panel[BIAS] = -0.7
    point = Settings(
        (Setting(Parameter(names.BIAS_OF_SAMPLE, "0.5", "V"), is_swept=True), Setting(Parameter(GAIN, "5")))
    )
    answer = desk.asked("a", LEND_REQUEST, point)
    found = {one.name: one.value for one in desk.codec.decode_packet("LentSettings", answer.payload).parameters}
    assert {name: float(value) for name, value in found.items()} == {names.BIAS_OF_SAMPLE: 0.5, GAIN: 5.0}
    assert "here sample-bias is -tip-bias-voltage" in desk.lends("a", sample_bias="3 V").reason
    desk.panel[names.SAMPLE_BIAS] = 0.2
    assert "is the whole voltage only while the second electrode is at 0 V" in desk.lends("a", sample_bias="1 V").reason


def test_value_that_may_be_rounded_by_a_translator_of_another_make_is_a_base_alone() -> None:
    desk = Desk()
    desk.compares = False
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.5001
    desk.measures("a", **A)
    assert (desk.measured[-1][BIAS], overruled(desk)) == (0.5, [])


# --- again, and at its borders ---


def page_desk() -> Desk:
    rules = Rules(RoleTable(operate=("page",)), adjustable=frozenset((GAIN, BIAS)))
    return Desk(SchedulerSettings(control=QUICK, rules=rules))


def test_gain_that_is_turned_down_twice_is_the_second_one() -> None:
    desk = page_desk()
    desk.measures("a", zctrl_igain="5")
    for value in ("2", "1"):
        assert desk.asked("page:ada", PARAM, Parameter(GAIN, value)).ok
    desk.measures("a", zctrl_igain="5")
    assert desk.measured[-1][GAIN] == 1.0


def test_knob_that_is_turned_again_while_another_measures_counts() -> None:
    desk = Desk()
    desk.measures("a", **A)
    acts(desk, 0.7)
    desk.measures("a", **A)
    desk.measures("c")
    acts(desk, 0.3, before=0.7)
    desk.measures("a", **A)
    assert desk.measured[-1][BIAS] == 0.3
    acts(desk, 0.5, before=0.3)
    desk.measures("a", **A)
    assert (desk.measured[-1][BIAS], overruled(desk)) == (0.5, [])


@pytest.mark.parametrize(("bad", "right"), [("a", [40.0, 20.0]), ("b", [5.0, 40.0]), ("", [5.0, 20.0])])
def test_finding_during_the_next_plans_scan_is_for_the_plan_whose_settings_the_solver_states(
    bad: str, right: list[float]
) -> None:
    desk, gains = Desk(), {"a": "5", "b": "20"}
    for name in ("a", "b"):
        desk.measures(name, zctrl_igain=gains[name])
    desk.says("watch", ControlRequest.ADD_EXP_PRBLM, int(BAD))
    desk.says("tuner", ControlRequest.REQUEST_CTRL, int(BAD))
    desk.serve()
    if bad:
        assert desk.lends("tuner", zctrl_igain=gains[bad]).ok
    assert desk.asked("tuner", PARAM, Parameter(GAIN, "40")).ok
    desk.says("tuner", ControlRequest.RMV_EXP_PRBLM, int(BAD))
    desk.says("tuner", ControlRequest.RELEASE_CTRL)
    for name in ("a", "b"):
        desk.measures(name, zctrl_igain=gains[name])
    assert [one[GAIN] for one in desk.measured[-2:]] == right


def test_value_set_back_by_a_controller_that_rounds_is_no_finding() -> None:
    desk = Desk()
    desk.rounds = 20 / 65536
    desk.measures("a", **A)
    desk.says("watch", ControlRequest.ADD_EXP_PRBLM, int(BAD))
    desk.says("tuner", ControlRequest.REQUEST_CTRL, int(BAD))
    desk.serve()
    for value in ("3", "0.1"):
        desk.asked("tuner", PARAM, Parameter(BIAS, value, "V"))
    desk.says("tuner", ControlRequest.RMV_EXP_PRBLM, int(BAD))
    desk.serve()
    assert overruled(desk) == []


def test_gain_that_is_the_base_by_now_is_found_for_a_second_plan_too() -> None:
    desk = Desk()
    desk.measures("a", zctrl_igain="5")
    solves(desk, "40")
    desk.measures("b", zctrl_igain="20")
    desk.measures("b", zctrl_igain="20")
    solves(desk, "40")
    desk.measures("b", zctrl_igain="20")
    assert desk.measured[-1][GAIN] == 40.0


def test_value_beyond_the_limits_is_not_kept() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(low=-1.0, high=1.0, unit="V")))
    desk.measures("a", **A)
    desk.mode("ada", ControlMode.MANUAL)
    acts(desk, 3.0)
    assert not desk.asked("terminal:ada", KEEP_REQUEST, Settings()).ok
    acts(desk, 0.5, before=3.0)
    desk.mode("ada", ControlMode.AUTOMATED)
    assert desk.measures("a", **A).ok


def test_act_that_leads_to_manual_and_a_feedback_set_in_it_are_listed() -> None:
    desk = Desk(SchedulerSettings(control=ControlSettings(settle_s=0.0, changed_by_hand="pause")))
    desk.measures("a", **A, zctrl_igain="5")
    desk.publish("ZCtrlParameters", Feedback(integral_gain=5.0))
    acts(desk, 0.7)
    assert shown(desk) == [LEFT]
    desk.publish("ZCtrlParameters", Feedback(integral_gain=3.0))
    assert set(shown(desk)) == {LEFT, "a sets zctrl-igain 5 again (you left 3)"}


def test_plan_that_is_given_up_is_overruled_no_more() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.7
    desk.measures("a", **A)
    desk.give_up("a")
    desk.serve()
    assert shown(desk) == []


def test_rounding_of_a_line_rate_and_another_width_are_no_decision_about_a_speed() -> None:
    desk = Desk()
    desk.measures("a", scan_speed="2 um/s")
    desk.panel[SPEED] = 2.008e-6  # since a new frame has another rounding
    desk.measures("b", scan_speed="1 um/s")
    desk.measures("c")
    desk.measures("a", scan_speed="2 um/s")
    assert [one[SPEED] for one in desk.measured[1:]] == [1e-6, 1e-6, 2e-6]
    assert "reads" not in desk.log()
    desk.panel[names.SCAN_SIZE_X] = 1e-7
    desk.panel[SPEED] = 5e-7
    acts(desk, 1e-7, before=4e-7, name=names.SCAN_SIZE_X)
    desk.measures("a", scan_speed="2 um/s")
    assert (desk.measured[-1][SPEED], overruled(desk)) == (2e-6, [])
    assert "500 nm/s is its base from now on" in desk.log()


def test_each_of_the_values_of_a_survey_has_a_place_of_its_own() -> None:
    desk = Desk()
    for _ in range(2):
        desk.measures("a", **A)
        desk.measures("a", **B)
    desk.panel[BIAS] = 0.3  # in the place of -1 V
    for settings in (A, B):
        desk.measures("a", **settings)
    desk.panel[BIAS] = 0.4
    for settings in (A, B):
        desk.measures("a", **settings)
    assert [one[BIAS] for one in desk.measured[4:]] == [0.5, 0.3, 0.5, 0.4]


def test_value_that_a_script_states_no_more_is_forgotten() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.7
    desk.measures("a", **A)
    for volts in range(2, 7):
        desk.measures("a", tip_bias_voltage=f"{volts} V")
    assert overruled(desk) == []
    assert len(desk.core.state.plans.stated["a"]) == 4


def test_component_keeps_nothing_for_a_person() -> None:
    desk = Desk()
    manual_with_a_value(desk)
    desk.tell(ProcessState("a", "component", ProcessCondition.ALIVE, 1))
    refused = desk.asked("a", KEEP_REQUEST, Settings())
    assert "never a component or agent" in refused.reason
