"""The component's loop: handlers, their order, and the end."""

from __future__ import annotations

import json
import logging
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from client_lab import EPOCH_S, OTHER_REGION, REGION, Lab, Nothing, context_of, run
from declared_messages import forget_afterwards
from google.protobuf.wrappers_pb2 import UInt64Value

from afspm import model, wire
from afspm.basics.errors import ConfigError, ExperimentEnded, NoResponse, Refused
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch
from afspm.basics.own_fault import OwnFault
from afspm.client.component import Component
from afspm.client.dispatch import MessageDispatcher
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    Problem,
    Request,
    Response,
    ResponseDetail,
    Scan,
    ScopeState,
    ScopeStatus,
)
from afspm.transport.process.failure import take_fault
from afspm.wire.generated.analysis_pb2 import SpatialPointWithScoreList
from afspm.wire.generated.feedback_pb2 import FeedbackAnalysis

TIP, TIP_NAME = Problem.TIP_SHAPE_CHANGED, "tip-shape-changed"


class Sharpness(Component):
    """The ten lines of the documentation."""

    def __init__(self, threshold: float = 0.5) -> None:
        self.threshold = threshold
        self.seen: list[str] = []

    def on_scan(self, scan: Scan) -> None:
        self.seen.append(scan.channel)
        if scan.values.std() < self.threshold:
            self.scope.flag("tip-shape-changed")


class Diary(Component):
    """A component that writes every call down."""

    def __init__(self) -> None:
        self.lines: list[Any] = []

    def on_start(self) -> None:
        self.lines.append("start")

    def on_state(self, status: ScopeStatus) -> None:
        self.lines.append(status.state)

    def on_problem(self, problem: str, flagged: bool) -> None:
        self.lines.append((problem, flagged))

    def on_end(self) -> None:
        self.lines.append("end")


def test_component_of_ten_lines_takes_part_in_an_experiment() -> None:
    lab = Lab("sharpness")
    lab.at(10.0, lambda: lab.publish_scan(REGION))
    lab.at(20.0, lab.kill)
    component = Sharpness()
    assert run(component, lab) == ExitCode.ENDED
    assert component.seen == ["Height", "Phase"]
    assert TIP in lab.control.problems


def test_handlers_are_called_in_the_order_of_events() -> None:
    lab = Lab()
    lab.at(1.0, lambda: lab.publish(ScopeStatus(ScopeState.SCANNING)))
    lab.at(2.0, lambda: lab.flag(TIP))
    lab.at(3.0, lambda: lab.publish(ScopeStatus(ScopeState.FREE)))
    lab.at(4.0, lambda: lab.clear(TIP))
    lab.at(5.0, lab.kill)
    diary = Diary()
    run(diary, lab)
    assert diary.lines == [
        "start", ScopeState.FREE, ScopeState.SCANNING, (TIP_NAME, True), ScopeState.FREE, (TIP_NAME, False), "end",
    ]  # fmt: skip


def test_problem_flagged_before_the_start_is_handled_at_the_start() -> None:
    lab = Lab()
    lab.flag(TIP)
    lab.at(1.0, lab.kill)
    diary = Diary()
    run(diary, lab)
    assert (TIP_NAME, True) in diary.lines


def test_a_problem_of_the_experiment_file_comes_by_its_name() -> None:
    lab = Lab()
    lab.at(1.0, lambda: lab.publish(model.ControlState(problems=(42,))))
    lab.at(2.0, lab.kill)
    diary = Diary()
    run(diary, lab, problems={"water-film": 42})
    assert ("water-film", True) in diary.lines


def test_packets_during_a_handler_are_handled_afterwards_in_order() -> None:
    class Busy(Component):
        def __init__(self) -> None:
            self.seen: list[Any] = []

        def on_problem(self, problem: str, flagged: bool) -> None:
            if flagged:
                self.seen.append("repairing")
                with self.scope.control(solving=problem):
                    self.scope.move_probe((1e-6, 0.0))
                    self.scope.clear(problem)
                self.seen.append("repaired")

        def on_scan(self, scan: Scan) -> None:
            self.seen.append(scan.region.center_m[0])

    lab = Lab("corrector")
    lab.at(1.0, lambda: lab.flag(TIP))
    lab.at(1.5, lambda: lab.publish_scan(REGION))
    lab.at(1.6, lambda: lab.publish_scan(OTHER_REGION))
    lab.at(60.0, lab.kill)
    busy = Busy()
    run(busy, lab)
    assert busy.seen == ["repairing", "repaired", 0.0, 0.0, 5e-6, 5e-6]
    assert not lab.control.problems


