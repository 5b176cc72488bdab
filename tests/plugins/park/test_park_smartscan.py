"""The emulated SmartScan without its socket: measurements and moves of scripts, on the test's own clock."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from deadlines import DEADLINE_S
from fake_clock import FakeClock

from afspm.basics import ExperimentClock, InvalidValue
from afspm.emulation import Faults, InstrumentBusy, ScriptFailed, SimulatedInstrument
from afspm.plugins.park.emulator import ParkEmulator
from afspm.plugins.park.emulator.engine import LONGEST_S, MOST_ALONE, Script, Wait
from afspm.plugins.park.emulator.smartscan import SmartScanProgram


class SmartScan(SmartScanProgram):
    """SmartScan with calls in the form of scripts, on a clock that advances until a call has ended."""

    def __init__(self, folder: Path) -> None:
        self.fake_clock = FakeClock()
        rig = SimulatedInstrument({"surface": "particles"}, seed=3, start_s=self.fake_clock.t_s)
        rig.setup.shape = (8, 16)
        log = logging.getLogger("test")
        faults = Faults([], ParkEmulator.fault_kinds, 0.0)
        super().__init__(rig, faults, self.fake_clock, folder, log, start_s=0.1, file_s=0.1)

    def begin(self, path: str, *given: object) -> Any:
        return self.ask("call", path, list(given))

    def call(self, path: str, *given: object) -> Any:
        found = self.begin(path, *given)
        if not isinstance(found, Wait):
            return found
        for _ in range(1000):
            self.advance(self.fake_clock.t_s)
            if not found.waiting():
                return found.value()
            self.fake_clock.t_s += 0.1
        raise AssertionError(f"{path} does not end")

    def value(self, path: str) -> Any:
        return self.ask("get", path, [])


@pytest.fixture
def smartscan(tmp_path: Path) -> SmartScan:
    return SmartScan(tmp_path)


def scanned(smartscan: SmartScan) -> np.ndarray:
    smartscan.call("scan.setScanGeometry", {"pixelHeight": 8, "pixelWidth": 32})
    smartscan.ask("set", "scan.rate", [20.0])
    smartscan.call("scan.startImageScan")
    assert smartscan.rig.scan is not None
    return np.asarray(smartscan.rig.scan.channels()["Height"][1])


@pytest.mark.parametrize("wanted", [1.0, None, "1 um", []])
def test_geometry_that_is_no_object_is_refused(smartscan: SmartScan, wanted: object) -> None:
    # faults 18: random calls, seed 1, call 55
    with pytest.raises(InvalidValue, match="is no object"):
        smartscan.call("scan.setScanGeometry", wanted)


# --- z ---


def test_tip_leaves_the_sample_by_scanner_or_stage_and_comes_back_by_an_approach(smartscan: SmartScan) -> None:
    for path, target_um in (("zscanner.moveTo", 3.0), ("zstage.moveTo", 40.0)):
        assert smartscan.rig.engaged
        smartscan.call(path, target_um)
        assert not smartscan.rig.engaged
        smartscan.call("approach.start", "q+s")
        assert (smartscan.value("zscanner.pos"), smartscan.value("zstage.pos")) == (0.0, 0.0)
    smartscan.call("zscanner.retractAll")
    assert (smartscan.rig.engaged, smartscan.value("zscanner.pos")) == (False, 7.5)


def test_stage_lifted_by_the_way_of_the_scanner_leaves_it_free(smartscan: SmartScan) -> None:
    smartscan.call("zstage.move", 5.0, 1)
    smartscan.call("zscanner.moveTo", -4.0)
    assert not smartscan.rig.engaged
    smartscan.call("zscanner.moveTo", -5.0)
    assert smartscan.rig.engaged


def test_scanner_stepped_down_touches_without_a_crash(smartscan: SmartScan) -> None:
    smartscan.call("zscanner.moveTo", 0.02)
    marks = len(smartscan.rig.world.sample.marks)
    while not smartscan.rig.engaged:
        smartscan.call("zscanner.moveTo", smartscan.value("zscanner.pos") - 0.01)
    assert len(smartscan.rig.world.sample.marks) == marks


@pytest.mark.parametrize(
    ("path", "target_um"), [("zscanner.moveTo", -1.0), ("zstage.moveTo", -3.0), ("zstage.move", -3.0)]
)
def test_tip_driven_into_the_sample_leaves_a_crater(smartscan: SmartScan, path: str, target_um: float) -> None:
    smartscan.call(path, target_um)
    (crater,) = smartscan.rig.world.sample.marks
    assert crater.kind == "crash"


@pytest.mark.parametrize(
    ("path", "given"),
    [
        ("zscanner.moveTo", (8.0,)),
        ("zscanner.moveTo", ("up",)),
        ("zstage.moveTo", (0.0, 2.0)),
        ("xystage.moveTo", (float("inf"), 0.0)),
        ("sleep", (-1.0,)),
        ("readChannelAveraged", ("current", 0, 1)),
        ("scan.channels.remove", ("dI/dV",)),
        ("ncm.sweepAuto", ("a",)),
    ],
)
def test_value_out_of_range_is_refused_and_nothing_moves(smartscan: SmartScan, path: str, given: tuple[object]) -> None:
    with pytest.raises(InvalidValue):
        smartscan.begin(path, *given)
    assert smartscan.rig.engaged
    assert not smartscan.rig.busy(smartscan.fake_clock.t_s)


@pytest.mark.parametrize(
    ("path", "given"),
    [
        ("zscanner.moveTo", (1.0,)),
        ("zstage.moveTo", (1.0,)),
        ("xystage.moveTo", (1.0, 1.0)),
        ("ncm.sweepAuto", ()),
        ("scan.triggerLineScan", ()),
    ],
)
def test_moves_are_refused_during_a_scan(smartscan: SmartScan, path: str, given: tuple[float, ...]) -> None:
    smartscan.begin("scan.triggerImageScan")
    for _ in range(3):  # the ramp to the first line, and the first lines
        with pytest.raises(InstrumentBusy, match="busy with a scan"):
            smartscan.begin(path, *given)
        smartscan.fake_clock.t_s += 0.4
        smartscan.advance(smartscan.fake_clock.t_s)


# --- the sample's stage ---


def test_stage_puts_another_place_under_the_tip_and_back(smartscan: SmartScan) -> None:
    before = scanned(smartscan)
    smartscan.call("xystage.moveTo", 30.0, -20.0, 1, 1)
    elsewhere = scanned(smartscan)
    x, y = smartscan.rig.world.sample.under((0.0, 0.0), smartscan.fake_clock.t_s)
    assert (x, y) == pytest.approx((30e-6, -20e-6))
    assert smartscan.value("xystage.pos") == {"x": 30.0, "y": -20.0}
    smartscan.call("xystage.reset")
    again = scanned(smartscan)
    assert np.corrcoef(before.ravel(), again.ravel())[0, 1] > 0.9
    assert abs(np.corrcoef(before.ravel(), elsewhere.ravel())[0, 1]) < 0.7


# --- channels ---


def test_files_exist_for_recorded_channels_only(smartscan: SmartScan, tmp_path: Path) -> None:
    for name in smartscan.call("scan.channels.names"):
        smartscan.call("scan.channels.remove", name)
    smartscan.call("scan.channels.add", {"name": "ChannelZHeight", "unit": "um"})
    smartscan.call("addChannel", "current")
    assert smartscan.call("scan.channels.names") == ["Height", "Current"]
    scanned(smartscan)
    smartscan.fake_clock.t_s += 10.0
    smartscan.advance(smartscan.fake_clock.t_s)
    written = sorted(path.stem.partition("_0001_")[2] for path in tmp_path.glob("*.tiff"))
    assert written == ["Current_Forward", "Height_Backward", "Height_Forward"]


def test_current_is_read_in_the_unit_that_users_scripts_know(smartscan: SmartScan) -> None:
    read = smartscan.call("readChannel", "current")
    assert read["unit"] == "pA"
    assert read["value"] == pytest.approx(read["rawValue"] * 1e12)
    assert smartscan.call("readChannel", "ChannelZHeight")["unit"] == "um"
    smartscan.call("zscanner.retractAll")
    assert abs(smartscan.call("readChannel", "current")["value"]) < 1.0  # pA, of noise
    with pytest.raises(InvalidValue, match="no channel 'ChannelSampleBias'"):
        smartscan.call("readChannel", "ChannelSampleBias")


def test_average_takes_its_time_and_has_less_noise(smartscan: SmartScan) -> None:
    smartscan.call("zscanner.retractAll")  # noise alone
    one, many = ([smartscan.call("readChannelAveraged", "current", n, 1)["value"] for _ in range(30)] for n in (1, 100))
    assert np.std(many) < 0.3 * np.std(one)
    began_s = smartscan.fake_clock.t_s
    smartscan.call("readChannelAveraged", "current", 100, 20)
    assert smartscan.fake_clock.t_s - began_s == pytest.approx(2.0, abs=0.15)


# --- what takes its time ---


def test_line_is_scanned_until_it_is_stopped_and_nothing_is_saved(smartscan: SmartScan, tmp_path: Path) -> None:
    smartscan.call("scan.triggerLineScan")
    smartscan.fake_clock.t_s += 3600.0
    smartscan.advance(smartscan.fake_clock.t_s)
    assert smartscan.scanning
    smartscan.call("scan.stop")
    assert not smartscan.scanning
    smartscan.advance(smartscan.fake_clock.t_s + 10.0)
    assert not list(tmp_path.glob("*.tiff"))


def test_sweep_of_the_drive_frequency_keeps_the_instrument_busy(smartscan: SmartScan) -> None:
    sweep = smartscan.begin("ncm.sweepAutoFullRange")
    with pytest.raises(InstrumentBusy, match="busy with a sweep"):
        smartscan.begin("scan.triggerImageScan")
    smartscan.fake_clock.t_s += 3.1
    assert not sweep.waiting()


def run_on(script: Script) -> tuple[object, str] | None:
    """Return the value of a script; None once it waits for the instrument."""
    while (found := script.step()) is None and not script.waits:
        pass
    return found


def test_script_sleeps_in_the_experiments_time(smartscan: SmartScan) -> None:
    source = "var t0 = Date.now(); while (Date.now() - t0 < 90) { spm.sleep(20); } Date.now() - t0"
    script = Script(source, smartscan.names, smartscan.ask)
    naps = 0
    while (found := run_on(script)) is None:
        wakes_s = smartscan.next_waking_s(smartscan.fake_clock.t_s)
        assert wakes_s is not None
        assert wakes_s - smartscan.fake_clock.t_s == pytest.approx(0.02, abs=1e-6)
        smartscan.fake_clock.t_s, naps = wakes_s, naps + 1
    assert (found[0], naps) == (100, 5)
    assert smartscan.next_waking_s(smartscan.fake_clock.t_s) is None


def test_value_of_a_slow_call_returns_to_the_script(smartscan: SmartScan) -> None:
    script = Script("spm.readChannelAveraged('current', 2, 10).unit", smartscan.names, smartscan.ask)
    assert run_on(script) is None
    smartscan.fake_clock.t_s += 1.0
    assert run_on(script) == ("pA", "pA")


def test_computing_script_does_not_block_others(smartscan: SmartScan) -> None:
    script = Script(
        "let sum = 0; for (let i = 0; i < 3e6; i++) { sum += i; } 5", smartscan.names, smartscan.ask, at_once_s=0.01
    )
    assert script.step() is None
    assert 0.0 < script.computes_for_s < LONGEST_S
    assert run_on(script) == (5, "5")


def test_endless_script_is_ended(smartscan: SmartScan) -> None:
    script = Script("for (let i = 0; i < 3e6; i++) {} 5", smartscan.names, smartscan.ask, at_once_s=0.01, longest_s=0.0)
    with pytest.raises(ScriptFailed, match="does not come to an end"):
        run_on(script)


# --- requests that are none ---

HALF_A_PAIR = b'{"method": "js_cmd", "params": "\\ud800"}'
NO_REQUESTS = (b"hello", b"", b"\xff\xfe", b"[" * 100_000, b"5", b"[]", b'{"id": NaN}', HALF_A_PAIR)


@pytest.mark.parametrize("errors", ["rpc", "result", "value"])
def test_malformed_request_gets_the_json_rpc_error(errors: Any, tmp_path: Path) -> None:
    with (
        ParkEmulator(seed=2, errors=errors).running(tmp_path / "data") as address,
        zmq.Context() as context,
        context.socket(zmq.REQ) as client,
    ):
        client.setsockopt(zmq.LINGER, 0)
        client.setsockopt(zmq.RCVTIMEO, int(DEADLINE_S * 1000))
        client.connect(address)
        for request in NO_REQUESTS:
            client.send(request)
            reply = json.loads(client.recv())
            assert (reply["error"]["code"], reply["id"]) == (-32700, None)
        client.send_json({"jsonrpc": "2.0", "method": "js_connect", "params": "None", "id": 7})
        assert client.recv_json() == {"jsonrpc": "2.0", "result": "true", "id": 7}


# --- values of users' scripts ---

VOLTAMMETRY = """
var before = spm.dataLocation;
spm.dataLocation = {baseDir: before.baseDir, subDir: "cv", envLogDir: before.envLogDir, fieldWidth: before.fieldWidth};
spm.spect.iv = {pixels: 64, bias: {lowest: -0.5, highest: 0.5, start: 0, end: 0}};
spm.spect.start("iv", "here");
var iv = spm.spect.iv;
spm.dataLocation = before;
var types = [typeof before.envLogDir, typeof before.fieldWidth, typeof iv.speed];
types.concat([iv.pixels, iv.bias.lowest, spm.dataLocation.subDir]).join();
"""


def test_sweep_and_folder_are_read_and_set_as_in_users_scripts(tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=100.0)
    with (
        ParkEmulator(seed=2).running(tmp_path / "data", clock) as address,
        zmq.Context() as context,
        connect(context, address) as client,
    ):
        assert evaluated(client, VOLTAMMETRY) == "string,number,number,64,-0.5,"


@pytest.mark.parametrize("assigned", ["spect.iv = 5", "dataLocation = 'C:/'"])
def test_object_is_not_replaced_by_a_simple_value(smartscan: SmartScan, assigned: str) -> None:
    script = Script(f"spm.{assigned}", smartscan.names, smartscan.ask)
    with pytest.raises(ScriptFailed, match="is no object"):
        run_on(script)


# --- scripts that loop ---

LOOP = "while (true) { try { spm.zscanner.pos; } catch (e) {} }"


def test_looping_script_takes_turns_with_others(smartscan: SmartScan) -> None:
    script = Script(LOOP, smartscan.names, smartscan.ask, at_once_s=0.01)
    assert script.step() is None
    assert script.step() is None
    script.end()


def test_script_whose_client_has_gone_is_ended_after_some_requests(smartscan: SmartScan) -> None:
    asked: list[str] = []
    has_gone = False

    def ask(kind: str, path: str, given: list[object]) -> object:
        nonlocal has_gone
        asked.append(path)
        has_gone = len(asked) >= 100
        return smartscan.ask(kind, path, given)

    script = Script(LOOP, smartscan.names, ask, is_alone=lambda: has_gone)
    with pytest.raises(ScriptFailed, match="its client has gone"):
        run_on(script)
    assert len(asked) == 100 + MOST_ALONE


def connect(context: zmq.Context[Any], address: str) -> zmq.Socket[bytes]:
    client: zmq.Socket[bytes] = context.socket(zmq.REQ)
    client.setsockopt(zmq.LINGER, 0)
    client.setsockopt(zmq.RCVTIMEO, int(DEADLINE_S * 1000))
    client.connect(address)
    return client


def evaluated(client: zmq.Socket[bytes], source: str) -> str:
    client.send_json({"jsonrpc": "2.0", "method": "js_cmd", "params": source, "id": 1})
    reply = client.recv_json()
    assert isinstance(reply, dict)
    return str(reply.get("value"))


def test_other_clients_are_answered_beside_a_looping_script_which_ends_with_its_client(tmp_path: Path) -> None:
    with (
        ParkEmulator(seed=2).running(tmp_path / "data") as address,
        zmq.Context() as context,
        connect(context, address) as other,
    ):
        with connect(context, address) as looping:
            looping.send_json({"jsonrpc": "2.0", "method": "js_cmd", "params": LOOP, "id": 1})
            while not is_running(other):
                pass
            assert evaluated(other, "1 + 1") == "2"
            assert is_running(other)
        while is_running(other):
            pass


def is_running(client: zmq.Socket[bytes]) -> bool:
    client.send_json({"jsonrpc": "2.0", "method": "js_run", "params": "None", "id": 1})
    return client.recv_json() == {"jsonrpc": "2.0", "result": "true", "id": 1}


def test_emulator_stops_beside_a_looping_script(tmp_path: Path) -> None:
    with zmq.Context() as context:
        with ParkEmulator(seed=2).running(tmp_path / "data") as address:
            looping, other = connect(context, address), connect(context, address)
            looping.send_json({"jsonrpc": "2.0", "method": "js_cmd", "params": LOOP, "id": 1})
            while not is_running(other):
                pass
        looping.close()
        other.close()
