"""The simulated microscope as a process of its own, asked in plain frames."""

from __future__ import annotations

import json
import math
import threading
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.wire.generated import control_pb2, feedback_pb2, scan_pb2, spectroscopy_pb2

MOVING, SCANNING, FREE, INTERRUPTED, SPEC = 1, 2, 3, 4, 7
START_SCAN, STOP_SCAN, START_SPEC = "start-scan", "stop-scan", "start-spec"
OK, FAILURE, NOT_FREE, PARAM_ERROR = 0, 1, 7, 9

GOLDEN = Path(__file__).parents[3] / "proto" / "golden.json"


def states(heard: list[tuple[str, Any]]) -> list[Any]:
    return [message.scope_state if name == "ScopeStateMsg" else name for name, message in heard]


def frame(x_nm: float, y_nm: float, width_nm: float, height_nm: float, angle: float, nx: int, ny: int) -> bytes:
    message = scan_pb2.ScanParameters2d()
    roi = message.spatial.roi
    roi.top_left.x, roi.top_left.y, roi.size.x, roi.size.y = x_nm, y_nm, width_nm, height_nm
    roi.angle = angle
    message.spatial.length_units, message.spatial.angular_units = "nm", "deg"
    message.data.shape.x, message.data.shape.y = nx, ny
    return message.SerializeToString()


def test_subscriber_receives_all_present_settings(run: Any) -> None:
    heard = states(run().peer().until(FREE))
    assert {"ScanParameters2d", "ZCtrlParameters", "ProbePosition", FREE} <= set(heard)


def test_a_scan_of_a_turned_frame_that_is_not_square(run: Any) -> None:
    peer = run().peer().ready()
    assert peer.ask(3, frame(100, 200, 1000, 500, 30, 24, 10))[0] == bytes([OK])
    moved = peer.until(FREE)
    assert states(moved)[0] == MOVING
    published = [message for name, message in moved if name == "ScanParameters2d"]
    assert len(published) == 1
    assert peer.act(START_SCAN) == OK
    heard = peer.until(FREE)
    assert states(heard)[0] == SCANNING
    scans = [message for name, message in heard if name == "Scan2d"]
    assert {scan.channel for scan in scans} >= {"Height", "Height Retrace"}
    for scan in scans:
        assert scan.params.spatial == published[0].spatial
        assert (scan.params.data.shape.x, scan.params.data.shape.y) == (24, 10)
        assert len(scan.values) == 240
        assert all(map(math.isfinite, scan.values))
        assert Path(scan.filename).is_file()
    roi = published[0].spatial.roi
    assert (roi.top_left.x, roi.size.y, roi.angle) == (pytest.approx(1e-7), pytest.approx(5e-7), pytest.approx(30))


def test_the_file_of_a_scan_opens_elsewhere(run: Any) -> None:
    scipy_io = pytest.importorskip("scipy.io")
    peer = run().peer().ready()
    peer.act(START_SCAN)
    scan = next(message for name, message in peer.until(FREE) if name == "Scan2d")
    with scipy_io.netcdf_file(scan.filename, mmap=False) as file:
        assert file.variables["height"].data.shape == (8, 16)
        assert list(file.variables["height"].data.ravel()) == list(scan.values)
        assert file.variables["height"].units == b"m"
        assert file.variables["x"].data[-1] - file.variables["x"].data[0] == pytest.approx(1e-6)


def test_spectra_of_both_kinds_where_the_probe_is(run: Any) -> None:
    peer = run().peer().ready()
    position = spectroscopy_pb2.ProbePosition(units="nm")
    position.point.x, position.point.y = 50.0, -70.0
    assert peer.ask(5, position.SerializeToString())[0] == bytes([OK])
    assert "ProbePosition" in states(peer.until(FREE))
    for kind in ("IV", "force"):
        assert peer.set("x-spec-kind", kind)[0] == bytes([OK])
        assert peer.act(START_SPEC) == OK
        heard = peer.until(FREE)
        assert states(heard) == [SPEC, "Spec1d", FREE]
        spectrum = heard[1][1]
        assert spectrum.type == kind
        assert spectrum.position.point.x == pytest.approx(5e-8)
        assert spectrum.position.point.y == pytest.approx(-7e-8)
        assert len(spectrum.data.values) == spectrum.data.num_variables * spectrum.data.data_per_variable > 0


