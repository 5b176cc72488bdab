"""Faults of GXSM: each is a named error, nothing hangs, and the translator reconnects."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.plugins.gxsm.gxsm_bench import Bench, Calls, hold_scan, scan_until_line, until
from tests.plugins.vendor_bench import FLAT, SHAPE, SOON, Peer, ready, scans, states

from afspm import read
from afspm.model import (
    ControlRequest,
    ControlResponse,
    ProbePosition,
    Region,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)
from afspm.plugins.gxsm.emulator.program import GxsmProgram

Make = Callable[..., Bench]
FREE = ScopeState.FREE
UNDEFINED = ScopeState.UNDEFINED
SHM: dict[str, Any] = {"transport": "shm"}
BRIDGE: dict[str, Any] = {}


def small(made: Bench, **settings: Any) -> Peer:
    """Start a translator with a small frame."""
    peer = made.start(**settings)
    ready(peer, Region((0.0, 0.0), (100e-9, 1e-6)), (8, 16))
    return peer


def scanned(peer: Peer) -> list[str]:
    assert peer.act(names.START_SCAN).ok
    found = scans(peer.until(FREE))
    assert found
    return [Path(scan.filename).name for scan in found]


# --- calls ---


@pytest.mark.parametrize(
    ("kind", "settings", "logged"),
    [
        ("garbage", BRIDGE, "reports its state as"),
        ("nan", BRIDGE, "GXSM returned nan for"),
        ("wrong-type", BRIDGE, "GXSM replied '\\x04' to"),
        ("error", BRIDGE, "SystemError: an emulated error"),
        ("error", SHM, "GXSM can't pass on the result"),
        ("wrong-type", SHM, "GXSM replied '\\x04' to"),
        ("bad-pickle", SHM, "GXSM's reply is not a pickle of a value"),
        ("evil-pickle", SHM, "GXSM's reply refers to 'posix mkdir', which afspm does not run"),
        ("code", SHM, "GXSM can't pass on the result"),
        ("huge", SHM, "GXSM replied 2147483648 bytes"),
    ],
)
def test_bad_answer_is_logged_and_gxsm_reconnected(
    bench: Make, kind: str, settings: dict[str, Any], logged: str
) -> None:
    made = bench(**settings)
    peer = small(made)
    made.strike(kind)
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_logged(logged)
    assert scanned(peer)
    assert not Path("evil").exists()


def test_moving_tip_is_still_moving_after_a_reconnection(bench: Make) -> None:
    # RPSPMC does not report that the tip moves.
    made = bench(speed=5.0, card="RPSPMC")
    peer = made.start()
    ready(peer, Region((0.0, 0.0), (1e-6, 1e-6)))
    assert peer.set(names.MOVE_SPEED, "20", "nm/s").ok
    assert peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((400e-9, 0.0))).ok
    peer.until(ScopeState.MOVING)
    made.strike("error")
    received = peer.until(FREE)
    assert states(received) == ["UNDEFINED", "MOVING", "FREE"]
    assert made.emulator.rig.probe_at(made.clock.now_s()) == pytest.approx((400e-9, 0.0))


def test_tip_moved_with_its_frame_counts_as_moving(bench: Make) -> None:
    # RPSPMC does not report this move either, and the next one starts after it.
    made = bench(speed=5.0, card="RPSPMC")
    peer = made.start()
    ready(peer, Region((0.0, 0.0), (1e-6, 1e-6)))
    assert peer.set(names.MOVE_SPEED, "50", "nm/s").ok
    for center_m in ((200e-9, 0.0), (200e-9, -100e-9)):
        assert peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(Region(center_m, (1e-6, 1e-6)), SHAPE, "")).ok
        peer.until(ScopeState.MOVING)
        assert states(peer.until(FREE)) == ["FREE"]
        assert made.emulator.rig.probe_at(made.clock.now_s()) == pytest.approx(center_m)


# results X6: of the same kind
def test_scan_whose_files_waited_is_published_long_after_a_restart(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made, result_timeout_s=100.0)
    assert scanned(peer)
    held: list[tuple[Path, bytes]] = []

    def hold_files(emulator: Any) -> None:
        emulator.program.saving.write = lambda contents, now_s: held.extend(contents)

    made.at_panel(hold_files)
    calls = Calls(made)
    assert peer.act(names.START_SCAN).ok
    until(made, lambda: any(call[0] == "autosave" for call in calls.answered))
    until(made, lambda: calls.answered[-1][0] == "rtquery")  # after the questions about its end
    made.strike("crash")
    for path, content in held:
        path.write_bytes(content)
    made.start_controller_again(channels_set=False)
    made.until_logged("GXSM reports no channel, as after a restart")
    until_s = made.clock.now_s() + 60.0  # longer than the files are awaited
    until(made, lambda: made.clock.now_s() >= until_s)
    made.at_panel(lambda emulator: emulator.program.set_channels())
    made.at_panel(lambda emulator: emulator.program.start_scan())
    found = {Path(scan.filename).name for scan in scans(peer.until(FREE))}
    assert found >= {path.name for path, _ in held}


@pytest.mark.parametrize("settings", [BRIDGE, SHM], ids=["bridge", "shm"])
def test_hanging_gxsm_is_lost_and_reconnected(bench: Make, settings: dict[str, Any]) -> None:
    made = bench(speed=1.0, **settings)
    peer = small(made, **SOON)
    made.strike("wedge", duration_s=8.0)
    peer.until(UNDEFINED)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.NO_RESPONSE
    assert "the controller can't be reached" in response.reason
    peer.until(FREE)
    made.until_logged("no answer to")
    assert peer.get(names.SCAN_RESOLUTION_X) == "16"


@pytest.mark.parametrize("settings", [BRIDGE, SHM], ids=["bridge", "shm"])
def test_restarted_gxsm_is_reconnected(bench: Make, settings: dict[str, Any]) -> None:
    made = bench(**settings)
    address = made.address.partition("@")[0]
    if settings:
        process = f"t{os.getpid()}"
        made = bench(process=process, **settings)
        address = f"{made.address.partition('@')[0]}@{process}"
    peer = small(made, address=address)
    made.strike("wedge", duration_s=1e6)
    while not made.emulator.unanswered:  # what it was asked, it will never answer
        pass
    made.strike("crash")
    peer.until(UNDEFINED)
    made.start_controller_again()
    peer.until(FREE)
    assert scanned(peer)


def test_memory_of_an_ended_gxsm_is_not_trusted(bench: Make, left_behind: Path) -> None:
    made = bench(block=left_behind.name, **SHM)
    peer = small(made)
    made.strike("crash")
    peer.until(UNDEFINED)
    assert left_behind.exists()
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.NO_RESPONSE
    made.until_logged("no process is called", "has ended")


@pytest.fixture
def left_behind() -> Iterator[Path]:
    path = Path("/dev/shm", f"afspm_left_{os.getpid()}")
    yield path
    path.unlink(missing_ok=True)


def test_stopped_script_is_reported_until_it_runs_again(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("script-stopped")
    peer.until(UNDEFINED)
    assert peer.act(names.START_SCAN).code == ControlResponse.NO_RESPONSE
    made.until_logged("is bridge.py running in GXSM's console?")
    made.at_panel(lambda emulator: emulator.run_script())
    peer.until(FREE)
    assert scanned(peer)


def test_ended_script_can_be_run_again(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("script-stopped")
    peer.until(UNDEFINED)
    # the connection ends before the script does, and the button appears after both
    button = made.data / "delete-to-run-the-script-again.txt"
    until(made, button.exists)
    button.unlink()
    peer.until(FREE)
    assert scanned(peer)


def test_a_decimal_comma_is_refused_before_anything_is_set(bench: Make) -> None:
    made = bench(decimal_comma=True)
    peer = made.start()
    peer.until(UNDEFINED)
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.25).code == ControlResponse.NO_RESPONSE
    made.until_logged("start GXSM with LC_NUMERIC=C")
    assert made.emulator.program.entries["dsp-fbs-bias"] == made.emulator.rig.setup.bias_v == 0.1


def test_silently_rejected_value_is_refused(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("refused")
    response = peer.set(names.TIP_BIAS_VOLTAGE, 0.3)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "the controller set 0.1 V instead of 0.3 V; the former values were restored" in response.reason
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.3).ok


# --- scans ---


def test_scan_that_did_not_start_is_reported_and_an_old_one_not_published(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    assert scanned(peer)
    made.at_panel(lambda emulator: emulator.woken.post())
    made.strike("no-start")
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("it was stopped or never began")


def test_scan_without_channels_is_reported(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.at_panel(lambda emulator: emulator.program.channels.clear())
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
    made.until_logged("a channel is set")
    assert made.emulator.program.dialogs == ["no channel is set"]


def test_dialog_about_channels_takes_all_starts_until_it_is_closed(bench: Make) -> None:
    made = bench(speed=20.0, channels_set=False)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
    made.at_panel(lambda emulator: emulator.program.set_channels())
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
    made.at_panel(lambda emulator: emulator.program.close_dialogs())
    assert scanned(peer)


@pytest.mark.parametrize("settings", [BRIDGE, SHM], ids=["bridge", "shm"])
def test_nothing_is_begun_after_a_restart_until_channels_are_set(bench: Make, settings: dict[str, Any]) -> None:
    process = f"c{os.getpid()}"
    made = bench(speed=20.0, **({"process": process, **settings} if settings else {}))
    address = f"{made.address.partition('@')[0]}@{process}" if settings else made.address
    peer = small(made, address=address)
    assert scanned(peer)
    made.strike("crash")
    peer.until(UNDEFINED)
    made.start_controller_again(channels_set=False)
    made.until_logged("GXSM reports no channel, as after a restart; nothing is begun (set the channels at its panel")
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.NO_RESPONSE
    assert "close its dialog" in response.reason
    made.at_panel(lambda emulator: emulator.program.set_channels())
    assert made.emulator.program.dialogs == []
    made.at_panel(lambda emulator: emulator.program.start_scan())
    peer.until(FREE)
    assert peer.act_once_free(names.START_SCAN).ok
    while not scans(peer.until(FREE)):
        pass


# results X6
@pytest.mark.parametrize("is_killed", [False, True], ids=["", "translator-killed"])
def test_nothing_is_begun_after_a_restart_in_the_first_scan_of_a_run(bench: Make, is_killed: bool) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    calls = Calls(made)
    assert peer.act(names.START_SCAN).ok
    calls.until_scan_is_seen()
    if is_killed:
        made.kill()
    made.strike("crash")
    if not is_killed:
        peer.until(UNDEFINED)
    made.start_controller_again(channels_set=False)
    if is_killed:
        peer = made.start()
    made.until_logged("GXSM reports no channel, as after a restart")
    assert peer.act(names.START_SCAN).code == ControlResponse.NO_RESPONSE
    assert made.emulator.program.dialogs == []


def test_scan_begun_at_a_restarted_gxsm_is_not_the_scan_that_ended_with_the_old_one(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    assert scanned(peer)
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("crash")
    peer.until(UNDEFINED)
    made.start_controller_again(channels_set=False)
    made.until_logged("GXSM reports no channel, as after a restart")
    made.at_panel(lambda emulator: emulator.program.set_channels())
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    made.at_panel(lambda emulator: emulator.program.start_scan())
    # after a lost contact the last published state is repeated
    assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
    peer.until(ScopeState.SCANNING)
    made.at_panel(lambda emulator: emulator.program.stop_scan())
    peer.until(FREE)
    assert scanned(peer)


def test_nothing_is_begun_once_the_channels_are_switched_off(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    assert scanned(peer)
    made.at_panel(lambda emulator: emulator.program.channels.clear())
    assert "GXSM reports no channel" in peer.act(names.START_SCAN).reason
    peer.until(UNDEFINED)
    assert made.emulator.program.dialogs == []


# --- scans that are not of the frame alone ---


@pytest.mark.parametrize(("ref", "value"), [("OffsetX", "-300"), ("OffsetY", "250"), ("Rotation", "40")])
@pytest.mark.parametrize("at_panel", [False, True], ids=["own", "panel"])
def test_scan_whose_frame_was_moved_meanwhile_is_interrupted(bench: Make, ref: str, value: str, at_panel: bool) -> None:
    made = bench(speed=5.0)
    peer = small(made)
    scanned(peer)
    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    if at_panel:
        made.at_panel(lambda emulator: emulator.program.start_scan())
    else:
        assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.at_panel(lambda emulator: emulator.program.entries.set(ref, value))
    assert len(made.emulator.program.scan.elsewhere) == 1
    made.until_logged("this scan will not be published")
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"], made.log_text()
    assert not scans(received)
    made.until_logged("the scan has no result: the frame was moved or turned during the scan")
    assert scanned(peer)


def test_scan_before_a_repetition_is_interrupted_by_a_move_of_its_frame(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = small(made)
    scanned(peer)
    program = made.emulator.program

    def begin(emulator: Any) -> None:
        emulator.program.panel.repeats = True
        hold_scan(emulator.program, 1, 2)
        emulator.program.start_scan()

    def move(emulator: Any) -> None:
        emulator.program.entries.set("OffsetX", "-300")
        scan_until_line(emulator.program, 8)

    made.at_panel(begin)
    peer.until(ScopeState.SCANNING)
    number = program.scan.number
    made.at_panel(move)
    until(made, lambda: program.scan.number > number)
    received = peer.until(ScopeState.INTERRUPTED)
    assert not scans(received)
    made.until_logged("the scan has no result: the frame was moved or turned during the scan")


def test_moved_scan_goes_on_in_the_new_frame(bench: Make) -> None:
    made = bench(speed=5.0, **FLAT)
    peer = small(made)
    scanned(peer)
    program = made.emulator.program
    (channel, *_) = program.channels
    still = program.image(channel)

    def move(emulator: Any) -> None:
        scan_until_line(emulator.program, 3)
        emulator.program.entries.set("OffsetX", "5000")

    made.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.at_panel(move)
    ((line, _),) = program.scan.elsewhere
    assert line == 3
    peer.until(FREE)
    apart = np.abs(program.image(channel) - still).max(axis=1)
    assert apart[:line].max() < 0.1 * apart[line:].max()


PART: list[dict[str, Any]] = [{"version": 3}, {}, SHM]


@pytest.mark.parametrize("part", [[0, 12, 0, 8], [20, 12, 0, 8], [8, 16, 0, 8]], ids=["left", "right", "middle"])
@pytest.mark.parametrize("kind", PART, ids=["gxsm3", "gxsm4", "shm"])
def test_scan_of_some_columns_is_not_published(bench: Make, kind: dict[str, Any], part: list[int]) -> None:
    made = bench(speed=20.0, **kind)
    peer = made.start()
    ready(peer, Region((0.0, 0.0), (100e-9, 1e-6)), (8, 32))
    scanned(peer)
    subscan(made, part)

    def begin(emulator: Any) -> None:
        hold_scan(emulator.program, 1)
        emulator.program.start_scan()

    made.at_panel(begin)
    peer.until(ScopeState.SCANNING)
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"], made.log_text()
    assert not scans(received)
    response = peer.act(names.START_SCAN)
    if kind.get("version") == 3:  # it has no parameters for it, and its rows show it at the end
        assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
        made.until_logged("its first or last columns still hold the previous scan: is SubScan on")
    else:
        assert response.code == ControlResponse.ACTION_ERROR
        assert "SubScan is on at GXSM's panel" in response.reason
        assert f"{part[1]} of 32 columns from {part[0]}, 8 of 8 rows from 0" in response.reason
        made.until_logged("the scan has no result: SubScan is on")
    subscan(made, [0, 0, 0, 0])
    assert scanned(peer)


def test_subscan_of_the_whole_frame_is_published(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    subscan(made, [0, 16, 0, 8])
    assert scanned(peer)


def subscan(made: Bench, part: list[int]) -> None:
    """Set the part of the frame that is scanned: first column, columns, first row, rows."""

    def set_it(emulator: Any) -> None:
        emulator.program.panel.subscan[:] = part
        for ref, value in zip(("xs", "xn", "ys", "yn"), part, strict=True):
            emulator.program.entries.set(f"SPMC-sls-{ref}", str(value))  # Gxsm3 has no such entries

    made.at_panel(set_it)


def stopped_at_panel(made: Bench, peer: Peer) -> None:
    """Start a scan and stop it at the panel after a few lines; check that it is not published."""
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    until_line(made, peer, 2)
    made.strike("panel-stop")
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"], made.log_text()
    assert not scans(received)


def until_line(made: Bench, peer: Peer, line: int) -> None:
    """Wait until some lines of the running scan are complete."""
    until_s = made.clock.now_s() + 60.0
    last = made.emulator.program.scan.activity
    assert last is not None
    while last.lines_done(made.clock.now_s()) < line and made.clock.now_s() < until_s:
        peer.get(names.SPEC_KIND)


KINDS: list[dict[str, Any]] = [{"version": 3}, {}, SHM, {"card": "RPSPMC"}, {"card": "simulator"}]


@pytest.mark.parametrize("saving", ["afspm", "gxsm"])
@pytest.mark.parametrize("kind", KINDS, ids=["gxsm3", "gxsm4", "shm", "rpspmc", "simulator"])
def test_scan_stopped_at_the_panel_is_interrupted(bench: Make, kind: dict[str, Any], saving: str) -> None:
    # GXSM keeps, and saves, the previous scan in rows not yet scanned, without marking them.
    made = bench(speed=1.0, **kind)
    peer = small(made, saving=saving)
    if kind.get("card") == "simulator":
        assert peer.set("x-pixel-rate", 1000).ok
    scanned(peer)
    stopped_at_panel(made, peer)
    made.until_logged("still holds the previous scan")
    assert scanned(peer), "the next one is whole, and published"


@pytest.mark.parametrize(
    ("region", "shape"),
    [
        (Region((0.0, 0.0), (100e-9, 2e-6)), (8, 16)),
        (Region((0.0, 0.0), (100e-9, 1e-6)), (6, 16)),
        (Region((0.0, 0.0), (100e-9, 1e-6)), (8, 12)),
        (Region((0.0, 0.0), (100e-9, 1e-6)), (8, 24)),
        (Region((0.0, 0.0), (100e-9, 1e-6)), (12, 16)),
    ],
    ids=["frame", "fewer-rows", "fewer-columns", "more-columns", "more-rows"],
)
def test_rows_of_another_frame_count_as_old(bench: Make, region: Region, shape: tuple[int, int]) -> None:
    made = bench(speed=1.0)
    peer = small(made)
    scanned(peer)
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, shape, "")).ok
    peer.until(FREE)
    stopped_at_panel(made, peer)


def test_scan_stopped_in_its_first_line_is_interrupted(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made)
    assert peer.set(names.SCAN_SPEED, "10", "um/s").ok
    scanned(peer)
    assert peer.set(names.SCAN_SPEED, "50", "nm/s").ok
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("panel-stop")
    assert states(peer.until(FREE)) == ["INTERRUPTED", "FREE"]


def test_stopped_first_scan_is_interrupted(bench: Make) -> None:
    # There is no previous scan: its file has zeros.
    made = bench(speed=1.0)
    peer = small(made)
    stopped_at_panel(made, peer)
    made.until_logged("lacks lines")


@pytest.mark.parametrize("seen", [True, False])
def test_scan_started_and_stopped_at_the_panel_is_interrupted(bench: Make, seen: bool) -> None:
    # Also if the translator has not seen the previous scan.
    made = bench(speed=1.0)
    peer = small(made)
    scanned(peer)
    if not seen:
        made.kill()
        peer = made.start()
        peer.until(FREE)
    made.at_panel(lambda emulator: emulator.program.start_scan())
    peer.until(ScopeState.SCANNING)
    until_line(made, peer, 4)
    made.strike("panel-stop")
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"], made.log_text()
    assert not scans(received)


def test_a_scan_stopped_while_the_translator_is_down_is_not_published(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made)
    scanned(peer)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    until_line(made, peer, 2)
    made.kill()
    made.at_panel(lambda emulator: emulator.rig.stop_scan(emulator.clock.now_s()))
    peer = made.start()
    received = peer.until(FREE)
    assert "INTERRUPTED" in states(received)
    assert {Path(scan.filename).name[:7] for scan in scans(received)} == {"scan001"}, "the one before, once more"


def test_slow_lines_of_gxsms_simulator_are_scanned_to_their_end(bench: Make) -> None:
    made = bench(speed=20.0, card="simulator")
    peer = small(made)
    assert peer.set("x-pixel-rate", 50).ok
    assert scanned(peer)
    last = made.emulator.program.scan.activity
    assert last is not None
    assert last.line_s > 0.2


def test_scan_is_saved_after_gxsms_own_work(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made)
    for name in scanned(peer):
        assert read(made.data / name).end_ns is not None, "saved at once, a file has no end in it"


def test_a_folder_chosen_at_the_panel_between_two_scans_is_found(bench: Make, tmp_path: Path) -> None:
    # GXSM reports the previous folder until it scans.
    made = bench(speed=20.0)
    peer = small(made)
    assert scanned(peer)
    other = tmp_path / "other"
    other.mkdir()
    made.at_panel(lambda emulator: setattr(emulator.program.saving, "folder", other))
    assert scanned(peer)
    assert len(list(other.glob("*.nc"))) == 4


@pytest.mark.parametrize(
    ("kind", "version", "saving"),
    [("file-late", 3, "afspm"), ("half-file", 3, "gxsm"), ("file-late", 4, "gxsm"), ("half-file", 4, "afspm")],
)
def test_slow_files_are_awaited(bench: Make, kind: str, version: int, saving: str) -> None:
    made = bench(speed=20.0, version=version)
    peer = small(made, saving=saving)
    expected = scanned(peer)
    made.strike(kind, count=2, duration_s=3.0)
    assert [name.replace("002", "001") for name in scanned(peer)] == expected


@pytest.mark.parametrize("kind", ["file-late", "half-file", "file-missing"])
def test_missing_channel_is_named_and_the_others_published(bench: Make, kind: str) -> None:
    made = bench(speed=20.0)
    peer = small(made, result_timeout_s=20.0)
    made.strike(kind, duration_s=1e6)
    found = scanned(peer)  # the last channel is written first
    assert found == ["scan001-M-Xp-ZSmTopo.nc", "scan001-Xm-ZSmTopo.nc", "scan001-Xp-ImTunnel.nc"]
    made.until_logged("GXSM did not save Xp-Phase.nc")
    assert len(scanned(peer)) == 4, "it is not given up for ever"


def test_scan_without_files_is_interrupted(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made, result_timeout_s=20.0)
    made.strike("file-missing", count=4)
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    made.until_logged("no new file in")
    assert scanned(peer)


def test_channels_named_only_during_a_scan_are_found(bench: Make) -> None:
    made = bench(speed=20.0)
    made.at_panel(lambda emulator: setattr(emulator.program, "names", _named_late(emulator.program)))
    assert {name[:7] for name in scanned(small(made))} == {"scan001"}


def _named_late(program: GxsmProgram) -> Callable[[float], list[Path]]:
    names, first = program.names, program.scan.activity

    def late(now_s: float) -> list[Path]:
        return [] if program.scan.activity is first else names(now_s)

    return late


def test_unreachable_folder_is_named(bench: Make, tmp_path: Path) -> None:
    made = bench(speed=20.0)
    peer = small(made, scan_dir=str(tmp_path / "not there"), result_timeout_s=20.0)
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
    made.until_logged("does not exist on this computer")


def test_scan_that_ended_while_gxsm_hung_is_published(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made, **SOON)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("wedge", duration_s=160.0)
    received = peer.until(FREE)
    assert "UNDEFINED" in states(received)
    assert scans(received)


# --- spectra ---


def test_unsaved_spectrum_is_reported(bench: Make) -> None:
    made = bench(speed=20.0, probe_auto_save=False)
    peer = small(made, result_timeout_s=20.0)
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "INTERRUPTED", "FREE"]
    made.until_logged("switch on Auto Save of probes")


@pytest.mark.parametrize("kind", ["file-late", "half-file"])
def test_slow_spectrum_is_awaited(bench: Make, kind: str) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.strike(kind, duration_s=3.0)
    assert peer.act(names.START_SPEC).ok
    assert any(isinstance(one, Spectrum) for one in peer.until(FREE))


def test_spectrum_with_an_existing_name_is_the_new_one(bench: Make) -> None:
    # GXSM overwrites the file.
    made = bench(speed=20.0)
    (made.data / "scan001-VP001-VP.vpdata").write_text("of last year")
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    (spectrum,) = (one for one in peer.until(FREE) if isinstance(one, Spectrum))
    assert spectrum.filename.endswith("scan001-VP001-VP.vpdata")
