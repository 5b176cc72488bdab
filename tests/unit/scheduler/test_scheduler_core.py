"""The scheduler's decisions together: inputs, effects and their order."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pytest
from tests.unit.scheduler.logic_lab import NS, Lab, killed, published, replies

from afspm.model import (
    CLOCK_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    Feedback,
    Packet,
    PacketHeader,
    Parameter,
    Request,
    ResponseDetail,
    ScopeState,
    names,
)
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import (
    Disconnected,
    Effect,
    Forward,
    Greeted,
    Kill,
    Log,
    PacketIn,
    Publish,
    Replay,
    ReplayRequested,
    Reply,
    SaveState,
    Tick,
    TranslatorCaughtUp,
    TranslatorDown,
    TranslatorUp,
)
from afspm.scheduler.publishing.envelopes import Envelopes
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.safety.watchdog import WatchdogSettings
from afspm.scheduler.settings import ControlSettings, RunFacts, SchedulerSettings

TIP = 1
ACTION, PARAM, SUPPORT = ControlRequest.ACTION, ControlRequest.PARAM, ControlRequest.ACTION_SUPPORT
OK, NOT_IN_CONTROL, NO_RESPONSE = ControlResponse.SUCCESS, ControlResponse.NOT_IN_CONTROL, ControlResponse.NO_RESPONSE


def kinds(effects: Sequence[object]) -> list[str]:
    return [type(effect).__name__ for effect in effects if not isinstance(effect, Log)]


def test_a_change_is_saved_published_and_then_answered(lab: Lab) -> None:
    effects = lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0)
    assert kinds(effects) == ["SaveState", "Publish", "Reply"]
    assert lab.codec.decode(published(effects)[0].payload) == ControlState(ControlMode.AUTOMATED, "experiment", ())


def test_request_without_a_change_is_only_answered(lab: Lab) -> None:
    lab.flag("classifier", TIP)
    assert kinds(lab.ask("other", ControlRequest.ADD_EXP_PRBLM, TIP)) == ["Reply"]
    assert kinds(lab.ask("other", ControlRequest.RELEASE_CTRL)) == ["Reply"]


def test_the_holder_s_command_goes_to_the_translator_and_its_answer_back(lab: Lab) -> None:
    lab.take_control("experiment")
    effects = lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    assert kinds(effects) == ["SaveState", "Forward"]  # a kill must not lose the pulse
    answer = replies(lab.answer(lab.forwarded[-1], payload=b"7"))[0]
    assert (answer.name, answer.response.code, answer.response.payload) == ("experiment", OK, b"7")


def test_others_commands_are_refused_and_their_questions_answered(lab: Lab) -> None:
    lab.take_control("experiment")
    assert lab.says("other", ACTION, "start-scan") is NOT_IN_CONTROL
    assert lab.says("other", PARAM, Parameter("tip-bias-voltage", "1", "V")) is NOT_IN_CONTROL
    assert kinds(lab.ask("other", PARAM, Parameter("tip-bias-voltage"))) == ["Forward"]
    lab.answer(lab.forwarded[-1])
    assert kinds(lab.ask("other", SUPPORT, "x-pulse")) == ["Forward"]


def test_requests_of_extensions_are_for_the_holder(lab: Lab) -> None:
    assert lab.says("experiment", 150) is NOT_IN_CONTROL
    lab.take_control("experiment")
    assert kinds(lab.ask("experiment", 150)) == ["Forward"]


def test_unknown_request_is_not_supported(lab: Lab) -> None:
    assert lab.says("experiment", ControlRequest.UNDEFINED) is ControlResponse.CMD_NOT_SUPPORTED


def test_a_flag_stops_the_scan_before_anything_else_is_sent(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.scope_is(ScopeState.SCANNING)
    effects = lab.ask("classifier", ControlRequest.ADD_EXP_PRBLM, TIP)
    assert [f.request.subject for f in effects if isinstance(f, Forward)] == ["stop-scan"]
    lab.take_control("corrector", TIP)
    lab.ask("corrector", ACTION, "x-pulse")
    assert lab.forwarded[-1].request.subject == "stop-scan"
    lab.answer(lab.forwarded[-1])
    assert lab.forwarded[-1].request.subject == "x-pulse"


def test_start_of_unknown_outcome_is_stopped(lab: Lab) -> None:
    """The translator was killed while it began the scan; the instrument scans on."""
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "start-scan", "experiment/a/1")
    lab.step(TranslatorDown())
    lab.flag("classifier", TIP)
    lab.step(TranslatorUp())
    lab.answer(lab.forwarded[-1])
    assert lab.forwarded[-1].request.subject == "stop-scan"


def test_manual_stops_a_scan_without_a_holder(lab: Lab) -> None:
    lab.scope_is(ScopeState.SCANNING)
    lab.mode("person", ControlMode.MANUAL)
    assert lab.forwarded[-1].request.subject == "stop-scan"


def test_the_experiment_file_may_let_the_scan_run_on() -> None:
    lab = Lab(SchedulerSettings(watchdog=WatchdogSettings(stop_when=frozenset())))
    lab.translator()
    lab.take_control("experiment")
    lab.scope_is(ScopeState.SCANNING)
    lab.mode("person", ControlMode.MANUAL)
    assert lab.forwarded == []


def test_waiting_commands_of_a_former_holder_are_not_sent(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", PARAM, Parameter("scan-speed", "1"), "experiment/a/1")
    lab.ask("experiment", ACTION, "start-scan", "experiment/a/2")
    effects = lab.ask("classifier", ControlRequest.ADD_EXP_PRBLM, TIP)
    refused = [r for r in replies(effects) if r.name == "experiment"]
    assert [(r.response.id, r.response.code) for r in refused] == [("experiment/a/2", NOT_IN_CONTROL)]
    lab.answer(lab.forwarded[-1])
    assert all(f.request.subject != "start-scan" for f in lab.forwarded)


def test_a_holder_that_is_gone_is_given_up_after_its_grace(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.step(Disconnected(lab.connections["experiment"]))
    dead_s = lab.now_s + SchedulerSettings().control.grace_s
    lab.entries()
    assert lab.core.deadline_s() == dead_s
    lab.now_s = dead_s - 0.1
    lab.step(Tick())
    assert lab.holder == "experiment"
    lab.later(0.1)
    effects = lab.step(Tick())
    assert lab.holder is None
    assert "Publish" in kinds(effects)


def test_a_holder_that_comes_back_in_time_keeps_control(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.step(Disconnected(lab.connections["experiment"]))
    lab.later(5.0)
    connection = lab.connect("experiment")
    lab.step(Greeted(connection, "experiment"))
    lab.later(100.0)
    lab.step(Tick())
    assert lab.holder == "experiment"
    assert lab.core.deadline_s() is None


def test_silent_connection_does_not_keep_control(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.step(Disconnected(lab.connections["experiment"]))
    lab.connect("experiment")
    lab.later(10.0)
    lab.step(Tick())
    assert lab.holder is None


def test_holder_given_up_by_its_supervisor_loses_control_at_once(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.give_up("other")
    assert lab.holder == "experiment"
    lab.give_up("experiment")
    assert lab.holder is None


@pytest.mark.parametrize(
    ("life", "feedback_on", "last"), [("b", False, "x-retract"), ("b", True, None), ("a", False, None)]
)
def test_a_restarted_holder_that_gives_control_back_leaves_no_danger_behind(
    lab: Lab, life: str, feedback_on: bool, last: str | None
) -> None:
    lab.translator()
    lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0, "experiment/a/1")
    lab.publish("ZCtrlParameters", Feedback(on=False))
    lab.step(Disconnected(lab.connections.pop("experiment")))
    lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0, f"experiment/{life}/2")
    lab.publish("ZCtrlParameters", Feedback(on=feedback_on))
    again = killed(lab, SchedulerSettings())
    released = again.ask("experiment", ControlRequest.RELEASE_CTRL, None, f"experiment/{life}/3")
    assert replies(released)[0].response.ok
    assert (again.forwarded[-1].request.subject if again.forwarded else None) == last


def test_tip_of_a_dead_holder_is_retracted_before_other_commands(lab: Lab) -> None:
    lab.publish("ZCtrlParameters", Feedback(on=False))
    lab.take_control("experiment")
    lab.give_up("experiment")
    assert lab.forwarded[-1].request.subject == "x-retract"
    lab.take_control("other")
    assert lab.says("other", ACTION, "start-scan") is ControlResponse.NOT_FREE
    lab.answer(lab.forwarded[-1])
    assert lab.says("other", ACTION, "start-scan") is ControlResponse.NOT_FREE  # the tip is not at the surface


def test_idle_holder_loses_control_with_its_lease() -> None:
    lab = Lab(SchedulerSettings(control=ControlSettings(lease_s=60.0)))
    lab.translator()
    lab.scope_is(ScopeState.FREE)
    lab.take_control("greedy")
    deadline_ns = lab.core.deadline_ns()
    assert deadline_ns == lab.now_ns + 60 * NS
    lab.later(experiment_s=60.0)
    lab.step(Tick())
    assert lab.holder is None


def test_second_client_of_a_name_is_refused_with_a_reason(lab: Lab) -> None:
    lab.take_control("experiment")
    second = lab.newest + 1
    lab.connect("second")
    lab.connections["experiment"] = second
    answer = replies(lab.ask("experiment", ACTION, "x-crash", "experiment/other/1"))[0]
    assert (answer.connection, answer.response.code) == (second, ControlResponse.FAILURE)
    assert "experiment" in answer.response.reason
    assert lab.forwarded == []


def test_reconnecting_peer_without_ids_is_answered_once_its_old_connection_closes(lab: Lab) -> None:
    lab.take_control("plain")
    old = lab.connections.pop("plain")
    assert lab.ask("plain", ControlRequest.REQUEST_CTRL, 0) == []
    effects = lab.step(Disconnected(old))
    assert [(reply.connection, reply.response.code) for reply in replies(effects)] == [(lab.newest, OK)]
    lab.entries()
    assert lab.core.deadline_s() is None


def test_two_open_connections_without_ids_are_two_peers(lab: Lab) -> None:
    lab.take_control("plain")
    lab.connections.pop("plain")
    assert lab.ask("plain", ControlRequest.REQUEST_CTRL, 0) == []
    lab.entries()
    deadline_s = lab.core.deadline_s()
    assert deadline_s is not None
    lab.later(real_s=deadline_s - lab.now_s)
    assert replies(lab.step(Tick()))[0].response.code == ControlResponse.FAILURE


def test_client_with_the_key_of_another_is_refused(lab: Lab) -> None:
    answer = replies(lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0, user="mallory"))[0]
    assert answer.response.code == ControlResponse.FAILURE
    assert lab.holder is None
    assert replies(lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0, user="experiment"))[0].response.code == OK


def test_nameless_client_is_asked_for_its_name(lab: Lab) -> None:
    assert "without a name" in replies(lab.ask("", ControlRequest.REQUEST_CTRL, 0))[0].response.reason


def test_a_repeated_request_is_answered_and_not_done_again(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    assert lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1") == []
    lab.answer(lab.forwarded[-1])
    again = replies(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1"))
    assert [r.response.code for r in again] == [OK]
    assert len(lab.forwarded) == 1


def test_answer_goes_to_the_newest_connection_of_the_client(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.step(Disconnected(lab.connections["experiment"]))
    new = lab.connect("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    assert [r.connection for r in replies(lab.answer(lab.forwarded[-1]))] == [new]


def test_without_an_id_an_answer_is_not_given_to_a_new_life(lab: Lab) -> None:
    lab.take_control("old")
    lab.ask("old", ACTION, "x-pulse")
    lab.step(Disconnected(lab.connections["old"]))
    lab.connect("old")
    lab.ask("old", ControlRequest.REQUEST_CTRL, 0)
    assert replies(lab.answer(lab.forwarded[-1])) == []


def test_silence_of_the_translator_is_logged_and_its_late_answer_kept_for_a_retry(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.later(5.0)
    silent = replies(lab.step(Tick()))[0].response
    assert (silent.code, silent.detail) == (NO_RESPONSE, ResponseDetail.OUTCOME_UNKNOWN)
    assert replies(lab.answer(lab.forwarded[-1])) == []
    assert lab.says("experiment", ACTION, "x-pulse", "experiment/a/1") is OK
    assert len(lab.forwarded) == 1


def test_slow_translator_does_not_delay_other_clients(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "start-scan", "experiment/a/1")
    assert lab.flag("classifier", TIP) is OK
    assert published(lab.scope_is(ScopeState.SCANNING))


def test_retry_of_unknown_outcome_is_forwarded_to_the_translator(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.step(TranslatorDown())
    lab.translator()
    assert kinds(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")) == ["Forward"]


def test_unsent_request_may_be_repeated(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.step(TranslatorDown())
    answer = replies(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1"))[0].response
    assert (answer.code, answer.detail) == (NO_RESPONSE, ResponseDetail.NOT_SENT)
    lab.translator()
    assert kinds(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")) == ["SaveState", "Forward"]


def test_request_that_the_translator_could_not_begin_is_sent_again(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    answer = replies(lab.answer(lab.forwarded[-1], NO_RESPONSE, detail=ResponseDetail.NOT_SENT))[0].response
    assert (answer.code, answer.detail) == (NO_RESPONSE, ResponseDetail.NOT_SENT)
    assert kinds(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")) == ["Forward"]


def test_retry_of_a_request_without_an_answer_is_left_to_the_translator(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1], NO_RESPONSE, reason="the controller can't be reached")
    assert kinds(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")) == ["Forward"]
    lab.answer(lab.forwarded[-1])
    assert lab.says("experiment", ACTION, "x-pulse", "experiment/a/1") is OK


def test_a_limit_refuses_and_is_logged() -> None:
    limits = ExperimentLimits({"tip-bias-voltage": Limit(high=5.0, source="experiment.toml:7")})
    lab = Lab(SchedulerSettings(limits=limits))
    lab.translator()
    lab.take_control("experiment")
    effects = lab.ask("experiment", PARAM, Parameter("tip-bias-voltage", "6", "V"))
    assert replies(effects)[0].response.code == ControlResponse.PARAM_ERROR
    assert any(isinstance(e, Log) and "experiment.toml:7" in e.text for e in effects)
    assert lab.forwarded == []


def test_packets_pass_renamed_and_late_joiners_get_them_in_order(lab: Lab) -> None:
    header = PacketHeader("Scan2d", "Height", (2e-6, 2e-6))
    scan = lab.step(PacketIn(Packet("Scan2d", b"values", lab.now_ns + NS), header))
    assert published(scan)[0].envelope == "Scan2d_2000.0_Height"
    assert published(scan)[0].payload == b"values"
    lab.scope_is(ScopeState.FREE)
    replay = lab.step(ReplayRequested("late", ("",), -1))[0]
    assert isinstance(replay, Replay)
    assert [p.envelope for p in replay.packets] == ["ControlState", "Scan2d_2000.0_Height", "ScopeStateMsg"]
    newest_ns = replay.packets[-1].time_ns or 0
    assert lab.step(ReplayRequested("late", ("Scan2d", "Scope"), newest_ns)) == [Replay("late", ())]


def test_failing_mapping_is_logged_once_and_costs_only_its_own_packets() -> None:
    lab = Lab(SchedulerSettings(envelopes=Envelopes(mapping=lambda header: str(1 / len(header.channel or "")))))
    lab.translator()
    effects = [e for _ in range(3) for e in lab.scope_is(ScopeState.FREE)]
    assert kinds(effects) == []
    assert len(effects) == 1


def test_control_state_of_a_translator_is_dropped(lab: Lab) -> None:
    assert published(lab.publish("ControlState", ControlState(ControlMode.AUTOMATED, "mallory"))) == []


def test_control_is_published_after_missed_packets() -> None:
    lab = Lab()
    assert published(lab.effects) == []
    lab.scope_is(ScopeState.FREE)
    assert [p.envelope for p in published(lab.step(TranslatorCaughtUp()))] == ["ControlState"]


def test_control_is_published_soon_without_a_translator() -> None:
    lab = Lab()
    lab.later(1.0)
    assert [p.envelope for p in published(lab.step(Tick()))] == ["ControlState", "JournalEntries"]


def restarted(lab: Lab) -> Lab:
    """Return a new core with the saved state of the former."""
    saved = [e for e in lab.effects if isinstance(e, SaveState)][-1]
    return Lab(state=saved.state, codec=lab.codec)


def test_restarted_scheduler_keeps_mode_problems_and_holder(lab: Lab) -> None:
    lab.flag("classifier", TIP)
    lab.take_control("corrector", TIP)
    after = restarted(lab)
    assert after.core.control == lab.core.control
    after.step(TranslatorCaughtUp())
    assert after.take_control("experiment") is ControlResponse.WRONG_EXP_PROBLEM
    assert after.clear("corrector", TIP) is OK
    assert after.holder is None


@pytest.mark.parametrize("translator", ["comes", "stays away"])
def test_control_changes_after_a_restart_only_once_missed_packets_have_come(lab: Lab, translator: str) -> None:
    lab.take_control("experiment")
    saved = lab.core.snapshot()
    scan_ns = lab.now_ns + 5000  # published, and not written down any more when the scheduler was killed
    (first,) = published(lab.publish("Scan2d", "a scan", scan_ns))
    after = Lab(state=saved)
    after.later(experiment_s=60.0)
    assert replies(after.ask("experiment", ControlRequest.RELEASE_CTRL)) == []
    assert after.holder == "experiment"
    if translator == "comes":
        (again,) = published(after.publish("Scan2d", "a scan", scan_ns))
        assert again.time_ns == first.time_ns
        after.step(TranslatorCaughtUp())
    else:
        after.later(1.0)
        after.step(Tick())
    assert after.core.deadline_s() == after.now_s
    assert [reply.response.code for reply in replies(after.step(Tick()))] == [OK]
    assert after.holder is None


def test_holder_silent_after_a_restart_is_given_up() -> None:
    lab = Lab()
    lab.take_control("experiment")
    after = restarted(lab)
    after.later(29.0)
    after.step(Tick())
    assert after.holder == "experiment"
    after.later(1.0)
    after.step(Tick())
    assert after.holder is None


def test_stop_due_at_a_kill_is_sent_after_the_restart(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.scope_is(ScopeState.SCANNING)
    lab.flag("classifier", TIP)
    after = restarted(lab)
    after.step(TranslatorUp())
    after.answer(after.forwarded[-1])
    assert after.forwarded[-1].request.subject == "stop-scan"


def test_end_is_saved_answered_and_then_published(lab: Lab) -> None:
    effects = lab.ask("boss", ControlRequest.END_EXPERIMENT)
    assert kinds(effects) == ["SaveState", "Reply", "Publish", "Kill"]
    assert lab.says("experiment", ControlRequest.REQUEST_CTRL, 0) is ControlResponse.FAILURE
    assert any(isinstance(e, Kill) for e in restarted(lab).effects)


def test_only_the_role_ends_the_experiment() -> None:
    lab = Lab(SchedulerSettings(rules=Rules(RoleTable(end_experiment=("boss",)))))
    assert lab.says("other", ControlRequest.END_EXPERIMENT) is ControlResponse.FAILURE
    assert not any(isinstance(e, Kill) for e in lab.effects)


def test_an_operator_commands_in_manual() -> None:
    lab = Lab(SchedulerSettings(rules=Rules(RoleTable(operate=("console",)))))
    lab.translator()
    assert lab.says("console", ACTION, "start-scan") is NOT_IN_CONTROL
    lab.mode("console", ControlMode.MANUAL)
    assert kinds(lab.ask("console", ACTION, "start-scan")) == ["SaveState", "Forward"]


# a component, an agent or a program at the gateway can't say why the feedback is off: results point 1
@pytest.mark.parametrize("who", ["terminal:ada", "series", "agent", "gateway:me"])
def test_only_a_person_says_that_the_feedback_is_off_by_intention(who: str) -> None:
    roles = RoleTable(operate=("dashboard",), approve=("dashboard", "terminal", "agent"))
    lab = Lab(SchedulerSettings(rules=Rules(roles, agents=frozenset({"agent"}))))
    lab.translator()
    refusals = {NOT_IN_CONTROL, ControlResponse.FAILURE}  # an agent has no grant for it
    assert lab.says(who, ACTION, names.FEEDBACK_MAY_BE_OFF) in refusals
    lab.take_control("series")
    assert lab.says(who, ACTION, names.FEEDBACK_MAY_BE_OFF) in refusals
    lab.mode("terminal:ada", ControlMode.MANUAL)
    effects = lab.ask(who, ACTION, names.FEEDBACK_MAY_BE_OFF)
    assert any(isinstance(effect, Forward) for effect in effects) is (who == "terminal:ada")


def test_only_adjustable_parameters_are_set_beside_the_holder() -> None:
    lab = Lab(SchedulerSettings(rules=Rules(RoleTable(operate=("console",)), adjustable=frozenset({"zctrl-setpoint"}))))
    lab.translator()
    lab.take_control("experiment")
    setpoint, bias = Parameter("zctrl-setpoint", "0.5"), Parameter("tip-bias-voltage", "1", "V")
    assert kinds(lab.ask("console", ControlRequest.PARAM, setpoint)) == ["Forward"]
    assert lab.says("console", ControlRequest.PARAM, bias) is NOT_IN_CONTROL
    assert lab.says("other", ControlRequest.PARAM, setpoint) is NOT_IN_CONTROL
    assert lab.says("console", ACTION, "start-scan") is NOT_IN_CONTROL


def test_settings_left_by_hand_are_logged_when_the_mode_is_automated() -> None:
    lab = Lab(SchedulerSettings(rules=Rules(RoleTable(operate=("console",)))))
    lab.translator()
    lab.publish("ZCtrlParameters", Feedback(on=True, setpoint=1e-9))
    lab.mode("console", ControlMode.MANUAL)
    for value in ("0.2", "0.5"):
        lab.ask("console", PARAM, Parameter("tip-bias-voltage", value, "V"))
        lab.answer(lab.forwarded[-1])
    lab.publish("ZCtrlParameters", Feedback(on=True, setpoint=2e-9))  # changed at the controller's panel

    def said() -> list[str]:
        lab.mode("console", ControlMode.AUTOMATED)
        return [one.text for one in lab.effects if isinstance(one, Log) and "by hand" in one.text]

    assert said() == ["set by hand, and still in force: tip-bias-voltage = 500 mV, setpoint = 2e-09"]
    lab.mode("console", ControlMode.MANUAL)
    assert len(said()) == 1  # told once, and nothing was set this time


def test_feedback_restored_by_hand_is_not_logged() -> None:
    lab = Lab()
    lab.translator()
    for mode, setpoint in [(ControlMode.AUTOMATED, 1.0), (ControlMode.MANUAL, 2.0), (ControlMode.MANUAL, 1.0)]:
        lab.mode("person", mode)
        lab.publish("ZCtrlParameters", Feedback(setpoint=setpoint))
    lab.mode("person", ControlMode.AUTOMATED)
    assert not [one for one in lab.effects if isinstance(one, Log) and "by hand" in one.text]


def test_failed_stop_is_logged_as_an_error(lab: Lab) -> None:
    lab.take_control("experiment")
    lab.scope_is(ScopeState.SCANNING)
    lab.flag("classifier", TIP)
    effects = lab.answer(lab.forwarded[-1], ControlResponse.ACTION_ERROR)
    assert any(isinstance(e, Log) and e.level == "ERROR" and "stop-scan" in e.text for e in effects)


def test_same_events_same_effects() -> None:
    def story() -> list[Effect]:
        lab = Lab()
        lab.translator()
        lab.take_control("a")
        lab.flag("b", TIP)
        lab.scope_is(ScopeState.FREE)
        lab.later(20.0)
        lab.step(Tick())
        return lab.effects

    assert story() == story()


@pytest.mark.parametrize("garbage", [Request(99999), Request(-5), Request(6, None), Request(8, 0), Request(1, None)])
def test_odd_requests_are_answered(lab: Lab, garbage: Request) -> None:
    from afspm.scheduler.events import RequestIn

    lab.connect("odd")
    assert [type(e) for e in lab.step(RequestIn(1, "odd", garbage)) if isinstance(e, Reply | Publish)]


def test_clock_request_returns_time_and_speed_of_the_experiment() -> None:
    lab = Lab(SchedulerSettings(run=RunFacts({"origin_s": 5.0, "start_s": 7.0, "speed": 600.0})))
    answer = replies(lab.ask("elsewhere", CLOCK_REQUEST, id_="elsewhere/a/1"))[0].response
    assert (answer.code, answer.id) == (OK, "elsewhere/a/1")
    clock = {"origin_s": 5.0, "start_s": 7.0, "speed": 600.0, "now_ns": lab.now_ns}
    assert json.loads(answer.payload) == {**clock, "run": "", "simulated": False, "versions": {}, "in_use": ""}


def test_clock_request_returns_why_the_microscope_is_in_use() -> None:
    lab = Lab()

    def in_use() -> str:
        found: str = json.loads(replies(lab.ask("elsewhere", CLOCK_REQUEST))[0].response.payload)["in_use"]
        return found

    lab.ask("series", ControlRequest.REQUEST_CTRL, 0)
    assert in_use() == "series is in control"
    lab.mode("person", ControlMode.MANUAL)
    assert in_use() == "the mode is MANUAL"
