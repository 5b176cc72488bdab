"""A person at Studio's panel while the translator runs."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.by_hand import act_all_to_their_end, acts, set_all, until_act
from tests.plugins.nanosurf.nanosurf_bench import Bench
from tests.plugins.vendor_bench import TURNED, Peer, moved, ready, scans, small, states

from afspm.driver import SCAN
from afspm.model import ActByHand, ControlResponse, PanelAct, Region, Scan, ScopeState, names
from afspm.plugins.nanosurf.activity import NanosurfFiles

Make = Callable[..., Bench]
FREE = ScopeState.FREE
LINES = 1024
LINE_S = 50.0
"""A line of 0.5 s of real time: the scan, of nine minutes, outlasts the deadline of any test."""
IS_SCANNING = (b"return root.workflow.imaging.is_scanning(), 0", b"return afspm_seen.scanning, afspm_seen.started")
ACTING = (b"imaging.start()", b"imaging.stop()", b"move_to", b"approach", b"withdraw", b"acquire", b"_set(", b"put(")
"""Parts of the scripts that do something."""


class Scripts:
    """The scripts that the emulated Studio has run."""

    def __init__(self, made: Bench) -> None:
        self.made = made
        self.asked: list[bytes] = []
        answer = made.emulator.answer

        def listening(client: Any, request: bytes) -> Any:
            found = answer(client, request)
            self.asked.append(request)
            return found

        made.emulator.answer = listening  # type: ignore[method-assign]

    def until_lines_are_seen(self) -> None:
        """Wait until the translator has seen the scan, which has begun, run for more than a line."""
        self.until_seen()
        began_s = self.made.clock.now_s()
        until(self.made, lambda: self.made.clock.now_s() > began_s + 2.0 * LINE_S)
        self.until_seen()

    def until_seen(self) -> None:
        """Wait for two polls: the translator has taken in the first of them when it begins the second."""
        seen = self._polls
        until(self.made, lambda: self._polls >= seen + 2)

    @property
    def _polls(self) -> int:
        return sum(script in IS_SCANNING for script in self.asked)

    @property
    def acting(self) -> list[bytes]:
        return [script for script in self.asked if any(part in script for part in ACTING)]


def until(made: Bench, what: Callable[[], bool]) -> None:
    until_s = made.clock.monotonic_s() + DEADLINE_S
    pace = Event()
    while not what():
        assert made.clock.monotonic_s() < until_s
        pace.wait(0.005)


def slow_scan(made: Bench, **settings: Any) -> tuple[Peer, Scripts]:
    """Start a scan of many slow lines, and wait until the translator has seen it run for more than one."""
    peer = made.start(result_timeout_s=20.0, **settings)
    ready(peer, shape=(LINES, 2))
    assert peer.set(names.SCAN_SPEED, 2.0 * TURNED.size_m[0] / LINE_S, "m/s").ok
    scripts = Scripts(made)
    assert peer.act(names.START_SCAN).ok
    scripts.until_lines_are_seen()
    # the emulated Studio answers nothing while it waits for the lines of a stopped scan to be computed
    until(made, lambda: made.emulator.rig.scan is not None and not made.emulator.rig.scan.drawing)
    return peer, scripts


def press(emulator: Any, button: str) -> None:
    getattr(emulator.program, button)(emulator.program.now_s)


def put(emulator: Any, path: str, value: object) -> None:
    emulator.program.put(path, value)


@pytest.mark.parametrize("release", [17, 19])
@pytest.mark.parametrize("saves_partial", [False, True])
@pytest.mark.parametrize("how", ["stop_scan", "withdraw"])
def test_scan_stopped_at_the_panel_is_by_hand_and_nothing_is_done_afterwards(
    bench: Make, release: int, saves_partial: bool, how: str
) -> None:
    made = bench(release=release)
    peer, scripts = slow_scan(made, release=release)
    made.at_panel(lambda emulator: setattr(emulator.program, "saves_partial", saves_partial))
    scripts.asked.clear()
    made.at_panel(partial(press, button=how))
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.STOP]
    assert not scans(received)
    assert scripts.acting == []
    made.until_logged("by hand: the measurement was stopped at the microscope (the scan ended after")


def test_scan_stopped_by_request_is_not_by_hand(bench: Make) -> None:
    peer, _ = slow_scan(bench())
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert acts(received) == []


def test_scan_without_a_file_is_not_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made, result_timeout_s=20.0)
    made.strike("no-file")
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert acts(received) == []


def test_duration_of_complete_scans_is_learnt_from_their_files(tmp_path: Path) -> None:
    files = NanosurfFiles({}, logging.getLogger("test"))
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((2, 2)))
    assert files.shortest_s(100, 1.0) == 45.0, "a line may be one pass"
    for lasted_s in (130.0, 110.0, 190.0):  # two were paused
        seen = {"what": SCAN, "lines": [100, 1.0], "begun_s": 1000.0, "seen_s": 1000.0 + lasted_s}
        files.check(tmp_path / "a.nhf", scan, seen)
    assert files.shortest_s(100, 1.0) == pytest.approx(0.95 * 110.0)
    assert files.shortest_s(50, 1.0) == 22.5


def test_scan_that_ends_within_its_first_line_is_not_by_hand(bench: Make) -> None:
    # Studio may have failed to begin it.
    made = bench(speed=1.0)
    peer = made.start(result_timeout_s=1.0)
    ready(peer, shape=(16, 2))
    assert peer.set(names.SCAN_SPEED, 1e-9, "m/s").ok
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    until(made, lambda: made.emulator.rig.scan is not None)
    made.at_panel(lambda emulator: emulator.program.stop_scan(emulator.program.now_s))
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("imaging.frame_center_offset_x", 90e-9),
        ("imaging.frame_center_offset_y", 10e-9),
        ("imaging.scan_range_slow_axis", 120e-9),
        ("imaging.rotation", 45.0),
    ],
)
def test_scan_whose_frame_was_changed_meanwhile_is_interrupted(bench: Make, path: str, value: float) -> None:
    made = bench()
    peer, _ = slow_scan(made)
    made.at_panel(partial(put, path=path, value=value))
    made.until_logged("this scan will not be published: its frame was changed at Studio's panel")
    before = until_act(peer)  # all values are read less often than the frame

    def end(emulator: Any) -> None:
        scan = emulator.program.rig.scan
        scan.paused_s = emulator.program.now_s - scan.start_s - LINES * LINE_S  # its lines are complete

    made.at_panel(end)
    received = before + peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert set(acts(received)) <= {PanelAct.VALUES, PanelAct.STOP}
    assert PanelAct.VALUES in acts(received)
    assert not scans(received)


@pytest.mark.parametrize(
    ("path", "value", "name"),
    [
        ("z_control.setpoint", 0.65, names.ZCTRL_SETPOINT),
        ("z_control.i_gain", 1500, names.ZCTRL_IGAIN),
        ("imaging.line_rate", 0.04, names.SCAN_SPEED),
        ("imaging.lines_per_frame", 64, names.SCAN_RESOLUTION_Y),
    ],
)
def test_value_set_at_the_panel_is_published_once_with_old_and_new_value(
    bench: Make, path: str, value: float, name: str
) -> None:
    made = bench()
    peer, _ = slow_scan(made)
    before = peer.get(name)
    made.at_panel(partial(put, path=path, value=value))
    received = peer.until(lambda one: isinstance(one, ActByHand))
    assert peer.act(names.STOP_SCAN).ok
    received += peer.until(FREE)
    found = [change for one in received if isinstance(one, ActByHand) for change in one.changes]
    assert [change.parameter for change in found] == [name]
    assert (float(found[0].before), float(found[0].after)) == (float(before), float(peer.get(name)))
    assert float(found[0].before) != float(found[0].after)


def test_paused_scan_is_published_once_it_goes_on(bench: Make) -> None:
    made = bench()
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    until(made, lambda: made.emulator.rig.scan is not None)
    made.at_panel(partial(press, button="pause"))
    Scripts(made).until_seen()
    made.at_panel(partial(press, button="resume"))
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "FREE"]
    assert acts(received) == []
    assert scans(received)


def test_scan_begun_at_the_panel_is_by_hand_and_published(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.at_panel(partial(put, path="imaging.line_rate", value=1.0 / LINE_S))
    peer.until(lambda one: isinstance(one, ActByHand))
    made.at_panel(lambda emulator: emulator.program.start_scan(emulator.program.now_s))
    received = peer.until(FREE)
    assert acts(received) == [PanelAct.SCAN]
    assert scans(received)


def test_own_requests_are_no_acts_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made)
    values = {
        names.ZCTRL_IGAIN: 1500.0,
        names.ZCTRL_SETPOINT: 0.65,
        names.SCAN_SPEED: 3e-6,
        names.SCAN_ANGLE: 12.3456789,
        names.SCAN_SIZE_X: 7.654321e-7,
    }
    set_all(peer, values)
    moved(peer, 100e-9, 0.0)
    received = act_all_to_their_end(
        peer,
        (names.START_SCAN, ScopeState.SCANNING),
        (names.START_SPEC, ScopeState.SPEC),
        (names.RETRACT, ScopeState.COARSE_MOTOR),
        (names.ENGAGE, ScopeState.COARSE_MOTOR),
        (names.START_SCAN, ScopeState.SCANNING),
    )
    assert scans(received)
    made.kill()
    assert "by hand" not in made.log_text()


# results M5
@pytest.mark.parametrize("action", [names.START_SCAN, names.START_SPEC])
def test_start_during_a_sweep_of_a_person_waits_for_its_end(bench: Make, action: str) -> None:
    made = bench()
    peer = small(made)
    sweep = "probe.frequency_sweep.run"
    made.at_panel(lambda emulator: emulator.rig.occupy(sweep, 1e4, emulator.clock.now_s()))
    response = peer.act(action)
    assert response.code == ControlResponse.NOT_FREE
    assert f"busy with a {sweep}" in response.reason
    made.at_panel(lambda emulator: emulator.rig.stop(sweep, emulator.clock.now_s()))
    assert peer.act(action).ok
    peer.until(FREE)


# results M3
def test_first_scan_of_a_size_stopped_late_or_made_faster_is_stopped_by_hand(bench: Make) -> None:
    made = bench()
    peer, _ = slow_scan(made)

    def hurry_and_stop(emulator: Any) -> None:
        put(emulator, "imaging.line_rate", 10.0)
        scan = emulator.program.rig.scan
        scan.paused_s = -0.6 * LINES * LINE_S  # beyond 45 % of the lines
        press(emulator, "stop_scan")

    made.at_panel(hurry_and_stop)
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert PanelAct.STOP in acts(received)


# results m3
def test_saving_switched_off_in_a_scan_loses_that_scan_alone(bench: Make) -> None:
    made = bench()
    peer = small(made, result_timeout_s=20.0)
    off = "data.storage.nhf_backend_enabled"
    made.at_panel(partial(put, path=off, value=False))
    assert peer.act(names.START_SCAN).ok
    made.until_logged("did not save each measurement to a new .nhf file; it does from now on")
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "FREE"]
    assert scans(received)


# the file of the person's scan became the result of the run's next one, and so on
@pytest.mark.parametrize("is_over", [False, True])
def test_scan_begun_at_once_after_a_scan_of_the_run_is_not_taken_for_it(bench: Make, is_over: bool) -> None:
    made = bench()
    peer, _ = slow_scan(made)

    def begin_another(emulator: Any) -> None:
        if is_over:
            scan = emulator.program.rig.scan
            scan.paused_s = emulator.program.now_s - scan.start_s - LINES * LINE_S  # its lines are complete
        press(emulator, "stop_scan")
        press(emulator, "start_scan")

    made.at_panel(begin_another)
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", *([] if is_over else ["INTERRUPTED"]), "FREE"]
    assert acts(received) == ([] if is_over else [PanelAct.STOP])
    assert bool(scans(received)) is is_over
    peer.until(ScopeState.SCANNING)  # the person's