def test_other_messages_come_by_their_name_or_to_on_message() -> None:
    class Others(Component):
        def __init__(self) -> None:
            self.named: list[Any] = []
            self.rest: list[str] = []

        def on_feedback_analysis(self, message: Any) -> None:
            assert self.packet is not None
            self.named.append((self.packet.envelope, message.proportionOverThreshold))

        def on_message(self, envelope: str, message: Any) -> None:
            self.rest.append(envelope)

        def on_control(self, control_state: model.ControlState) -> None:
            pass

    lab = Lab()
    lab.at(1.0, lambda: lab.publish(FeedbackAnalysis(proportionOverThreshold=0.25), "FeedbackAnalysis_fine"))
    lab.at(2.0, lambda: lab.publish(SpatialPointWithScoreList(channel="Height")))
    lab.at(3.0, lab.kill)
    others = Others()
    run(others, lab)
    assert others.named == [("FeedbackAnalysis_fine", 0.25)]
    assert others.rest == [
        "ChannelRoles",
        "ZCtrlUnits",
        "ScopeStateMsg",
        "ScanParameters2d",
        "ProbePosition",
        "SpatialPointWithScoreList",
    ]


def test_only_the_envelopes_subscribed_to_are_handled() -> None:
    lab = Lab()
    lab.at(1.0, lambda: lab.publish(Scan(REGION, "A", "m", _zeros()), "Scan2d_wide_A"))
    lab.at(1.1, lambda: lab.publish(Scan(REGION, "B", "m", _zeros()), "Scan2d_narrow_B"))
    lab.at(2.0, lab.kill)
    component = Sharpness(threshold=-1.0)
    run(component, lab, envelopes=("Scan2d_narrow",))
    assert component.seen == ["B"]


def test_unreadable_packet_is_dropped_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab()

    def publish_rubbish() -> None:
        lab.publish(Scan(REGION, "A", "m", _zeros()))
        packet = next(incoming.packet for incoming in lab.inbox)  # type: ignore[union-attr]
        packet.payload = packet.payload[:-20]
        packet.envelope = "Scan2d"
        lab.publish(ScopeStatus(ScopeState.FREE), "NobodyKnows")

    lab.at(1.0, publish_rubbish)
    lab.at(2.0, lambda: lab.publish_scan(REGION))
    lab.at(3.0, lab.kill)
    component = Sharpness(threshold=-1.0)
    assert run(component, lab) == ExitCode.ENDED
    assert component.seen == ["Height", "Phase"]
    assert "can't be read" in caplog.text


def test_handler_that_is_never_called_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab()
    lab.at(1.0, lab.kill)
    run(Diary(), lab, envelopes=("Scan2d_2000.0", "ScopeStateMsg"))
    [text] = (one for one in caplog.messages if "never called" in one)
    assert text.startswith("on_problem is never called: the component does not subscribe to ControlState")


def test_handlers_of_all_installed_components_can_be_called() -> None:
    for entry in entry_points(group="afspm.components"):
        component = entry.load()
        made, listens = component.__new__(component), getattr(component, "listens", None)
        dispatcher = MessageDispatcher(made, Component, listens, logging.getLogger("afspm.test"))
        assert not dispatcher.never_called(), entry.name


def test_ticks_keep_the_beat_of_the_experiment() -> None:
    class Beat(Component):
        period_s = 900.0

        def __init__(self) -> None:
            self.times_s: list[float] = []

        def on_tick(self) -> None:
            self.times_s.append(round(self.clock.now_s() - EPOCH_S))
            if len(self.times_s) == 2:
                self.scope.sleep(2000.0)  # two beats are missed

    lab = Lab()
    lab.at(4600.0, lab.kill)
    beat = Beat()
    run(beat, lab)
    assert beat.times_s == [0, 900, 3600, 4500]


def test_period_of_zero_is_refused() -> None:
    component = Diary()
    component.period_s = 0.0
    with pytest.raises(ConfigError, match="period"):
        run(component, Lab())


def test_a_script_is_done_when_it_returns() -> None:
    class Script(Component):
        def __init__(self) -> None:
            self.scans: list[Any] = []
            self.ended = False

        def run(self) -> None:
            self.scans.append(self.scope.scan(REGION))

        def on_end(self) -> None:
            self.ended = True

    lab = Lab()
    script = Script()
    assert run(script, lab) == ExitCode.DONE
    assert script.scans[0].region == REGION
    assert script.ended
    assert not lab.open