def test_a_stop_interrupts_and_gets_are_answered_meanwhile(run: Any) -> None:
    peer = run(speed=1.0).peer().ready()
    assert peer.act(STOP_SCAN) == OK
    assert peer.act(START_SCAN) == OK
    assert states(peer.until(SCANNING)) == [SCANNING]
    assert peer.act(START_SCAN) == NOT_FREE
    assert peer.set("scan-speed", "1", "um/s")[0] == bytes([NOT_FREE])
    assert peer.get("scan-speed") == ("2e-06", "m/s")
    assert peer.ask(12, control_pb2.ActionMsg(action="x-pulse").SerializeToString()) == [bytes([OK])]
    assert peer.act(STOP_SCAN) == OK
    assert states(peer.until(FREE)) == [INTERRUPTED, FREE]


def test_all_golden_requests_are_answered_and_it_lives_on(run: Any) -> None:
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    peer = run().peer().ready()
    for request in golden["requests"]:
        frames = [bytes.fromhex(part) for part in request["frames"]]
        answer = peer.ask_frames(frames, 10)
        assert answer is not None, request["name"]
        assert answer[0][0] in range(13)
        if answer[0][0] != OK:
            answer = peer.ask_frames([*[*frames, b""][:2], request["name"].encode()], 10)
            assert answer is not None
            assert answer[0][0] == OK or answer[2], f"{request['name']}: no reason"
    assert peer.get("scan-speed")


def test_feedback_is_set_in_part_and_switched(run: Any) -> None:
    peer = run().peer().ready()
    before = peer.get("zctrl-igain")
    off = feedback_pb2.ZCtrlParameters(feedbackOn=False, proportionalGain=0.0)
    assert peer.ask(4, off.SerializeToString())[0] == bytes([OK])
    name, message, _ = peer.next()
    assert name == "ZCtrlParameters"
    assert (message.HasField("feedbackOn"), message.feedbackOn, message.proportionalGain) == (True, False, 0.0)
    assert peer.get("zctrl-igain") == before
    assert peer.get("x-feedback-on")[0] == "false"


def test_partial_scan_parameters_change_only_these(run: Any) -> None:
    peer = run().peer().ready()
    half = spectroscopy_pb2.ProbePosition(units="nm")
    half.point.x = 30.0
    assert peer.ask(5, half.SerializeToString()) == [bytes([OK])]
    position = next(message for name, message in peer.until(FREE) if name == "ProbePosition")
    assert (position.point.x, position.point.y) == (pytest.approx(3e-8), 0.0)
    columns = scan_pb2.ScanParameters2d()
    columns.data.shape.x = 24
    assert peer.ask(3, columns.SerializeToString()) == [bytes([OK])]
    shape = next(message.data.shape for name, message in peer.until(FREE) if name == "ScanParameters2d")
    assert (shape.x, shape.y) == (24, 8)


def test_every_base_parameter_is_read_and_set_to_its_value(run: Any) -> None:
    from afspm.model import names

    peer = run().peer().ready()
    for name in names.BASE_PARAMETERS:
        value, unit = peer.get(name)
        answer = peer.set(name, value, unit)
        assert answer[0] == bytes([OK]), (name, answer)
        assert control_pb2.ParameterMsg.FromString(answer[1]).value == value
        while peer.set("move-speed", "5", "um/s")[0] == bytes([NOT_FREE]):
            assert peer.next() is not None


def test_tip_treatment_is_in_the_truth_and_not_on_the_wire(run: Any) -> None:
    running = run({"tip": {"condition": "blunt"}})
    peer = running.peer().ready()
    assert peer.set("x-pulse-voltage", "8", "V")[0] == bytes([OK])
    assert peer.set("x-pulse-duration", "50", "ms")[0] == bytes([OK])
    assert peer.set("x-crash-speed", "20", "nm/s")[0] == bytes([OK])
    assert peer.set("x-crash-depth", "0.01", "um")[0] == bytes([OK])
    for action in ("x-pulse", "x-crash", "x-retract"):
        assert peer.act(action) == OK
        heard = peer.until(FREE)
        assert set(states(heard)) <= {1, 3, 5, 6}
    assert peer.act(START_SCAN) == 12
    assert peer.act("x-engage") == OK
    peer.until(FREE)
    assert peer.act(START_SCAN) == OK
    peer.until(FREE)
    lines = running.truth()
    ledger = [line for line in lines if line["event"] == "ledger"][-1]
    assert (ledger["pulses"], ledger["crashes"]) == (1, 1)
    events = [line for line in lines if "truth" in line]
    assert [event["event"] for event in events] == ["start", "pulse", "crash", "scan starts", "scan"]
    assert (events[1]["voltage_v"], events[1]["duration_s"]) == (8.0, pytest.approx(0.05))
    assert (events[2]["speed_m_per_s"], events[2]["depth_m"]) == (pytest.approx(2e-8), pytest.approx(1e-8))
    (crater,) = [mark for mark in events[2]["truth"]["marks"] if mark["kind"] == "crash"]
    assert 3e-9 < crater["depth_m"] < 1e-8  # nearly what was asked for: some of it springs back
    assert events[1]["outcome"] in ("cured", "worsened", "unchanged")
    assert "drift_m" in events[-1]["truth"]
    assert events[0]["truth"]["tip"]["flaws"] == ["blunt"]


