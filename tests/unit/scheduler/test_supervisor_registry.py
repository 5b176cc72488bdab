"""Messages that supervisors and components have published by the scheduler, and orders to supervisors."""

from __future__ import annotations

from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, published, replies

from afspm import wire
from afspm.model import (
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    LogLine,
    Note,
    Parameter,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    RelayedMessage,
    Response,
    ResponseDetail,
    ScopeState,
    ScopeStatus,
)
from afspm.model.events import LONGEST_ANNOUNCEMENT, LogLines, MeasurementSettings
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.control.supervisor_registry import SILENT_S
from afspm.scheduler.events import Log, SaveState
from afspm.scheduler.settings import RunFacts, SchedulerSettings

HOST = "supervisor:host"
OK = ControlResponse.SUCCESS


@pytest.fixture
def lab() -> Lab:
    made = Lab()
    made.translator()
    made.entries()
    return made


def states(*names: str, supervisor: str = "host") -> ProcessStates:
    alive = ProcessCondition.ALIVE
    return ProcessStates(1, supervisor, tuple(ProcessState(name, "component", alive, 1) for name in names))


def tell(lab: Lab, thing: Any, name: str = HOST, id_: str = "", user: str | None = None) -> Response:
    told = RelayedMessage(type(thing).__name__, lab.codec.encode(thing))
    return replies(lab.ask(name, RELAY_REQUEST, told, id_, user))[-1].response


def orders(lab: Lab, response: Response) -> tuple[str, ...]:
    assert response.code == OK, response
    return wire.decode_orders(response.payload)


def order(lab: Lab, process: str, who: str = "dashboard:Ada") -> Response:
    return replies(lab.ask(who, RESTART_REQUEST, process))[-1].response


def cached(lab: Lab) -> list[str]:
    return [packet.envelope for packet, *_ in lab.core.cached()]


def test_report_of_a_supervisor_is_published_cached_and_not_forwarded(lab: Lab) -> None:
    sent = len(lab.forwarded)
    assert orders(lab, tell(lab, states("a"))) == ()
    assert orders(lab, tell(lab, states("a", "b"))) == ()
    for n in range(3):
        lines = LogLines((LogLine(n, "a", "INFO", "hello"),))
        tell(lab, lines)
    assert (cached(lab).count("ProcessStates_host"), cached(lab).count("LogLines")) == (1, 3)
    assert lab.codec.decode(published(lab.effects)[-1].payload) == lines
    assert len(lab.forwarded) == sent


def test_two_supervisors_have_an_envelope_each(lab: Lab) -> None:
    tell(lab, states("a"))
    tell(lab, states("b", supervisor="lab"), "supervisor:lab")
    assert {"ProcessStates_host", "ProcessStates_lab"} <= set(cached(lab))


def test_report_of_a_supervisor_is_not_in_the_journal_and_changes_no_lease(lab: Lab) -> None:
    lab.take_control("series")
    lab.entries()
    deadline_ns = lab.core.deadline_ns()
    tell(lab, states("a"), "series")
    assert lab.core.deadline_ns() == deadline_ns
    assert lab.entries() == []


@pytest.mark.parametrize("thing", [ScopeStatus(1), "no message", None])  # type: ignore[arg-type]
def test_other_messages_are_not_relayed(lab: Lab, thing: Any) -> None:
    before = len(published(lab.effects))
    assert tell(lab, thing).code == ControlResponse.FAILURE
    told = RelayedMessage("ProcessStates", lab.codec.encode(thing))
    assert replies(lab.ask(HOST, RELAY_REQUEST, told))[-1].response.code == ControlResponse.FAILURE
    assert len(published(lab.effects)) == before


def test_announcement_too_long_or_without_an_owner_is_refused(lab: Lab) -> None:
    told = RelayedMessage("LogLines", b"0" * (LONGEST_ANNOUNCEMENT + 1))
    assert "at most" in replies(lab.ask(HOST, RELAY_REQUEST, told))[-1].response.reason
    assert "owner" in tell(lab, states("a", supervisor="")).reason


@pytest.mark.parametrize("name", ["", "a\" autofocus onfocus='steal()'", "<b>", "a\0b", "x" * 101])
def test_report_with_an_impossible_process_name_is_refused(lab: Lab, name: str) -> None:
    for thing in (states("a", name), LogLines((LogLine(1, name, "INFO", "hello"),)), states("a", supervisor=name)):
        assert tell(lab, thing).code == ControlResponse.FAILURE
    assert orders(lab, tell(lab, states("tip corrector-2.b"))) == ()