def test_a_script_that_ends_the_experiment_has_ended() -> None:
    class Script(Component):
        def run(self) -> None:
            self.scope.end_experiment()

    assert run(Script(), Lab()) in (ExitCode.ENDED, ExitCode.DONE)


def test_request_for_control_after_the_end_ends_the_component() -> None:
    """The answer may come before the signal."""

    class Script(Component):
        def run(self) -> None:
            with self.scope.control():
                raise AssertionError("there is nothing to control any more")

    lab = Lab()
    lab.intercept = lambda request: Response(ControlResponse.FAILURE, detail=ResponseDetail.EXPERIMENT_ENDED)
    assert run(Script(), lab) == ExitCode.ENDED


def test_the_handlers_of_a_script_are_called_between_its_calls() -> None:
    class Script(Component):
        def __init__(self) -> None:
            self.lines: list[str] = []

        def run(self) -> None:
            for i in range(2):
                self.scope.scan(REGION)
                self.lines.append(f"scan {i}")

        def on_scan(self, scan: Scan) -> None:
            self.lines.append(scan.channel)

    script = Script()
    run(script, Lab())
    assert script.lines == ["Height", "Phase", "scan 0", "Height", "Phase", "scan 1"]


def test_a_script_without_handlers_keeps_nothing_in_memory() -> None:
    class Script(Component):
        def run(self) -> None:
            self.scope.scan(REGION)

    lab = Lab()
    from afspm.client.loop import ComponentLoop

    loop = ComponentLoop(Script(), Component, context_of(lab))
    loop.run()
    assert len(loop._backlog) == 0


@pytest.mark.parametrize("who", ["kill", "parent"])
def test_the_end_comes_while_a_handler_waits(who: str) -> None:
    class Waits(Diary):
        def on_start(self) -> None:
            self.scope.wait_until(lambda: False)

    lab = Lab()
    lab.at(5.0, lab.kill if who == "kill" else lab.parent_goes)
    component = Waits()
    assert run(component, lab) == (ExitCode.ENDED if who == "kill" else ExitCode.ORPHAN)
    assert component.lines == ["end"]
    assert lab.clock.passed_s == pytest.approx(5.0)


def test_error_in_a_handler_ends_the_process() -> None:
    class Faulty(Diary):
        def on_state(self, status: ScopeStatus) -> None:
            raise ZeroDivisionError

    lab = Lab()
    component = Faulty()
    with pytest.raises(ZeroDivisionError):
        run(component, lab)
    assert "end" not in component.lines
    assert not lab.open


def test_error_in_on_end_does_not_hide_why_the_process_ended(caplog: pytest.LogCaptureFixture) -> None:
    class Faulty(Component):
        def on_end(self) -> None:
            raise ZeroDivisionError

    lab = Lab()
    lab.at(1.0, lab.kill)
    assert run(Faulty(), lab) == ExitCode.ENDED
    assert "on_end failed" in caplog.text


def test_request_in_on_end_does_no_harm_and_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    class Asks(Component):
        def on_end(self) -> None:
            self.scope.flag(TIP)

    lab = Lab()
    lab.at(1.0, lab.kill)
    assert run(Asks(), lab) == ExitCode.ENDED
    assert [record.levelname for record in caplog.records if "on_end sent a request" in record.message] == ["WARNING"]


def test_attribute_used_too_early_is_refused_with_a_reason() -> None:
    class Early(Component):
        def __init__(self) -> None:
            self.scope.flag(TIP)

    with pytest.raises(AttributeError, match="scope is not there yet in __init__"):
        Early()
    with pytest.raises(AttributeError, match="no attribute 'skope'"):
        _ = Sharpness().skope  # type: ignore[attr-defined]


class Counts(Component):
    """A component that counts scans, and fails on those of one channel."""

    def on_scan(self, scan: Scan) -> None:
        self.memory.setdefault("seen", []).append(scan.channel)
        if scan.channel == "Phase":
            raise ValueError("I can't read that")


def test_memory_is_saved_when_a_handler_returns_and_not_when_it_fails(tmp_path: Path) -> None:
    lab = Lab("counts")
    lab.at(10.0, lambda: lab.publish_scan(REGION))
    with pytest.raises(ValueError, match="read that"):
        run(Counts(), lab, tmp_path)
    assert json.loads((tmp_path / "counts.json").read_text()) == {"seen": ["Height"]}


def test_script_saves_its_memory_itself(tmp_path: Path) -> None:
    class Script(Counts):
        def on_scan(self, scan: Scan) -> None:
            self.memory["half"] = True

        def run(self) -> None:
            self.scope.scan(REGION)

    run(Script(), Lab("script"), tmp_path)
    assert not (tmp_path / "script.json").exists()