def test_retracting_is_always_allowed_and_interrupts(run: Any) -> None:
    peer = run(speed=1.0).peer().ready()
    peer.act(START_SCAN)
    peer.until(SCANNING)
    assert peer.act("x-retract") == OK
    assert states(peer.until(FREE)) == [INTERRUPTED, 5, FREE]


def test_what_a_person_does_at_the_panel_is_published(run: Any) -> None:
    panel = [
        {"at_s": 3000.0, "set": {"zctrl-pgain": 0.25, "scan-size-x": "700 nm"}},
        {"at_s": 4000.0, "action": START_SCAN},
    ]
    peer = run({"panel": panel}).peer().ready()
    heard = peer.until(FREE)
    assert states(heard)[:3] == ["ScanParameters2d", "ZCtrlParameters", SCANNING]
    assert heard[0][1].spatial.roi.size.x == pytest.approx(7e-7)
    assert heard[1][1].proportionalGain == pytest.approx(0.25)
    assert states(heard)[-2:] == ["Scan2d", FREE]


def test_a_killed_translator_is_the_same_instrument_and_delivers_the_scan_once(run: Any) -> None:
    running = run(speed=5.0)
    peer = running.peer().ready()
    # 8 lines of 4 s, 6.4 s of real time: a busy computer must not hear of the whole scan before the kill
    assert peer.set("scan-speed", "0.5", "um/s")[0] == bytes([OK])
    assert peer.act(START_SCAN, "me/1/scan") == OK
    peer.until(SCANNING)
    running.kill()
    running.start()
    assert peer.act(START_SCAN, "me/1/scan") == OK  # asked again: not carried out again
    assert peer.get("scan-speed") == ("5e-07", "m/s")
    heard = peer.until(FREE)
    delivered = [message for name, message in heard if name == "Scan2d"]
    assert len(delivered) == 5, states(heard)
    assert INTERRUPTED not in states(heard)
    assert len(list((running.folder / "scans").glob("scan-*.nc"))) == 1
    assert peer.act(START_SCAN, "me/1/again") == OK
    peer.until(SCANNING)
    assert states(peer.until(FREE)).count("Scan2d") == 5
    assert len(list((running.folder / "scans").glob("scan-*.nc"))) == 2


def test_a_scan_that_ends_while_the_translator_is_down_is_delivered(run: Any) -> None:
    running = run(speed=20.0)
    peer = running.peer().ready()
    peer.act(START_SCAN)
    peer.until(SCANNING)
    running.kill()
    # the instrument goes on without us, and nobody can tell us when it is done
    threading.Event().wait(running.clock.real_s(60.0))
    running.start()
    heard = peer.until(FREE)
    assert states(heard).count("Scan2d") == 5
    assert states(heard)[-6:] == ["Scan2d"] * 5 + [FREE]


def test_after_a_kill_results_come_again_at_the_time_of_the_first(run: Any) -> None:
    running = run()
    peer = running.peer().ready()
    peer.act(START_SCAN)
    first: list[tuple[str, int]] = []
    while len(first) < 5:
        packet = peer.next()
        if packet[0] == "Scan2d":
            first.append((packet[1].channel, packet[2]))
    running.kill()
    running.start()
    again: list[tuple[str, int]] = []
    while len(again) < 5:
        packet = peer.next()
        if packet[0] == "Scan2d":
            again.append((packet[1].channel, packet[2]))
    assert again == first


def test_it_serves_again_after_a_kill(run: Any) -> None:
    """How soon, the benchmarks say."""
    running = run()
    peer = running.peer().ready()
    before = peer.get("scan-speed")
    running.kill()
    running.start()
    assert peer.get("scan-speed") == before


def test_it_ends_when_its_parent_goes(run: Any) -> None:
    running = run()
    running.peer().until(FREE)
    assert running.stop() == 81


def test_end_of_the_experiment_stops_the_scan_and_the_translator(run: Any) -> None:
    running = run(speed=1.0)
    peer = running.peer().ready()
    assert peer.act(START_SCAN) == OK
    peer.until(SCANNING)
    assert peer.ask(100) == [bytes([OK])]
    assert states(peer.until(FREE)) == [INTERRUPTED, FREE]
    assert running.wait(DEADLINE_S) == 80


def test_settings_that_cannot_be_end_it_for_good_with_a_hint(run: Any) -> None:
    running = run({"drift": {"velocity": [1, 2, 3]}})
    assert running.wait(DEADLINE_S) == 78
    assert "velocity_m_per_s" in running.log.read_text()
