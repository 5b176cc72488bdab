"""The event log is published in batches: each request with its answer, each change of control, each order."""

from __future__ import annotations

from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, published

from afspm.model import (
    CLOCK_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    JournalEntry,
    LoggedPacket,
    Parameter,
    PositionChange,
    ProbePosition,
    ProblemNames,
    Region,
    RegionChange,
    Request,
    Response,
    ScanParameters,
)
from afspm.model.scan import ShapeChange
from afspm.scheduler.control.descriptions import request_text
from afspm.scheduler.events import Effect, Forward, Kill, Publish, SaveState, Tick, Unreadable
from afspm.scheduler.publishing import event_log

R, C = ControlRequest, ControlResponse
TIP = 1


@pytest.fixture
def lab() -> Lab:
    made = Lab()
    made.translator()
    made.entries()
    return made


def said(entries: list[JournalEntry], kind: str) -> list[tuple[str, str]]:
    return [(entry.who, entry.what) for entry in entries if entry.kind == kind]


def test_request_is_logged_with_its_answer_and_duration(lab: Lab) -> None:
    lab.take_control("series")
    lab.ask("series", R.ACTION, "start-scan", "series/a/1")
    lab.later(0.05)
    lab.answer(lab.forwarded[-1])
    control, scan = (entry for entry in lab.entries() if entry.kind == "request")
    assert (control.who, control.what, control.response, control.took_s) == ("series", "asks for control", 0, 0.0)
    assert (scan.what, scan.response, scan.took_s) == ("start-scan", 0, pytest.approx(0.05))
    assert scan.time_ns >= control.time_ns


def test_measurement_is_logged_with_its_key_and_time_of_forwarding(lab: Lab) -> None:
    lab.take_control("survey")
    lab.ask("survey", R.ACTION, "start-scan", "survey/key/tile-1/2")
    sent_ns = lab.now_ns
    lab.later(0.05, 0.05)
    lab.answer(lab.forwarded[-1])
    lab.ask("stranger", R.ACTION, "start-scan", "stranger/key/tile-2/1")
    control, scan, refused = (entry for entry in lab.entries() if entry.kind == "request")
    assert (scan.key, scan.sent_ns) == ("tile-1", sent_ns)
    assert sent_ns < scan.time_ns
    assert (control.key, control.sent_ns) == ("", None)
    assert (refused.key, refused.sent_ns) == ("tile-2", None)


def test_key_outlives_a_kill_right_after_forwarding(lab: Lab) -> None:
    lab.take_control("survey")
    lab.ask("survey", R.ACTION, "start-scan", "survey/key/tile-1/1")
    sent_ns = lab.now_ns
    after = killed_after(lab, Forward)
    (start,) = (entry for entry in after.entries() if entry.what == "start-scan")
    assert (start.who, start.key, start.sent_ns) == ("survey", "tile-1", sent_ns)
    assert start.response == C.NO_RESPONSE
    assert "restarted" in start.reason


def repeated_after_a_kill(lab: Lab, who: str, action: str, id_: str) -> tuple[list[JournalEntry], int]:
    """Return the entries of a restarted scheduler after a repeated request, and the time of its first forwarding."""
    lab.take_control(who)
    lab.ask(who, R.ACTION, action, id_)
    sent_ns = lab.now_ns
    after = killed_after(lab, Forward)
    after.later(1.0, 1.0)
    after.ask(who, R.ACTION, action, id_)
    after.answer(after.forwarded[-1])
    return after.entries(), sent_ns


def test_repeated_start_keeps_its_first_time_of_forwarding_over_a_kill(lab: Lab) -> None:
    entries, sent_ns = repeated_after_a_kill(lab, "survey", "start-scan", "survey/key/tile-1/1")
    starts = [entry for entry in entries if entry.what == "start-scan"]
    assert [(entry.response, entry.key, entry.sent_ns) for entry in starts] == [
        (C.NO_RESPONSE, "tile-1", sent_ns),
        (C.SUCCESS, "tile-1", sent_ns),
    ]