def test_all_documented_attributes_exist_at_the_start(tmp_path: Path) -> None:
    class Looks(Component):
        def on_start(self) -> None:
            self.found = {name: getattr(self, name) for name in Component.__annotations__ if name in PROMISED}
            self.memory["n"] = 1
            self.memory.save()
            raise ExperimentEnded("enough")

    looks = Looks()
    run(looks, Lab("looks"), tmp_path, run_dir="/runs/x")
    assert looks.found["name"] == "looks"
    assert looks.found["run_dir"] == Path("/runs/x")
    assert looks.found["clock"].now_s() == EPOCH_S
    assert json.loads((tmp_path / "looks.json").read_text()) == {"n": 1}


PROMISED = {"scope", "clock", "log", "name", "memory", "run_dir"}


def test_published_envelope_begins_with_the_message_name() -> None:
    class Publishes(Component):
        def on_start(self) -> None:
            self.publish(FeedbackAnalysis(proportionOverThreshold=0.5))
            self.publish(FeedbackAnalysis(), "FeedbackAnalysis_fine")
            with pytest.raises(ConfigError, match="does not begin with"):
                self.publish(FeedbackAnalysis(), "Scan2d_x")

        def run(self) -> None:
            pass

    lab = Lab()
    run(Publishes(), lab)
    assert [envelope for envelope, _ in lab.published] == ["FeedbackAnalysis", "FeedbackAnalysis_fine"]
    assert wire.decode("FeedbackAnalysis", lab.published[0][1]).proportionOverThreshold == 0.5


def test_packets_of_other_publishers_are_handled_but_do_not_set_the_state() -> None:
    from afspm.transport.port import PacketReceived

    lab = Lab()
    message, payload = wire.encode(ScopeStatus(ScopeState.SPEC))

    def publish() -> None:
        lab.inbox.append(PacketReceived(model.Packet(message, payload, 1), "memory://another"))

    lab.at(1.0, publish)
    lab.at(2.0, lab.kill)

    class Watches(Diary):
        def on_state(self, status: ScopeStatus) -> None:
            super().on_state(status)
            assert self.scope._link.view.state is ScopeState.FREE

    component = Watches()
    assert run(component, lab) == ExitCode.ENDED
    assert ScopeState.SPEC in component.lines


def test_control_of_an_earlier_life_is_given_back_when_it_is_not_needed() -> None:
    from afspm.scheduler.control.arbitration import ArbitrationEvent

    lab = Lab("corrector")
    lab.does(ArbitrationEvent.REQUEST_CONTROL, "corrector")
    lab.at(1.0, lab.kill)
    run(Diary(), lab)
    assert lab.control.holder is None


def test_busy_and_waiting_are_distinguished() -> None:
    ages: list[float] = []

    class Works(Component):
        longest_step_s = 7.0

        def on_state(self, status: ScopeStatus) -> None:
            lab.clock.passed_s += 5.0  # computing
            ages.append(context.activity.age_s())
            lab.at(3.0, lambda: ages.append(context.activity.age_s()))
            self.scope.sleep(4.0)
            ages.append(context.activity.age_s())
            raise ExperimentEnded("enough")

    lab = Lab()
    context = context_of(lab)
    Works().run_process(context)
    assert ages == [5.0, 0.0, 0.0]
    assert context.activity.longest_step_s == 7.0
    assert context.activity.age_s() == 0.0


def test_unexpected_refusal_in_a_script_is_a_crash() -> None:
    class Script(Component):
        def run(self) -> None:
            self.scope.action("x-crash")

    with pytest.raises(Refused, match="no such action"):
        run(Script(), Lab())


def test_a_component_that_waits_for_nothing_waits_without_a_timeout() -> None:
    with pytest.raises(Nothing):
        run(Diary(), Lab())


def test_a_launch_line_needs_no_sockets() -> None:
    assert Launch("x").sockets.subscribe == ()


def _zeros() -> Any:
    import numpy as np

    return np.zeros((4, 4))


@pytest.mark.parametrize("who", ["kill", "parent"])
def test_measurements_before_the_end_are_handled(who: str) -> None:
    class Table(Component):
        def __init__(self) -> None:
            self.rows: list[str] = []

        def on_scan(self, scan: Scan) -> None:
            self.rows.append(scan.channel)

    def measured_and_ended() -> None:
        lab.publish_scan(REGION)
        if who == "kill":
            lab.kill()
        else:
            lab.parent_goes()

    lab = Lab()
    lab.at(5.0, measured_and_ended)
    component = Table()
    run(component, lab)
    assert component.rows == ["Height", "Phase"]