def test_report_needs_the_key_of_the_supervisor(lab: Lab) -> None:
    assert tell(lab, states("a"), user="supervisor").code == OK
    assert tell(lab, states("a"), "series", user="series").code == ControlResponse.FAILURE
    assert tell(lab, states("a"), "supervisor:other", user="series").code == ControlResponse.FAILURE


def test_progress_is_published_only_by_its_owner(lab: Lab) -> None:
    assert tell(lab, Progress(1, "series", 3, 9), "series", user="series").code == OK
    assert "Progress_series" in cached(lab)
    assert tell(lab, Progress(1, "series", 3, 9), "other").code == ControlResponse.FAILURE


def test_a_note_is_published_once_in_the_name_of_its_author(lab: Lab) -> None:
    note = Note(5, "dashboard:Ada", "tip changed here", scan_ns=5, written_ns=9)
    for _ in range(2):  # as where the scheduler is killed before it can answer
        assert tell(lab, note, "dashboard:Ada", user="dashboard").code == OK
    assert cached(lab).count("Note") == 1
    assert lab.codec.decode(published(lab.effects)[-1].payload) == note
    refused = tell(lab, note, "dashboard:Bob", user="dashboard")
    assert (refused.code, refused.reason) == (ControlResponse.FAILURE, "dashboard:Bob is not 'dashboard:Ada'")


def test_note_after_the_end_is_refused_so_that_its_author_records_it(lab: Lab) -> None:
    lab.ask("series", ControlRequest.END_EXPERIMENT)
    answer = tell(lab, Note(5, "series", "too late"), "series")
    assert (answer.code, answer.detail) == (ControlResponse.FAILURE, ResponseDetail.EXPERIMENT_ENDED)
    assert "Note" not in cached(lab)


def test_an_order_comes_with_the_next_answer_once(lab: Lab) -> None:
    tell(lab, states("a", "b"))
    assert order(lab, "b").code == OK
    assert order(lab, "b").code == OK
    assert orders(lab, tell(lab, states("a", "b"), id_="supervisor:host/x/1")) == ("b",)
    assert orders(lab, tell(lab, states("a", "b"), id_="supervisor:host/x/1")) == ("b",)  # its answer was lost
    assert orders(lab, tell(lab, states("a", "b"), id_="supervisor:host/x/2")) == ()
    first = lab.entries()[0]
    assert (first.kind, first.who, first.what, first.response) == ("order", "dashboard:Ada", "restart b", 0)


def test_order_goes_to_the_supervisor_of_the_process(lab: Lab) -> None:
    tell(lab, states("a"))
    tell(lab, states("b", supervisor="lab"), "supervisor:lab")
    order(lab, "b")
    assert orders(lab, tell(lab, states("a"))) == ()
    assert orders(lab, tell(lab, states("b", supervisor="lab"), "supervisor:lab")) == ("b",)


def test_order_for_an_unknown_process_is_refused_with_the_known_names(lab: Lab) -> None:
    tell(lab, states("a"))
    refused = order(lab, "c")
    assert (refused.code, refused.reason) == (
        ControlResponse.FAILURE,
        "there is no process 'c'; known: a",
    )
    assert lab.entries()[0].refused


def test_silent_supervisor_gets_no_orders(lab: Lab) -> None:
    tell(lab, states("a"))
    lab.later(SILENT_S + 1.0)
    assert "has sent no report for 11 s" in order(lab, "a").reason


def test_order_needs_the_role_restart() -> None:
    lab = Lab(SchedulerSettings(rules=Rules(RoleTable(restart=("dashboard",)))))
    tell(lab, states("a"))
    assert order(lab, "a", "stranger:Ada").reason == "stranger:Ada does not have the role restart ([control.roles])"
    assert order(lab, "a", "dashboard:Ada").code == OK


def test_orders_outlive_a_kill_of_the_scheduler(lab: Lab) -> None:
    tell(lab, states("a"))
    order(lab, "a")
    state = [effect for effect in lab.effects if isinstance(effect, SaveState)][-1].state
    again = Lab(state=state)
    again.connect(HOST)
    assert orders(again, tell(again, states("a"))) == ("a",)


def test_report_published_before_a_kill_but_not_answered_is_published_once(lab: Lab) -> None:
    lines = LogLines((LogLine(1, "a", "INFO", "hello"),))
    tell(lab, lines, id_="supervisor:host/x/1")
    state = [effect for effect in lab.effects if isinstance(effect, SaveState)][-1].state
    again = Lab(state=state, codec=lab.codec)
    again.core.restore_cache(list(lab.core.cached()))
    assert tell(again, lines, id_="supervisor:host/x/1").code == OK
    assert cached(again).count("LogLines") == 1
    assert tell(again, LogLines((LogLine(2, "a", "INFO", "hello"),))).code == OK
    assert cached(again).count("LogLines") == 2