def test_repeated_treatment_keeps_its_first_time_of_forwarding_over_a_kill(lab: Lab) -> None:
    entries, sent_ns = repeated_after_a_kill(lab, "corrector", "x-pulse", "corrector/a/1")
    pulses = [entry for entry in entries if entry.subject == "x-pulse"]
    assert [(entry.response, entry.sent_ns) for entry in pulses] == [(C.NO_RESPONSE, sent_ns), (C.SUCCESS, sent_ns)]


def test_start_whose_entry_outlived_the_kill_is_not_logged_again(lab: Lab) -> None:
    lab.take_control("survey")
    lab.ask("survey", R.ACTION, "start-scan", "survey/key/tile-1/1")
    lab.answer(lab.forwarded[-1])
    lab.entries()
    assert "start-scan" not in [entry.what for entry in killed_after(lab, Publish).entries()]


def killed_after(lab: Lab, kind: type[Effect]) -> Lab:
    """Return the restart of a scheduler killed after its last effect of a kind."""
    last = max(n for n, effect in enumerate(lab.effects) if isinstance(effect, kind))
    done = lab.effects[: last + 1]
    saved = [effect.state for effect in done if isinstance(effect, SaveState)]
    packets = [LoggedPacket(e.packet, e.source_ns, e.history) for e in done if isinstance(e, Publish)]
    after = Lab(state=saved[-1], codec=lab.codec, packets=packets, now=(lab.now_s + 1.0, lab.now_ns + 10**9))
    after.translator()
    return after


def test_refusal_is_logged_with_its_reason(lab: Lab) -> None:
    lab.ask("stranger", R.ACTION, "start-scan")
    (entry,) = lab.entries()
    assert entry.refused
    assert (entry.response, entry.reason) == (C.NOT_IN_CONTROL, "stranger is not in control, no component is")


@pytest.mark.parametrize("flagged", [True, False])
def test_request_for_control_that_must_wait_is_no_refusal(lab: Lab, flagged: bool) -> None:
    if flagged:
        lab.ask("judge", R.ADD_EXP_PRBLM, 1)
    else:
        lab.take_control("series")
    lab.ask("grid", R.REQUEST_CTRL, 0)
    entry = lab.entries()[-1]
    assert entry.response in (C.WRONG_EXP_PROBLEM, C.ALREADY_UNDER_CONTROL)
    assert not entry.refused


@pytest.mark.parametrize(("code", "refused"), [(C.NOT_FREE, False), (C.NO_RESPONSE, False), (C.PARAM_ERROR, True)])
def test_refusal_is_recognised_by_its_code(code: ControlResponse, refused: bool) -> None:
    assert JournalEntry(0, "request", "series", "start-scan", int(code), request=int(R.ACTION)).refused is refused


def test_entries_are_published_once_a_period_and_only_if_there_are_any(lab: Lab) -> None:
    lab.take_control("series")
    due_s = lab.core.deadline_s()
    assert due_s == lab.now_s + event_log.PERIOD_S
    lab.later(event_log.PERIOD_S / 2)
    lab.says("series", R.RELEASE_CTRL)
    assert lab.core.deadline_s() == due_s
    assert lab.entries()
    assert lab.core.deadline_s() is None
    assert lab.entries() == []


def test_every_change_of_control_is_logged_with_author_and_reason(lab: Lab) -> None:
    lab.take_control("series")
    lab.flag("classifier", TIP)
    lab.take_control("corrector", TIP)
    lab.clear("corrector", TIP)
    lab.mode("boss", ControlMode.MANUAL)
    entries = lab.entries()
    assert said(entries, "control") == [
        ("series", "in control"),
        ("series", "lost control"),
        ("classifier", "flagged tip-shape-changed"),
        ("corrector", "in control to solve tip-shape-changed"),
        ("corrector", "lost control"),
        ("corrector", "cleared tip-shape-changed"),
        ("boss", "mode MANUAL"),
    ]
    reasons = {entry.what: entry.reason for entry in entries if entry.kind == "control"}
    assert reasons["lost control"] == "the problem it solved was cleared"
    assert reasons["cleared tip-shape-changed"] == "it was flagged by classifier"


