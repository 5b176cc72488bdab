"""Settings of measurements: lent before them, set back for those that do not state them, whatever happens between."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, as_saved, replies

from afspm.basics.units import convert
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    Problem,
    Response,
    ResponseDetail,
    ScopeState,
    names,
)
from afspm.model.parameter_names import BASE_PARAMETERS, OF_CURVES
from afspm.model.requests import COMPARE_REQUEST, LEND_REQUEST, RETURN_REQUEST, Setting, Settings
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import Log, SaveState, Tick, TranslatorDown
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.settings import ControlSettings, SchedulerSettings

BIAS, SETPOINT, GAIN, SPEED = names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT, names.ZCTRL_IGAIN, names.SCAN_SPEED
UNITS = {**BASE_PARAMETERS, **OF_CURVES, SETPOINT: "A", names.SPEC_KIND: "", names.SAMPLE_BIAS: "V"}
ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
QUICK = ControlSettings(settle_s=0.0)


class Desk(Lab):
    """A scheduler beside a microscope with some parameters, whose panel others may use.

    Attributes:
        panel: the values in force, in SI.
        sets: what was set, in order.
        measured: the values at each start.
        refuses: values that the microscope refuses.
        compares: whether its translator answers COMPARE.
    """

    def __init__(self, settings: SchedulerSettings | None = None, panel: Desk | None = None, **more: Any) -> None:
        self.panel: dict[str, float | str] = {BIAS: 0.1, SETPOINT: 5e-11, GAIN: 600.0, SPEED: 1e-6}
        self.sets: list[tuple[str, float | str]] = []
        self.measured: list[dict[str, float | str]] = []
        self.refuses: Callable[[str, float | str], str] = lambda name, value: ""
        self.compares, self.rounds = True, 0.0
        if panel is not None:
            self.panel, self.sets, self.measured, self.refuses = panel.panel, panel.sets, panel.measured, panel.refuses
        super().__init__(settings or SchedulerSettings(control=QUICK), **more)
        self.translator()
        self.scope_is(ScopeState.FREE)
        self.serve()

    # --- the microscope ---

    def serve(self) -> None:
        """Let the translator answer all requests."""
        while (asked := self.in_flight()) is not None:
            self.answer_one(asked)

    def answer_one(self, asked: Any) -> None:
        self.answer(asked, *self._answered(asked.request))

    def _answered(self, request: Any) -> tuple[ControlResponse, bytes, str]:
        subject, done = request.subject, ControlResponse.SUCCESS
        if request.kind == COMPARE_REQUEST and not self.compares:
            return ControlResponse.CMD_NOT_SUPPORTED, b"", ""
        if request.kind == COMPARE_REQUEST:
            found = [
                Setting(self._shown(one.parameter.name), tuple(filter(self._is_there, one.known)))
                for one in subject.settings
                if one.parameter.name in self.panel
            ]
            return done, self.codec.encode(Settings(tuple(found))), ""
        if request.kind == PARAM and subject.name not in self.panel:
            return ControlResponse.PARAM_NOT_SUPPORTED, b"", ""
        if request.kind == PARAM and subject.value is not None:
            value = in_si(subject)
            if why := self.refuses(subject.name, value):
                return ControlResponse.PARAM_ERROR, b"", why
            if self.rounds and isinstance(value, float):
                value = round(value / self.rounds) * self.rounds
            self.panel[subject.name] = value
            self.sets.append((subject.name, value))
        if request.kind == PARAM:
            return done, self.codec.encode(self._shown(subject.name)), ""
        if request.kind == ACTION and subject in (names.START_SCAN, names.START_SPEC, names.PULSE):
            self.measured.append(dict(self.panel))
        return done, b"", ""

    def _shown(self, name: str) -> Parameter:
        value = self.panel[name]
        return Parameter(name, value if isinstance(value, str) else f"{value:.12g}", UNITS.get(name) or None)

    def _is_there(self, one: Parameter) -> bool:
        there, value = self.panel[one.name], in_si(one)
        if isinstance(there, str):
            return there == value
        return abs(there - float(value)) <= max(1e-9 * abs(there), self.rounds)

    # --- components ---

    def asked(self, name: str, kind: int, subject: Any = None, id_: str = "") -> Response:
        """Send a request, let the translator answer, and return the response."""
        seen = len(replies(self.effects))
        self.ask(name, kind, subject, id_)
        self.serve()
        while len(replies(self.effects)) == seen and self.core.deadline_ns() is not None:
            self.later(experiment_s=0.1)
            self.step(Tick())
            self.serve()
        return replies(self.effects)[seen].response

    def lends(self, who: str, **settings: str) -> Response:
        return self.asked(who, LEND_REQUEST, stated(**settings))

    def gives_back(self, who: str, *parameters: str) -> Response:
        return self.asked(who, RETURN_REQUEST, Settings.of(*map(Parameter, parameters)))

    def measures(self, who: str, action: str = names.START_SCAN, **settings: str) -> Response:
        """Take a measurement as a client does: with control, its settings first, and stated again if it is asked to."""
        assert self.take_control(who) is ControlResponse.SUCCESS
        for _ in range(3):
            if settings and not (lent := self.lends(who, **settings)).ok:
                found = lent
                break
            found = self.asked(who, ACTION, action)
            if found.detail is not ResponseDetail.STATE_AGAIN:
                break
        if found.ok:
            self.scope_is(ScopeState.SCANNING)
            self.scope_is(ScopeState.FREE)
        self.says(who, ControlRequest.RELEASE_CTRL)
        self.serve()
        return found

    def log(self, level: str = "WARNING") -> str:
        return "\n".join(one.text for one in self.effects if isinstance(one, Log) and one.level == level)

    @property
    def loans(self) -> dict[str, str]:
        return {key: loan.lender for key, loan in self.core.state.loans.loans.items()}

    @property
    def saves(self) -> int:
        return sum(isinstance(one, SaveState) for one in self.effects)

    def restarted(self) -> Desk:
        saved = [one.state for one in self.effects if isinstance(one, SaveState)][-1]
        now = self.now_s, self.now_ns
        again = Desk(self.core._env.settings, self, state=as_saved(saved), codec=self.codec, now=now)
        for _ in range(3):
            again.later(real_s=1.0)
            again.step(Tick())
        return again


def stated(**settings: str) -> Settings:
    """Return settings from "0.5 V" by names with underscores."""
    given = ((name.replace("_", "-"), *value.partition(" ")[::2]) for name, value in settings.items())
    return Settings.of(*(Parameter(name, value, unit or None) for name, value, unit in given))


def in_si(parameter: Parameter) -> float | str:
    try:
        number = float(parameter.value or "")
    except ValueError:
        return parameter.value or ""
    si = UNITS.get(parameter.name) or ""
    return float(convert(number, parameter.unit or si, si)) if si else number


def limited(**limits: Limit) -> SchedulerSettings:
    by_name = {name.replace("_", "-"): limit for name, limit in limits.items()}
    return SchedulerSettings(control=QUICK, limits=ExperimentLimits(by_name))


A, B = {"tip_bias_voltage": "0.5 V"}, {"tip_bias_voltage": "-1 V"}


# settings S1
@pytest.mark.parametrize("compares", [True, False])
def test_plans_that_alternate_each_measure_with_their_own_value_and_a_third_at_the_base(*, compares: bool) -> None:
    desk = Desk()
    desk.compares = compares
    for _ in range(2):
        desk.measures("a", **A)
        desk.measures("b", **B)
        desk.measures("c")
    assert [one[BIAS] for one in desk.measured] == [0.5, -1.0, 0.1] * 2
    assert desk.sets == [(BIAS, value) for value in (0.5, -1.0, 0.1)] * 2
    assert desk.loans == {}


def test_plan_alone_sets_once_and_saves_no_more_than_before() -> None:
    desk, plain = Desk(), Desk()
    for lab, settings in ((desk, A), (plain, {})):
        lab.measures("a", **settings)
        before = lab.saves
        for _ in range(10):
            lab.measures("a", **settings)
        lab.told = lab.saves - before  # type: ignore[attr-defined]
    assert desk.sets == [(BIAS, 0.5)]
    assert desk.told <= plain.told + 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("limit", [Limit(interval_s=300.0), Limit(rate_per_s=0.01, unit="V"), Limit(only=("a",))])
def test_value_in_force_is_not_set_again_and_no_limit_judges_it(limit: Limit) -> None:
    desk = Desk(limited(tip_bias_voltage=limit))
    desk.later(experiment_s=1000.0)
    assert all(desk.measures("a", **A).ok for _ in range(5))
    assert desk.sets == [(BIAS, 0.5)]


def test_return_sets_the_base_back_and_is_answered_then() -> None:
    desk = Desk()
    desk.measures("a", **A, zctrl_igain="5")
    assert desk.gives_back("a", GAIN).ok
    assert (desk.panel[GAIN], desk.panel[BIAS]) == (600.0, 0.5)
    assert desk.gives_back("a").ok
    assert desk.panel[BIAS] == 0.1
    assert desk.loans == {}


def test_return_of_what_another_has_lent_since_is_ignored() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.measures("b", **B)
    desk.gives_back("a")
    assert desk.panel[BIAS] == -1.0
    assert desk.loans == {BIAS: "b"}


def test_base_is_the_value_before_the_first_loan() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.measures("b", **B)
    desk.gives_back("b")
    assert desk.panel[BIAS] == 0.1


# --- others act ---


def test_value_of_a_person_is_the_base_and_logged() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.7
    desk.measures("c")
    assert desk.measured[-1][BIAS] == 0.7
    assert "tip-bias-voltage reads 700 mV, and not the 500 mV that a has lent it" in desk.log()
    desk.measures("a", **A)
    desk.gives_back("a")
    assert desk.panel[BIAS] == 0.7


def test_person_who_sets_the_base_leaves_nothing_to_set_back() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.panel[BIAS] = 0.1
    desk.measures("c")
    assert desk.sets == [(BIAS, 0.5)]
    assert "reads" not in desk.log()


def test_value_that_a_request_sets_is_the_base() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.take_control("script")
    desk.asked("script", PARAM, Parameter(BIAS, "0.3", "V"))
    desk.says("script", ControlRequest.RELEASE_CTRL)
    desk.measures("b", **B)
    desk.gives_back("b")
    assert desk.panel[BIAS] == 0.3


def test_manual_changes_nothing_and_the_next_measurement_reads_first() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.mode("person", ControlMode.MANUAL)
    desk.gives_back("a")
    desk.give_up("a")
    desk.later(real_s=60.0, experiment_s=3600.0)
    desk.step(Tick())
    desk.serve()
    assert desk.sets == [(BIAS, 0.5)]
    desk.panel[BIAS] = 0.7
    desk.mode("person", ControlMode.AUTOMATED)
    desk.serve()
    assert desk.sets == [(BIAS, 0.5)]
    assert desk.loans == {}


def test_lend_in_manual_is_a_decision() -> None:
    roles = RoleTable(operate=("person",))
    desk = Desk(SchedulerSettings(control=QUICK, rules=Rules(roles)))
    desk.mode("person", ControlMode.MANUAL)
    assert desk.lends("person", **A).ok
    desk.mode("person", ControlMode.AUTOMATED)
    desk.measures("c")
    assert desk.measured[-1][BIAS] == 0.5


def test_solver_of_a_problem_finds_the_base_and_its_own_values_hold_for_it() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.flag("judge", Problem.TIP_SHAPE_CHANGED)
    desk.take_control("corrector", Problem.TIP_SHAPE_CHANGED)
    desk.serve()
    assert desk.panel[BIAS] == 0.1
    desk.lends("corrector", **B)
    desk.asked("corrector", ACTION, names.START_SCAN)
    desk.asked("corrector", ACTION, names.PULSE)
    assert [one[BIAS] for one in desk.measured] == [0.5, -1.0, 0.1]


def test_nothing_is_set_back_in_a_measurement_that_another_has_asked_for() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.take_control("b")
    desk.asked("b", LEND_REQUEST, stated(**B))
    desk.asked("b", ACTION, names.START_SCAN)
    desk.scope_is(ScopeState.SCANNING)
    desk.give_up("a")
    desk.gives_back("b")
    desk.serve()
    assert desk.panel[BIAS] == -1.0
    desk.scope_is(ScopeState.FREE)
    desk.serve()
    assert desk.panel[BIAS] == 0.1, "by its lender, though it is in control"


# --- a lender goes ---


def test_loans_of_a_component_that_is_given_up_are_set_back() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.give_up("a")
    desk.serve()
    assert desk.panel[BIAS] == 0.1


def test_loans_of_a_client_whose_host_is_gone_are_set_back_after_its_grace() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.is_gone("a")
    desk.serve()
    assert desk.panel[BIAS] == 0.5
    desk.later(real_s=desk.core._env.settings.control.grace_s)
    desk.step(Tick())
    desk.serve()
    assert desk.panel[BIAS] == 0.1


def test_no_value_stays_for_hours_at_a_free_microscope() -> None:
    desk = Desk()
    desk.measures("a", **A)
    due_ns = desk.core.deadline_ns()
    assert due_ns == pytest.approx(desk.now_ns + 600e9, abs=1e6)
    desk.later(experiment_s=600.0)
    desk.step(Tick())
    desk.serve()
    assert desk.panel[BIAS] == 0.1


def test_end_waits_for_settings_on_their_way_back() -> None:
    desk = Desk()
    desk.measures("a", **A)
    assert not [one for one in desk.ask("a", ControlRequest.END_EXPERIMENT) if type(one).__name__ == "Kill"]
    desk.serve()
    assert desk.panel[BIAS] == 0.1
    assert any(type(one).__name__ == "Kill" for one in desk.effects)


def test_end_in_a_step_of_a_way_back_completes_it() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.1, unit="V")))
    desk.measures("a", **A)
    desk.ask("a", RETURN_REQUEST, Settings())
    desk.answer_one(desk.in_flight())
    desk.ask("b", ControlRequest.END_EXPERIMENT)
    desk.serve()
    assert desk.panel[BIAS] == 0.1


def test_end_says_what_could_not_be_set_back() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.refuses = lambda name, value: "no" if value == 0.1 else ""
    desk.ask("a", ControlRequest.END_EXPERIMENT)
    desk.serve()
    assert any(type(one).__name__ == "Kill" for one in desk.effects)
    assert "ended with tip-bias-voltage 500 mV, lent by a (100 mV before)" in desk.log()


# --- refused on the way ---


def test_measurement_at_a_base_that_is_refused_is_refused_by_lender_values_and_remedy() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.refuses = lambda name, value: "the range is 0.2 to 5 V" if value == 0.1 else ""
    refusal = desk.measures("c")
    assert refusal.code == ControlResponse.ACTION_ERROR
    for part in ("500 mV, lent by a (100 mV before)", "the range is 0.2 to 5 V", "set it back at the panel"):
        assert part in refusal.reason
    assert desk.measures("a", **A).ok, "plans that state it measure on"
    desk.gives_back("a")
    desk.serve()
    assert desk.panel[BIAS] == 0.5
    desk.refuses = lambda name, value: ""
    assert desk.measures("c").ok
    assert desk.measured[-1][BIAS] == 0.1


@pytest.mark.parametrize("gain", ["5", "5000"])  # the first value, and the second
def test_measurement_with_a_value_that_is_refused_leaves_the_others_their_base(gain: str) -> None:
    desk = Desk()
    desk.refuses = lambda name, value: "no such gain" if name == GAIN else ""
    assert desk.measures("a", **A, zctrl_igain=gain).reason == "no such gain"
    assert desk.measures("c").ok
    assert desk.measured == [dict(desk.panel)]
    assert desk.panel[BIAS] == 0.1


def test_base_outside_of_the_limits_is_not_set_back_and_its_measurement_is_refused() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(0.2, 5.0, unit="V", source="experiment.toml:3")))
    assert desk.measures("a", **A).ok
    assert "experiment.toml:3" in desk.measures("c").reason
    assert desk.measures("a", **A).ok


def test_lend_during_a_measurement_waits() -> None:
    desk = Desk()
    desk.take_control("a")
    desk.scope_is(ScopeState.SCANNING)
    assert desk.lends("a", **A).code == ControlResponse.NOT_FREE
    assert desk.sets == []


def test_lend_of_nothing_takes_back_what_was_stated() -> None:
    desk = Desk()
    desk.take_control("a")
    desk.lends("a", **A)
    desk.lends("a")
    desk.asked("a", ACTION, names.START_SCAN)
    assert desk.measured[-1][BIAS] == 0.1


def test_way_goes_in_the_steps_that_limits_allow() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.25, unit="V")))
    for _ in range(2):
        assert desk.measures("a", tip_bias_voltage="0.3 V").ok
        assert desk.measures("b", tip_bias_voltage="-0.1 V").ok
    assert [one[BIAS] for one in desk.measured] == [0.3, -0.1] * 2
    ways = [0.1, *(float(value) for _, value in desk.sets)]
    assert max(abs(b - a) for a, b in itertools.pairwise(ways)) <= 0.25 + 1e-9


@pytest.mark.parametrize(
    ("start", "end"), [(0.5, -1.0), (-1.0, 0.5), (0.1, -0.9), (0.5, -0.01), (0.01, -0.5), (1.0, -1.0), (0.2, -0.2)]
)
def test_no_step_of_a_bias_ends_near_zero(start: float, end: float) -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.25, unit="V")))
    desk.panel[BIAS] = start
    desk.measures("a", tip_bias_voltage=f"{end} V")
    way = [start, *(float(value) for _, value in desk.sets)]
    assert way[-1] == end
    assert all(abs(b - a) <= 0.25 * (1 + 1e-9) for a, b in itertools.pairwise(way))
    assert min(map(abs, way)) >= min(0.125, abs(start), abs(end))
    assert sum(a * b < 0.0 for a, b in itertools.pairwise(way)) == 1


def test_bias_passes_zero_at_a_controller_that_rounds() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.1, unit="V")))
    desk.rounds = 20 / 65536
    assert desk.measures("b", **B).ok
    assert min(abs(float(value)) for _, value in desk.sets) >= 0.04


def test_value_beyond_its_range_is_refused_before_the_first_step_to_it() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(high=3.0, step=0.25, unit="V")))
    assert "above the highest allowed, 3 V" in desk.measures("a", tip_bias_voltage="4 V").reason
    assert desk.sets == []


def test_steps_at_a_controller_that_rounds_end_at_the_value() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.03, unit="V")))
    desk.rounds = 0.01
    assert desk.measures("a", tip_bias_voltage="0.5 V").ok
    assert desk.measured[-1][BIAS] == pytest.approx(0.5)


def test_step_that_the_controller_rounds_away_is_refused() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.01, unit="V")))
    desk.rounds = 0.1
    refusal = desk.measures("a", tip_bias_voltage="0.5 V")
    assert "stays at 100 mV" in refusal.reason


def test_limit_on_time_lets_the_lender_wait() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(rate_per_s=0.01, unit="V")))
    desk.take_control("a")
    refusal = desk.lends("a", **A)
    assert refusal.again_ns == pytest.approx(desk.now_ns + 40e9, abs=1e9)
    desk.later(experiment_s=41.0)
    assert desk.lends("a", **A).ok
    assert desk.gives_back("a").again_ns is not None, "the way back waits, too"


SETTINGS = [("1 V", "1 nA"), ("10 mV", "10 pA"), ("0.1 V", "50 pA"), ("2 V", "5 pA")]


@pytest.mark.parametrize(("first", "second"), list(itertools.permutations(SETTINGS, 2)))
def test_no_gap_between_two_settings_is_narrower_than_both(first: tuple[str, str], second: tuple[str, str]) -> None:
    desk = Desk()
    ways: list[float] = []
    for bias, setpoint in (first, second):
        before, begun = dict(desk.panel), len(desk.sets)
        desk.measures("a", tip_bias_voltage=bias, zctrl_setpoint=setpoint)
        ways = list(gaps(before, desk.sets[begun:]))
        assert min(ways) >= min(ways[0], ways[-1]) * (1 - 1e-12)
    before, begun = dict(desk.panel), len(desk.sets)
    desk.measures("c")
    ways = list(gaps(before, desk.sets[begun:]))
    assert min(ways) >= min(ways[0], ways[-1]) * (1 - 1e-12)


def gaps(before: dict[str, Any], sets: list[tuple[str, Any]]) -> Iterator[float]:
    now = dict(before)
    yield abs(now[BIAS] / now[SETPOINT])
    for name, value in sets:
        now[name] = value
        yield abs(now[BIAS] / now[SETPOINT])


def test_gain_that_falls_goes_first_and_one_that_rises_last() -> None:
    desk = Desk()
    desk.measures("a", **A, zctrl_igain="5")
    desk.measures("c")
    assert [name for name, _ in desk.sets] == [GAIN, BIAS, BIAS, GAIN]


# --- what is stated ---


def test_second_measurement_that_states_nothing_is_at_the_base_also_of_the_lender_itself() -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.measures("a")
    assert [one[BIAS] for one in desk.measured] == [0.5, 0.1]


def test_start_that_is_refused_as_busy_has_begun_nothing() -> None:
    desk = Desk()
    desk.take_control("a")
    desk.lends("a", **A)
    desk.ask("a", ACTION, names.START_SCAN)
    asked = desk.in_flight()
    assert asked is not None
    desk.answer(asked, ControlResponse.NOT_FREE)
    assert desk.asked("a", ACTION, names.START_SCAN).ok
    assert desk.measured[-1][BIAS] == 0.5


def test_repeated_start_sets_nothing_back() -> None:
    desk = Desk()
    desk.take_control("a")
    desk.lends("a", **A)
    desk.ask("a", ACTION, names.START_SCAN, id_="a/1/7")
    asked = desk.in_flight()
    assert asked is not None
    desk.answer(asked, ControlResponse.NO_RESPONSE, detail=ResponseDetail.OUTCOME_UNKNOWN)
    desk.asked("a", ACTION, names.START_SCAN, id_="a/1/7")
    assert desk.panel[BIAS] == 0.5


@pytest.mark.parametrize("what", ["scheduler", "translator"])
def test_after_a_restart_between_lend_and_start_it_is_stated_again(what: str) -> None:
    desk = Desk()
    desk.take_control("a")
    desk.lends("a", **A)
    if what == "scheduler":
        desk = desk.restarted()
    else:
        desk.step(TranslatorDown())
        desk.translator()
    assert desk.asked("a", ACTION, names.START_SCAN).detail is ResponseDetail.STATE_AGAIN
    assert desk.lends("a", **A).ok
    assert desk.asked("a", ACTION, names.START_SCAN).ok
    assert desk.measured[-1][BIAS] == 0.5
    assert desk.asked("a", ACTION, names.START_SCAN).ok
    assert desk.measured[-1][BIAS] == 0.1


def test_next_life_of_a_component_has_stated_nothing() -> None:
    desk = Desk()
    desk.take_control("a")
    desk.asked("a", LEND_REQUEST, stated(**A), id_="a/life1/1")
    desk.is_gone("a")
    desk.asked("a", ControlRequest.REQUEST_CTRL, 0, id_="a/life2/1")
    assert desk.asked("a", ACTION, names.START_SCAN, id_="a/key/scan/1").ok
    assert desk.measured[-1][BIAS] == 0.1


def test_restarted_scheduler_knows_base_and_lender() -> None:
    desk = Desk()
    desk.measures("a", **A)
    again = desk.restarted()
    again.measures("c")
    assert again.measured[-1][BIAS] == 0.1


@pytest.mark.parametrize("is_done", [True, False])
def test_value_whose_answer_is_lost_is_taken_for_no_act_by_hand(*, is_done: bool) -> None:
    desk = Desk()
    desk.measures("a", **A)
    desk.take_control("b")
    desk.ask("b", LEND_REQUEST, stated(**B))
    desk.answer_one(desk.in_flight())
    asked = desk.in_flight()
    assert asked is not None
    assert asked.request.subject.value == "-1"
    if is_done:
        desk.panel[BIAS] = -1.0
    desk.answer(asked, ControlResponse.NO_RESPONSE, detail=ResponseDetail.OUTCOME_UNKNOWN)
    desk.serve()
    desk.says("b", ControlRequest.RELEASE_CTRL)
    desk.measures("c")
    assert desk.measured[-1][BIAS] == 0.1
    assert "reads" not in desk.log()


def test_lender_that_states_less_gets_the_base_of_the_rest() -> None:
    desk = Desk()
    desk.measures("a", **A, zctrl_igain="5")
    desk.measures("a", **A)
    assert (desk.measured[-1][GAIN], desk.measured[-1][BIAS]) == (600.0, 0.5)


def test_parameter_that_the_microscope_lacks_is_refused() -> None:
    desk = Desk()
    del desk.panel[GAIN]
    assert desk.measures("a", zctrl_igain="5").code == ControlResponse.PARAM_NOT_SUPPORTED


def test_parameter_that_may_not_be_lent_stays_as_it_is_set() -> None:
    desk = Desk()
    desk.panel["x-mode"] = "fast"
    desk.take_control("a")
    (answered,) = desk.codec.decode(desk.lends("a", x_mode="slow").payload).settings
    assert answered == Setting(Parameter("x-mode", "slow"), (Parameter("x-mode", "fast"),), is_lent=False)
    desk.asked("a", ACTION, names.START_SCAN)
    desk.says("a", ControlRequest.RELEASE_CTRL)
    desk.measures("c")
    assert desk.panel["x-mode"] == "slow"
    assert desk.loans == {}


def test_journal_names_the_settings_in_words() -> None:
    desk = Desk()
    desk.measures("a", **A, scan_speed="2 um/s")
    desk.gives_back("a", BIAS)
    desk.gives_back("a")
    what = [one.what for one in desk.entries() if one.request in (LEND_REQUEST, RETURN_REQUEST)]
    assert what == [
        "settings of a measurement: tip-bias-voltage = 500 mV, scan-speed = 2 µm/s",
        "sets back tip-bias-voltage",
        "sets back all that it has lent",
    ]


def test_place_is_no_setting_of_a_measurement() -> None:
    desk = Desk()
    desk.take_control("a")
    assert "scan-size-x says where to measure" in desk.lends("a", scan_size_x="100 nm").reason


# --- curves ---


def curves(desk: Desk, kind: str, **settings: str) -> Response:
    desk.take_control("grid")
    if desk.panel.get(names.SPEC_KIND) != kind:
        desk.asked("grid", PARAM, Parameter(names.SPEC_KIND, kind))
    return desk.measures("grid", names.START_SPEC, **settings)


class CurveDesk(Desk):
    """Each kind of curve has a number of points of its own."""

    def __init__(self, settings: SchedulerSettings | None = None) -> None:
        super().__init__(settings)
        self.kinds: dict[float | str, float | str] = {"IV": 64.0, "z": 128.0}
        self.panel |= {names.SPEC_KIND: "IV", names.SPEC_POINTS: 64.0}

    def _answered(self, request: Any) -> tuple[ControlResponse, bytes, str]:
        subject = request.subject
        if request.kind == PARAM and subject.name == names.SPEC_KIND and subject.value:
            self.kinds[self.panel[names.SPEC_KIND]] = self.panel[names.SPEC_POINTS]
            self.panel[names.SPEC_POINTS] = self.kinds[subject.value]
        return super()._answered(request)


# physics P1, settings S4
def test_scans_between_curves_set_nothing_back() -> None:
    desk = CurveDesk()
    for _ in range(3):
        curves(desk, "IV", x_spec_points="201")
        desk.measures("watch")
    assert desk.sets == [(names.SPEC_POINTS, 201.0)]
    curves(desk, "IV")
    assert desk.measured[-1][names.SPEC_POINTS] == 64.0


def test_each_kind_of_curve_has_its_own_loan_and_base() -> None:
    desk = CurveDesk()
    curves(desk, "IV", x_spec_points="201")
    curves(desk, "z", x_spec_points="50")
    assert desk.gives_back("grid").ok
    assert desk.panel[names.SPEC_KIND] == "z", "the kind that was set last"
    assert (desk.panel[names.SPEC_POINTS], desk.kinds["IV"]) == (128.0, 64.0)
    assert desk.loans == {}
    assert "reads" not in desk.log()


def test_kind_that_can_not_be_set_leaves_its_loans_and_says_so() -> None:
    desk = CurveDesk()
    curves(desk, "IV", x_spec_points="201")
    curves(desk, "z", x_spec_points="50")
    desk.refuses = lambda name, value: "no IV now" if value == "IV" else ""
    desk.gives_back("grid")
    assert list(desk.loans) == [f"{names.SPEC_POINTS} IV"]
    desk.ask("x", ControlRequest.END_EXPERIMENT)
    desk.serve()
    assert "no IV now" in desk.log()


# --- z held ---


def test_nothing_is_lent_or_set_back_while_z_is_held() -> None:
    desk = Desk()
    desk.take_control("a")
    desk.lends("a", **A)
    desk.asked("a", ACTION, names.HOLD_Z)
    assert desk.panel[BIAS] == 0.5, "a hold begins with what was stated"
    assert "z is held" in desk.lends("a", **B).reason
    assert desk.lends("a", **A).ok, "nothing changes"
    assert desk.asked("a", ACTION, names.START_SCAN).ok
    desk.gives_back("a")
    assert desk.panel[BIAS] == 0.5
    desk.asked("a", ACTION, names.RELEASE_Z)
    desk.scope_is(ScopeState.FREE)
    desk.serve()
    assert desk.panel[BIAS] == 0.1


# --- waits ---


def test_change_with_the_tip_at_the_sample_settles_before_the_lend_is_answered() -> None:
    desk = Desk(SchedulerSettings(control=ControlSettings(settle_s=2.0)))
    began_ns = desk.now_ns
    desk.measures("a", **A)
    assert desk.now_ns - began_ns == pytest.approx(2e9, abs=2e8)
    again_ns = desk.now_ns
    desk.measures("a", **A)
    assert desk.now_ns == pytest.approx(again_ns, abs=1e6), "nothing changed"
    desk.measures("a", scan_speed="2 um/s", **A)
    assert desk.now_ns == pytest.approx(again_ns, abs=1e6), "a speed needs no wait"
    desk.measures("c")
    assert desk.now_ns - again_ns == pytest.approx(2e9, abs=2e8)


def test_stop_and_plain_settings_do_not_wait_for_a_way_back() -> None:
    desk = Desk(limited(tip_bias_voltage=Limit(step=0.01, unit="V")))
    desk.measures("a", **A)
    desk.ask("a", RETURN_REQUEST, Settings())
    for _ in range(4):
        desk.answer_one(desk.in_flight())
    desk.take_control("b")
    desk.ask("b", PARAM, Parameter(SPEED, "2e-6", "m/s"))
    desk.answer_one(desk.in_flight())
    asked = desk.in_flight()
    assert asked is not None
    assert asked.request.subject == Parameter(SPEED, "2e-6", "m/s")
    desk.says("b", ControlRequest.RELEASE_CTRL)
    desk.serve()
    assert desk.panel[BIAS] == 0.1