def test_reports_after_the_end_are_accepted_and_orders_refused(lab: Lab) -> None:
    tell(lab, states("a"))
    lab.ask("boss", ControlRequest.END_EXPERIMENT)
    assert order(lab, "a").code == ControlResponse.FAILURE
    assert tell(lab, states("a")).code == OK


def test_person_has_the_roles_of_the_component_acting_for_them() -> None:
    roles = RoleTable(end_experiment=("dashboard:Ada",), set_mode=("dashboard",), operate=("dashboard",))
    lab = Lab(SchedulerSettings(rules=Rules(roles)))
    lab.translator()
    assert lab.mode("dashboard:Eve", ControlMode.MANUAL) is OK
    lab.ask("dashboard:Eve", ControlRequest.ACTION, "start-scan")
    assert lab.forwarded[-1].request.subject == "start-scan"
    assert lab.says("dashboard:Eve", ControlRequest.END_EXPERIMENT) is ControlResponse.FAILURE
    assert lab.says("dashboard:Ada", ControlRequest.END_EXPERIMENT) is OK


def test_key_of_a_component_is_valid_for_its_persons_and_no_other_component(lab: Lab) -> None:
    asked = replies(lab.ask("dashboard:Ada", ControlRequest.REQUEST_CTRL, 0, user="dashboard"))[-1]
    assert asked.response.code == OK
    other = replies(lab.ask("series:Ada", ControlRequest.REQUEST_CTRL, 0, user="dashboard"))[-1]
    assert other.response.reason == "this is the key of dashboard, not of series:Ada"


def test_settings_of_a_measurement_are_published_only_for_the_component_that_set_them(lab: Lab) -> None:
    settings = MeasurementSettings(1, "sweep", (Parameter("zctrl-igain", "5"),), "sweep-1")
    assert tell(lab, settings, "sweep", user="sweep").code == OK
    assert tell(lab, settings, "other").code == ControlResponse.FAILURE


def reports(lab: Lab, *leads_s: float) -> list[str]:
    """Report every two seconds with these leads of the supervisor's clock; return the warnings."""
    began = len(lab.effects)
    for lead_s in leads_s:
        lab.later(2.0, 2.0)
        alive = ProcessState("microscope", "translator", ProcessCondition.ALIVE, 1)
        tell(lab, ProcessStates(lab.now_ns + round(lead_s * 1e9), "host", (alive,)))
    return [one.text for one in lab.effects[began:] if isinstance(one, Log) and one.level == "WARNING"]


@pytest.mark.parametrize(("lead_s", "way"), [(1200.0, "20 min ahead of"), (-1200.0, "20 min behind")])
def test_clock_of_another_computer_that_differs_is_logged_once(lab: Lab, lead_s: float, way: str) -> None:
    (warning,) = reports(lab, lead_s, lead_s, lead_s + 0.1)
    assert warning.startswith(f"the clock of host is {way} the scheduler's clock")
    assert not reports(lab, lead_s, lead_s)


def test_late_report_and_its_repetition_are_no_difference_of_clocks(lab: Lab) -> None:
    assert not reports(lab, 0.0, -7200.0, 0.0, 0.0)
    late = ProcessStates(lab.now_ns - 7200 * 10**9, "host", ())
    tell(lab, late)
    tell(lab, late)
    assert not [one for one in lab.effects if isinstance(one, Log) and "clock" in one.text]


def test_delay_of_a_report_in_fast_time_is_no_difference_of_clocks() -> None:
    made = Lab(SchedulerSettings(run=RunFacts(clock={"speed": 480.0})))
    made.translator()
    assert not reports(made, -100.0, -100.0)


def test_declared_message_of_a_component_is_published_under_its_name_each_time(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = lab.codec.encode(ScopeStatus(ScopeState.FREE))
    relayed = RelayedMessage("ScopeStateMsg", message)
    assert replies(lab.ask("level", RELAY_REQUEST, relayed))[-1].response.code == ControlResponse.FAILURE
    monkeypatch.setattr(wire, "is_relayed", lambda name: name == "ScopeStateMsg")
    before = len(published(lab.effects))
    for _ in range(2):
        assert replies(lab.ask("level", RELAY_REQUEST, relayed))[-1].response.code == OK
    assert [one.envelope for one in published(lab.effects)[before:]] == ["ScopeStateMsg_level"] * 2