def test_requests_of_the_scheduler_are_logged(lab: Lab) -> None:
    from afspm.model import ScopeState

    lab.take_control("series")
    lab.ask("series", R.ACTION, "start-scan", "series/a/1")
    lab.answer(lab.forwarded[-1])
    lab.scope_is(ScopeState.SCANNING)
    lab.flag("classifier", TIP)
    lab.answer(lab.forwarded[-1])
    assert ("scheduler", "stop-scan") in said(lab.entries(), "request")


def test_late_answer_is_logged_after_the_missing_one(lab: Lab) -> None:
    lab.take_control("series")
    lab.ask("series", R.ACTION, "start-scan", "series/a/1")
    lab.later(5.0)
    lab.step(Tick())
    lab.later(1.0)
    lab.answer(lab.forwarded[-1])
    none, late = [entry for entry in lab.entries() if entry.what == "start-scan"]
    assert none.response == C.NO_RESPONSE
    assert (late.response, late.took_s) == (0, pytest.approx(6.0))
    assert late.reason.startswith("late")


def test_retry_is_not_logged_again(lab: Lab) -> None:
    for _ in range(3):
        lab.ask("series", R.REQUEST_CTRL, 0, "series/a/1")
    assert len(said(lab.entries(), "request")) == 1


def test_unreadable_request_is_logged(lab: Lab) -> None:
    lab.step(Unreadable("stranger", Response(int(C.CMD_NOT_SUPPORTED), b"", "there is no request 77")))
    (entry,) = lab.entries()
    assert (entry.who, entry.response, entry.reason) == ("stranger", C.CMD_NOT_SUPPORTED, "there is no request 77")


def test_entry_of_a_long_request_is_shortened(lab: Lab) -> None:
    lab.ask("stranger", R.PARAM, Parameter("scan-speed", "9" * 10**6))
    lab.step(Unreadable("stranger", Response(int(C.FAILURE), b"", "x" * 10**6)))
    asked_, unreadable = lab.entries()
    assert asked_.what.startswith("scan-speed = 999")
    assert len(asked_.what) == len(unreadable.reason) == event_log.LONGEST


def test_clock_requests_are_not_logged(lab: Lab) -> None:
    lab.ask("series", CLOCK_REQUEST)
    assert lab.entries() == []


def test_flood_of_requests_is_counted_and_no_change_of_control_left_out(lab: Lab) -> None:
    for n in range(event_log.MOST + 20):
        lab.ask("stranger", R.RELEASE_CTRL, None, f"stranger/a/{n}")
    lab.step(Unreadable("stranger", Response(int(C.FAILURE))))
    lab.take_control("series")
    entries = lab.entries()
    assert entries[-1].what == "22 more requests are left out"
    assert ("series", "in control") in said(entries, "control")
    assert len(entries) == event_log.MOST + 2


def test_all_entries_are_published_before_the_end(lab: Lab) -> None:
    effects = lab.ask("boss", R.END_EXPERIMENT)
    assert isinstance(effects[-1], Kill)
    (packet,) = published(effects)
    what = [entry.what for entry in lab.codec.decode(packet.payload).entries]
    assert what == ["ended the experiment", "ends the experiment"]


def test_published_entries_are_replayed_to_late_joiners(lab: Lab) -> None:
    for n in range(5):
        lab.take_control(f"series-{n}")
        lab.entries()
    assert sum(packet.envelope == "JournalEntries" for packet, *_ in lab.core.cached()) == 6


