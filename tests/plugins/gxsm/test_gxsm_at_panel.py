"""A person at GXSM's panel while the translator runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.plugins.by_hand import act_all, acts, set_all
from tests.plugins.gxsm.gxsm_bench import Bench, Calls, hold_scan, scan_until_line
from tests.plugins.vendor_bench import Peer, ready, scanned, scans, states

from afspm.model import ActByHand, ControlRequest, PanelAct, ProbePosition, Region, ScopeState, ScopeStatus, names

Make = Callable[..., Bench]
FREE = ScopeState.FREE
SIMULATOR: dict[str, Any] = {"card": "simulator"}
KINDS: list[dict[str, Any]] = [{"version": 3}, {"transport": "shm"}, {"card": "RPSPMC"}, SIMULATOR]
KIND_IDS = ["gxsm3", "gxsm4-shm", "rpspmc", "simulator"]


def is_paused(packet: object) -> bool:
    return packet == ScopeStatus(ScopeState.SCANNING, paused=True)


def small(made: Bench, **settings: Any) -> Peer:
    """Start a translator with a small frame."""
    peer = made.start(**settings)
    ready(peer, Region((0.0, 0.0), (100e-9, 1e-6)), (8, 16))
    if made.emulator.program.card == "simulator":
        assert peer.set("x-pixel-rate", 4000).ok
    return peer


def held(made: Bench, peer: Peer) -> Calls:
    """Start a scan that stays before its first line, and that the translator has seen to run."""
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    calls = Calls(made)
    assert peer.act(names.START_SCAN).ok
    calls.until_scan_is_seen()
    calls.answered.clear()
    return calls


def stop(made: Bench, line: int) -> None:
    """Stop the held scan at the panel, after some lines."""

    def at_once(emulator: Any) -> None:
        scan_until_line(emulator.program, line)
        emulator.program.stop_scan()

    made.at_panel(at_once)


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
@pytest.mark.parametrize("is_first", [False, True], ids=["later", "first"])
def test_scan_stopped_at_the_panel_is_by_hand_and_nothing_is_done_afterwards(
    bench: Make, kind: dict[str, Any], is_first: bool
) -> None:
    # GXSM's memory holds no scan before the first.
    made = bench(**kind)
    peer = small(made)
    if not is_first:
        scanned(peer)
    calls = held(made, peer)
    stop(made, 4)
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.STOP]
    assert not scans(received)
    assert calls.acting == []
    made.until_logged("by hand: the measurement was stopped at the microscope (GXSM ended the scan before its last row")


# results X3
@pytest.mark.parametrize("lines", [1, 2])
def test_end_of_a_simulated_scan_after_its_first_lines_is_not_by_hand(bench: Make, lines: int) -> None:
    made = bench(**SIMULATOR)
    peer = small(made)
    for _ in range(2):
        held(made, peer)
        stop(made, lines)  # as GXSM's own simulator does by itself, with some channels of the second line
        received = peer.until(FREE)
        assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
        assert acts(received) == []
        scanned(peer)


# results M2
@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
@pytest.mark.parametrize("lines", [4, 8], ids=["stopped", "complete"])
def test_scan_replaced_by_one_of_a_person_is_by_hand(bench: Make, kind: dict[str, Any], lines: int) -> None:
    made = bench(**kind)
    peer = small(made)
    scanned(peer)
    calls = held(made, peer)

    def replace(emulator: Any) -> None:
        program = emulator.program
        scan_until_line(program, lines)
        program.stop_scan()
        hold_scan(program, 1)
        program.start_scan()

    made.at_panel(replace)
    received = peer.until(lambda one: isinstance(one, ActByHand))
    assert acts(received) == [PanelAct.STOP]
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received += peer.until(FREE) + peer.until(FREE)
    assert calls.acting == []
    made.until_logged("another scan was begun at GXSM's panel before this one was saved")


# results X5
@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_scan_that_becomes_several_layers_is_by_hand_and_multi_layer_named(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(**kind)
    peer = small(made)
    scanned(peer)

    def begin(emulator: Any) -> None:
        emulator.program.panel.layers = 3
        hold_scan(emulator.program, 2)

    made.at_panel(begin)
    held(made, peer)
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 8))
    received = peer.until(lambda one: isinstance(one, ActByHand))
    assert acts(received) == [PanelAct.STOP]
    assert not scans(received)
    made.until_logged("by hand: the measurement was stopped at the microscope (Multi Layer is on at GXSM's panel")


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_scan_stopped_by_request_is_not_by_hand(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(**kind)
    peer = small(made)
    scanned(peer)
    held(made, peer)
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 4))
    assert peer.act(names.STOP_SCAN).ok
    assert acts(peer.until(FREE)) == []


@pytest.mark.parametrize("fault", ["no-start", "file-missing"])
def test_scan_that_never_began_or_has_no_file_is_not_by_hand(bench: Make, fault: str) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    scanned(peer)
    made.strike(fault, 4)  # each channel has a file
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert acts(received) == []


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_paused_scan_is_published_once_it_goes_on_and_its_pause_is_by_hand(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(**kind)
    peer = small(made)
    scanned(peer)
    calls = held(made, peer)
    made.at_panel(lambda emulator: emulator.program.pause_scan())
    has_bit = kind.get("card") != "simulator"
    received = peer.until(is_paused) if has_bit else []

    def go_on(emulator: Any) -> None:
        emulator.program.resume_scan()
        scan_until_line(emulator.program, 1)

    made.at_panel(go_on)
    received += peer.until(FREE)
    assert acts(received) == ([PanelAct.PAUSE] if has_bit else [])
    assert scans(received)
    assert "startscan" not in " ".join(calls.acting)


def test_scan_stopped_during_its_pause_is_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made)
    scanned(peer)
    held(made, peer)

    def pause(emulator: Any) -> None:
        scan_until_line(emulator.program, 4)
        emulator.program.pause_scan()

    made.at_panel(pause)
    received = peer.until(is_paused)
    made.at_panel(lambda emulator: emulator.program.stop_scan())
    received += peer.until(FREE)
    assert acts(received) == [PanelAct.PAUSE, PanelAct.STOP]
    assert not scans(received)


def test_scan_with_the_feedback_switched_off_at_the_panel_is_not_published(bench: Make) -> None:
    made = bench()
    peer = small(made)
    scanned(peer)
    held(made, peer)
    made.at_panel(lambda emulator: emulator.program.switch_feedback(on=False))
    received = peer.until(lambda one: isinstance(one, ActByHand))
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received += peer.until(FREE)
    assert acts(received) == [PanelAct.FEEDBACK_OFF]
    assert not scans(received)
    refused = peer.act(names.START_SCAN)
    assert "switch it on at the panel" in refused.reason
    made.at_panel(lambda emulator: emulator.program.switch_feedback(on=True))
    assert peer.act_once_free(names.START_SCAN).ok
    assert scans(peer.until(FREE))


def test_scan_with_the_feedback_switched_off_by_the_run_is_published(bench: Make) -> None:
    actions = ["FB-ON", "FB-OFF"]
    made = bench(feedback_actions=actions)
    peer = small(made, feedback_actions=actions)
    assert peer.set(names.FEEDBACK_ON, False).ok
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert scans(received)
    assert acts(received) == []


@pytest.mark.parametrize(
    ("ref", "value", "name"),
    [
        ("dsp-fbs-bias", 1.5, names.TIP_BIAS_VOLTAGE),
        ("dsp-fbs-mx0-current-set", 0.75, names.ZCTRL_SETPOINT),
        ("dsp-fbs-cp", 0.125, names.ZCTRL_PGAIN),
        ("dsp-fbs-ci", 20.0, names.ZCTRL_IGAIN),
        ("dsp-fbs-scan-speed-scan", 12345.0, names.SCAN_SPEED),
        ("PointsY", 12.0, names.SCAN_RESOLUTION_Y),
    ],
)
def test_value_set_at_the_panel_during_a_scan_is_published_once_with_old_and_new_value(
    bench: Make, ref: str, value: float, name: str
) -> None:
    made = bench()
    peer = small(made)
    scanned(peer)
    held(made, peer)
    before = peer.get(name)
    made.at_panel(lambda emulator: emulator.program.entries.set(ref, repr(value)))
    received = peer.until(lambda one: isinstance(one, ActByHand))
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received += peer.until(FREE)
    found = [change for one in received if isinstance(one, ActByHand) for change in one.changes]
    assert [change.parameter for change in found] == [name]
    assert (float(found[0].before), float(found[0].after)) == (float(before), float(peer.get(name)))
    assert float(found[0].before) != float(found[0].after)
    assert scans(received)


def test_scan_begun_at_the_panel_is_by_hand_and_published(bench: Make) -> None:
    made = bench()
    peer = small(made)
    scanned(peer)
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    made.at_panel(lambda emulator: emulator.program.start_scan())
    received = peer.until(lambda one: isinstance(one, ActByHand))
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received += peer.until(FREE)
    assert acts(received) == [PanelAct.SCAN]
    assert scans(received)


def test_own_requests_are_no_acts_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made)
    values = {
        names.TIP_BIAS_VOLTAGE: 0.2,
        names.SCAN_SPEED: 3e-6,
        names.ZCTRL_IGAIN: 20.0,
        names.ZCTRL_SETPOINT: 0.75e-9,
        names.SCAN_ANGLE: 12.3456789,
        names.SCAN_SIZE_X: 7.654321e-7,
    }
    set_all(peer, values)
    assert peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((100e-9, 0.0))).ok
    act_all(
        peer,
        (names.START_SCAN, ScopeState.SCANNING),
        (names.START_SPEC, ScopeState.SPEC),
        (names.PULSE, ScopeState.BUSY_PARAM),
        (names.START_SCAN, ScopeState.SCANNING),
    )
    assert scans(peer.until(FREE))
    made.kill()
    assert "by hand" not in made.log_text()