class Fails(Component):
    """A script that measures, and fails."""

    def __init__(self, error: Exception, key: str | None = None) -> None:
        self.error, self.key = error, key

    def run(self) -> None:
        self.scope.scan(REGION, key=self.key)
        raise self.error


def fault_of(component: Component, folder: Path, lab: Lab | None = None) -> OwnFault | None:
    """Return the fault that the component reports to its supervisor."""
    assert run(component, lab or Lab(), folder) == ExitCode.OWN_FAULT
    return take_fault(folder, "experiment")


def test_failed_script_reports_its_place_and_its_kept_data(tmp_path: Path) -> None:
    first = fault_of(Fails(ValueError("0.1 nm is too rough")), tmp_path)
    assert first is not None
    assert (first.error, first.place.partition(":")[0]) == ("ValueError", "test_component_loop.py")
    assert fault_of(Fails(ValueError("0.2 nm is too rough")), tmp_path) == first
    assert fault_of(Fails(KeyError("Height")), tmp_path) != first
    assert fault_of(Fails(ValueError(), key="tile"), tmp_path) != first


def test_refusal_by_a_limit_is_a_fault_of_the_script(tmp_path: Path) -> None:
    lab = Lab()
    limit = Response(ControlResponse.PARAM_ERROR, reason="outside the limits")
    lab.intercept = lambda request: limit if request.kind == ControlRequest.SET_SCAN_PARAMS else "go on"
    fault = fault_of(Fails(ValueError()), tmp_path, lab)
    assert fault is not None
    assert fault.error == "Refused"


@pytest.mark.parametrize(
    "error", [NoResponse("it is silent"), Refused(ControlResponse.FAILURE, "busy"), OSError("no file"), MemoryError()]
)
def test_error_that_may_pass_is_not_a_fault(tmp_path: Path, error: Exception) -> None:
    with pytest.raises(type(error)):
        run(Fails(error), Lab(), tmp_path)


class Reacts(Component):
    """A component that fails on scans of one channel, after an action of its test."""

    def __init__(self, *does: str) -> None:
        self.does = does

    def on_scan(self, scan: Scan) -> None:
        if scan.channel in self.does:
            self.scope.set("tip-bias-voltage", 1.0, "V")
        if scan.channel == "Phase":
            raise ValueError("I can't read that")


@pytest.mark.parametrize(
    ("does", "is_fault"), [(["Phase"], True), ([], False), (["Height"], False), (["Height", "Phase"], False)]
)
def test_a_handler_that_fails_over_a_message_is_at_fault_if_it_had_control_and_none_before_it_had(
    tmp_path: Path, does: list[str], is_fault: bool
) -> None:
    lab = Lab()
    lab.at(10.0, lambda: lab.publish_scan(REGION))
    if is_fault:
        assert fault_of(Reacts(*does), tmp_path, lab) is not None
    else:
        with pytest.raises(ValueError, match="read that"):
            run(Reacts(*does), lab, tmp_path)


class OwnLog(Component):
    def __init__(self) -> None:
        self.log = []  # type: ignore[assignment]


class OwnName(Component):
    name = "mine"


@pytest.mark.parametrize(("kind", "attribute"), [(OwnLog, "log"), (OwnName, "name")])
def test_own_attribute_with_a_name_that_afspm_gives_is_refused(
    lab: Lab, kind: type[Component], attribute: str
) -> None:  # results X9
    with pytest.raises(ConfigError, match=f"has its own '{attribute}'"):
        run(kind(), lab)


def test_relayed_message_that_meets_the_end_is_repeated_under_its_id(monkeypatch: pytest.MonkeyPatch) -> None:
    forget_afterwards(monkeypatch)
    wire.declare(wire.MessageDeclaration(type=UInt64Value, relayed=True))

    class Counts(Component):
        def on_scan(self, scan: Scan) -> None:
            self.publish(UInt64Value(value=3))

    lab = Lab("counts")
    sent: list[str] = []

    def ends_unanswered(request: Request) -> Response | str:
        if request.kind == RELAY_REQUEST:
            sent.append(request.id)
            if len(sent) == 1:
                lab.kill()  # the end comes after the request was sent, and before its answer
                return "no answer"
        return "go on"

    lab.intercept = ends_unanswered
    lab.at(1.0, lambda: lab.publish_scan(REGION))
    assert run(Counts(), lab) == ExitCode.ENDED
    assert len(sent) >= 2
    assert sent[0] == sent[1], "with another id it would be published twice"