def test_time_of_entries_is_saved_before_they_are_published(lab: Lab) -> None:
    lab.take_control("series")
    lab.later(event_log.PERIOD_S)
    save, publish = lab.step(Tick())
    assert isinstance(save, SaveState)
    assert save.state.last_ns == published([publish])[0].time_ns


def test_restart_is_logged_after_control_is_published() -> None:
    lab = Lab()
    lab.translator()
    lab.take_control("series")
    state = [effect for effect in lab.effects if isinstance(effect, SaveState)][-1].state
    again = Lab(state=state, codec=lab.codec)
    again.later(0.5)
    assert published(again.step(Tick())) == []  # what was published before may still come again
    again.later(0.6)
    packets = published(again.step(Tick()))
    assert [packet.envelope for packet in packets] == ["ControlState", "JournalEntries"]
    (entry,) = again.codec.decode(packets[1].payload).entries
    assert entry.what == "started again; series is in control"


SQUARE = Region((0.0, 0.0), (5e-7, 5e-7))


@pytest.mark.parametrize(
    ("kind", "subject", "words"),
    [
        (R.ACTION, "start-scan", "start-scan"),
        (R.PARAM, Parameter("scan-speed", "2", "um/s"), "scan-speed = 2 µm/s"),
        (R.PARAM, Parameter("scan-speed"), "reads scan-speed"),
        (R.PARAM, Parameter("zctrl-pgain", "3"), "zctrl-pgain = 3"),
        (
            R.SET_SCAN_PARAMS,
            ScanParameters(SQUARE, (256, 128)),
            "scan parameters: 500 x 500 nm at (0, 0) nm, 128 x 256",
        ),
        (
            R.SET_SCAN_PARAMS,
            ScanParameters(Region((1.5e-4, -2e-7), (2e-6, 1e-6), 0.5235987756)),
            "scan parameters: 2 x 1 µm at (150, -0.2) µm, turned by 30 deg",
        ),
        (R.SET_SCAN_PARAMS, ScanParameters(RegionChange(width_m=1e-9)), "scan parameters: width 1 nm"),
        (R.SET_SCAN_PARAMS, ScanParameters(None, ShapeChange(rows=7)), "scan parameters: rows 7"),
        (R.SET_ZCTRL_PARAMS, Feedback(True, 1.5, setpoint=0.25), "feedback: on, P = 1.5, setpoint = 0.25"),
        (R.SET_PROBE_POS, ProbePosition((1e-8, 2e-8)), "probe position: (10, 20) nm"),
        (R.SET_PROBE_POS, PositionChange(y_m=2e-12), "probe position: y = 2 pm"),
        (R.REQUEST_CTRL, 0, "asks for control"),
        (R.REQUEST_CTRL, TIP, "asks for control to solve tip-shape-changed"),
        (R.RELEASE_CTRL, None, "gives control back"),
        (R.ADD_EXP_PRBLM, TIP, "flags tip-shape-changed"),
        (R.RMV_EXP_PRBLM, 77, "clears problem 77"),
        (R.SET_CONTROL_MODE, 1, "sets the mode MANUAL"),
        (R.SET_CONTROL_MODE, 9, "sets the mode 9"),
        (R.END_EXPERIMENT, None, "ends the experiment"),
        (R.ACTION_SUPPORT, "x-pulse", "asks whether there is x-pulse"),
        (103, "metadata", "restart metadata"),
        (99, None, "request 99"),
    ],
)
def test_requests_in_words(kind: int, subject: Any, words: str) -> None:
    assert request_text(Request(int(kind), subject), ProblemNames()) == words


@pytest.mark.parametrize(("request_", "refused"), [(R.RELEASE_CTRL, False), (R.ACTION, True)])
def test_control_given_back_twice_is_no_refusal(request_: ControlRequest, refused: bool) -> None:
    code = int(C.NOT_IN_CONTROL)
    assert JournalEntry(0, "request", "series", "", code, request=int(request_)).refused is refused
