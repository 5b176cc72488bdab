"""The scheduler as a real process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from deadlines import DEADLINE_S

from afspm import wire
from afspm.basics.launch import Sockets
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    Problem,
    Region,
    Response,
    Scan,
    ScopeState,
    ScopeStatus,
)
from afspm.storage.packet_log import log_folder, logged_packets
from afspm.storage.segment import path_of, segments
from afspm.supervisor import run_identity
from afspm.transport.port import CaughtUp, ControlConnected, Killed, PacketReceived

REQUEST, RELEASE = ControlRequest.REQUEST_CTRL, ControlRequest.RELEASE_CTRL
ACTION, FLAG = ControlRequest.ACTION, ControlRequest.ADD_EXP_PRBLM
START = "start-scan"


def scan(number: int, pixels: int = 8, channel: str = "Height") -> bytes:
    region = Region((0.0, 0.0), (2e-6, 2e-6))
    values = np.full((pixels, pixels), float(number))
    return wire.encode(Scan(region, channel, "m", values, 1_800_000_000_000_000_000 + number))[1]


def control_states(component: Any) -> list[ControlState]:
    return [wire.decode("ControlState", payload) for _, payload in component.packets("ControlState")]


def test_request_reaches_the_translator_only_from_the_holder(rig: Any) -> None:
    rig.start()
    one, two = rig.component("One"), rig.component("Two")
    rig.linked(one)
    assert one.ask(ACTION, START).code == ControlResponse.NOT_IN_CONTROL
    assert one.ask(REQUEST, 0).ok
    assert two.ask(REQUEST, 0).code == ControlResponse.ALREADY_UNDER_CONTROL
    refused = two.ask(ACTION, START)
    assert (refused.code, "One" in refused.reason) == (ControlResponse.NOT_IN_CONTROL, True)
    assert one.ask(ACTION, START).ok
    assert [(request.kind, request.subject) for request in rig.asked] == [(ACTION, START)]


def test_reconnecting_component_gets_the_run_once_its_old_connection_closes(rig: Any) -> None:
    rig.start()
    former = rig.component("left")
    rig.until(lambda: former.ask(ControlRequest.ACTION_SUPPORT, START).ok)
    told: list[str] = []
    launch = replace(rig.launch(), name="left", sockets=Sockets(control=rig.serve))
    with ThreadPoolExecutor(1) as pool:
        asking = pool.submit(run_identity.ask_scheduler, launch, told.append)
        rig.until(lambda: any("asking again" in text for text in told))
        rig.components.remove(former)
        former.port.close()
        rig.until(asking.done)
        assert asking.result().clock == rig.clock


def test_packet_passes_unchanged_under_its_envelope_with_increasing_times(rig: Any) -> None:
    rig.start()
    component = rig.component("Component")
    small, large = scan(1), scan(2, 512)
    for payload in (small, large, small):
        rig.publish_packet("Scan2d", payload)
    rig.until(lambda: len(component.packets("Scan2d")) == 3)
    assert component.packets("Scan2d") == [("Scan2d_2000.0_Height", payload) for payload in (small, large, small)]
    received = [i.packet.time_ns for i in component.found if isinstance(i, PacketReceived)]
    times = [time_ns for time_ns in received if time_ns is not None]
    assert len(times) == len(received)
    assert times == sorted(set(times))


def test_malformed_packet_is_dropped_and_the_next_one_arrives(rig: Any) -> None:
    rig.start()
    component = rig.component("Component")
    for name, payload in (("Scan2d", b"\xff\xff"), ("Unknown", b""), ("", b""), ("Scan2d", scan(1)[:40])):
        rig.publish_packet(name, payload)
    rig.publish_packet("Scan2d", scan(3))
    rig.until(lambda: component.packets("Scan2d"))
    assert component.packets("Scan2d") == [("Scan2d_2000.0_Height", scan(3))]


def test_restarted_scheduler_keeps_mode_holder_problems_and_cache_and_misses_no_scan(rig: Any) -> None:
    rig.start()
    holder, other = rig.component("Holder"), rig.component("Other")
    assert other.ask(FLAG, int(Problem.TIP_SHAPE_CHANGED)).ok
    assert holder.ask(REQUEST, int(Problem.TIP_SHAPE_CHANGED)).ok
    rig.publish_packet("Scan2d", scan(1))
    rig.until(lambda: len(other.packets("Scan2d")) == 1)
    before = control_states(other)[-1]
    rig.kill()
    rig.publish_packet("Scan2d", scan(2))
    rig.start()
    rig.until(lambda: len(other.packets("Scan2d")) == 2)
    assert [payload for _, payload in other.packets("Scan2d")] == [scan(1), scan(2)]
    late = rig.component("Late")
    rig.until(lambda: any(isinstance(i, CaughtUp) for i in late.found))
    assert [payload for _, payload in late.packets("Scan2d")] == [scan(1), scan(2)]
    assert control_states(late)[-1] == before == ControlState(ControlMode.AUTOMATED, "Holder", (1,))
    assert late.ask(REQUEST, 1).code == ControlResponse.ALREADY_UNDER_CONTROL
    rig.linked(holder)
    assert holder.ask(ACTION, START).ok


def test_every_scan_arrives_once_although_the_scheduler_is_killed_repeatedly(rig: Any) -> None:
    rig.settings = {"cache": {"history": {"Scan2d": 100}}}
    rig.start()
    component = rig.component("Component", ["Scan2d"])
    for number in range(60):
        rig.publish_packet("Scan2d", scan(number))
        if number % 20 == 10:
            rig.kill()
            rig.start()
        rig.pump()
    rig.until(lambda: len(component.packets()) >= 60)
    assert [payload for _, payload in component.packets()] == [scan(number) for number in range(60)]


def test_slow_translator_does_not_delay_others_and_its_late_reply_reaches_only_its_client(rig: Any) -> None:
    rig.request_timeout_s = 10.0  # long enough that others are answered meanwhile on a busy computer
    rig.answer = lambda request: Response(0, id=request.id) if request.subject != "slow" else None
    rig.start()
    holder, other = rig.component("Holder"), rig.component("Other")
    assert holder.ask(REQUEST, 0).ok
    rig.linked(holder)
    slow = holder.send(ACTION, "slow")
    rig.until(lambda: rig.asked)
    assert other.ask(FLAG, int(Problem.THERMAL_DRIFT)).ok
    assert holder.answer_to(slow) is None
    unanswered = rig.until(lambda: holder.answer_to(slow))
    assert (unanswered.code, "outcome unknown" in unanswered.reason) == (ControlResponse.NO_RESPONSE, True)


def test_request_without_a_translator_is_refused_at_once_until_it_is_back(rig: Any) -> None:
    rig.start()
    component = rig.component("Component")
    assert component.ask(REQUEST, 0).ok
    rig.linked(component)
    assert component.ask(ACTION, START).ok
    rig.translator.close()
    rig.translator = None
    rig.until(lambda: component.ask(ACTION, START).code == ControlResponse.NO_RESPONSE)
    assert component.ask(RELEASE).ok
    rig.translator = rig.make_translator(*rig.source)
    assert component.ask(REQUEST, 0).ok
    rig.until(lambda: component.ask(ACTION, START).ok)
    rig.publish_packet(*wire.encode(ScopeStatus(ScopeState.FREE)))
    rig.until(lambda: component.packets("ScopeStateMsg"))


def test_end_is_published_and_the_process_ends_with_its_own_exit_code(rig: Any) -> None:
    rig.start()
    one, two = rig.component("One"), rig.component("Two", ["Scan2d"])
    rig.until(lambda: any(isinstance(i, CaughtUp) for i in two.found))
    assert one.ask(ControlRequest.END_EXPERIMENT).ok
    rig.until(lambda: all(any(isinstance(i, Killed) for i in c.found) for c in (one, two)))
    assert rig.process.wait(timeout=DEADLINE_S) == 80


def test_scheduler_ends_at_once_when_its_parent_is_gone(rig: Any) -> None:
    rig.start()
    rig.component("Component")
    rig.process.stdin.close()
    assert rig.process.wait(timeout=DEADLINE_S) == 81


def test_a_damaged_state_is_not_taken_for_an_empty_one(rig: Any, tmp_path: Any) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "scheduler.json").write_text('{"control":')
    rig.start()
    assert rig.process.wait(timeout=DEADLINE_S) not in (0, 80, 81)


def test_a_packet_at_the_end_of_the_log_that_is_damaged_is_left_out(rig: Any, tmp_path: Any) -> None:
    rig.start()
    component = rig.component("Component")
    for number in range(3):
        rig.publish_packet("Scan2d", scan(number))
    log = log_folder(tmp_path / "state")

    def scans_on_disk() -> int:
        return sum(entry.packet.envelope.startswith("Scan2d") for entry in logged_packets(log))

    rig.until(lambda: scans_on_disk() == 3 == len(component.packets("Scan2d")))
    rig.kill()
    rig.translator.close()
    rig.translator = rig.make_translator(*rig.source)  # which has forgotten them
    (segment,) = segments(log)
    while scans_on_disk() == 3:
        segment.write_bytes(segment.read_bytes()[:-5])
    path_of(log, 99).write_bytes(b"nonsense")
    rig.start()
    late = rig.component("Late", ["Scan2d"])
    rig.until(lambda: any(isinstance(i, CaughtUp) for i in late.found))
    assert len(late.packets()) == 2
    assert set(late.packets()) < set(component.packets("Scan2d"))


def test_reconnecting_component_is_known_before_a_request_with_a_key(rig: Any) -> None:
    rig.start()
    component = rig.component("experiment")
    assert component.ask(ControlRequest.REQUEST_CTRL, 0).ok
    rig.linked(component)
    rig.answer = lambda request: None
    key = component.send(ControlRequest.ACTION, "start-scan", "experiment/key/tile/1")
    rig.until(lambda: rig.asked)
    component.send(ControlRequest.ACTION, "start-scan", key)  # the same again: it connects anew
    rig.until(lambda: sum(isinstance(i, ControlConnected) for i in component.found) == 2)
    assert component.ask(ControlRequest.RELEASE_CTRL, key="experiment/key/tile/2").ok
