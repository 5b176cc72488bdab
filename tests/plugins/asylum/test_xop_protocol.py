"""The emulated ZeroMQ-XOP against its reference calls, with plain ZeroMQ clients."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from deadlines import DEADLINE_S
from tests.plugins.asylum.igor_test_functions import WithTestFunctions

from afspm.basics import ExperimentClock
from afspm.plugins.asylum import xop
from afspm.plugins.asylum.emulator import AsylumEmulator
from afspm.simulation.faults import Fault

CALLS = json.loads(Path(__file__).with_name("xop_calls.json").read_text())
PATIENCE_MS = 10_000
SILENCE_MS = 300


class Client:
    """A plain DEALER."""

    def __init__(self, address: str, kind: int = zmq.DEALER) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self.socket = self._context.socket(kind)
        self.socket.setsockopt(zmq.RCVTIMEO, PATIENCE_MS)
        self.socket.connect(address)

    def send(self, message: bytes | dict[str, Any]) -> None:
        payload = message if isinstance(message, bytes) else json.dumps(message).encode()
        self.socket.send_multipart([b"", payload] if self.socket.type == zmq.DEALER else [payload])

    def receive(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.socket.recv_multipart()[-1])
        return found

    def ask(self, message: bytes | dict[str, Any]) -> dict[str, Any]:
        self.send(message)
        return self.receive()

    def call(self, name: str, *parameters: Any, message_id: str = "1") -> dict[str, Any]:
        return self.ask(called(name, *parameters, message_id=message_id))

    def silent(self) -> bool:
        return not self.socket.poll(SILENCE_MS)

    def close(self) -> None:
        self._context.destroy(linger=0)


def called(name: str, *parameters: Any, message_id: str = "1") -> dict[str, Any]:
    function = {"name": name, "params": list(parameters)} if parameters else {"name": name}
    return {"version": 1, "messageID": message_id, "CallFunction": function}


@pytest.fixture
def igor() -> WithTestFunctions:
    return WithTestFunctions(port=0)


@pytest.fixture
def address(igor: WithTestFunctions, tmp_path: Path) -> Iterator[str]:
    with igor.running(tmp_path) as address:
        yield address


@pytest.fixture
def client(address: str) -> Iterator[Client]:
    made = Client(address)
    yield made
    made.close()


def values(reply: dict[str, Any]) -> list[Any]:
    """Return all values in a reply."""
    result = reply.get("result", [])
    told = [*(result if isinstance(result, list) else [result]), *reply.get("passByReference", [])]
    return [reply.get("messageID"), *(str(one["value"]) for one in told)]


@pytest.mark.parametrize("case", CALLS, ids=lambda case: case["name"])
def test_reference_calls(client: Client, case: dict[str, Any]) -> None:
    if case["msg"] is None:
        reply = client.call("TestFunctionNoArgs", message_id="x" * 256)
        assert reply["errorCode"]["value"] == 7
        return
    reply = client.ask(case["msg"].encode())
    assert reply["errorCode"]["value"] == case["expect_code"]
    assert ("msg" in reply["errorCode"]) is (case["expect_code"] != 0)
    for expected in case.get("expected_values", []):
        wanted = "3" if expected == "1 + 2" else expected.strip('"')
        assert wanted in values(reply)
    if "expected_result" in case:
        told = reply["result"]["value"]
        wanted = float(case["expected_result"])
        assert told == (wanted if math.isfinite(wanted) else str(wanted))  # JSON has no NaN, and no infinity
    assert xop.reply(json.dumps(reply).encode()).error is None or case["expect_code"]


@pytest.mark.parametrize("top", [b"[1]", b"4711", b"null", b'"text"', b"[]"])
def test_json_without_an_object_has_no_version(client: Client, top: bytes) -> None:
    assert client.ask(top)["errorCode"]["value"] == 4


@pytest.mark.parametrize("number", ["1e400", "-1e400", "9" * 400])
def test_numbers_out_of_range_are_malformed_json(client: Client, number: str) -> None:
    message = json.dumps(called("GV", 7)).replace("7]", f"{number}]").encode()
    assert client.ask(message)["errorCode"]["value"] == 3


def test_lone_surrogate_is_malformed_json(client: Client) -> None:
    for where in ("messageID", "name", "params"):
        message = {
            "messageID": called("GV", "a", message_id="\ud800"),
            "name": called("\udc00"),
            "params": called("GV", "\ud800"),
        }[where]
        assert client.ask(json.dumps(message).encode()) == {
            "errorCode": {"value": 3, "msg": "The string is not a valid json object."}
        }


def test_byte_order_mark_and_text_after_nul_are_ignored(client: Client) -> None:
    message = json.dumps(called("TestFunction1Arg", 1)).encode()
    for payload in (b"\xef\xbb\xbf" + message, message + b"\0", message + b"\0 {"):
        assert client.ask(payload)["result"]["value"] == 1


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0x10", 16), ("0x1.8p1", 3), (" 1", 1), ("+.5", 0.5), ("infinity", "inf"), ("-INF", "-inf"), ("nan(7)", "nan"),
        ("", 0), ("1 ", None), (" ", None), ("1.a", None), ("0x", None), ("+", None), ("1_000", None), ("\u0661", None),
    ],
)  # fmt: skip
def test_numbers_are_read_as_strtod_reads_them(client: Client, text: str, value: Any) -> None:
    reply = client.call("TestFunction1Arg", text)
    assert reply["errorCode"]["value"] == (106 if value is None else 0)
    assert value is None or reply["result"]["value"] == value


def test_errors_are_checked_in_the_xops_order(client: Client) -> None:
    # Number of parameters, then numbers, then result types, then parameter types.
    for name, parameters, error in (
        ("TestFunctionVariableAndWave", ("1.a",), 102),
        ("TestFunctionVariableAndWave", ("1.a", 1), 106),
        ("TestFunctionVariableAndWave", ("1", 1), 104),
        ("TestFunctionWaveForComplex", (1,), 105),
    ):
        assert client.call(name, *parameters)["errorCode"]["value"] == error
    nameless = client.call("")
    assert nameless["errorCode"]["value"] == 101
    assert "messageID" not in nameless


def test_single_result_of_a_multi_return_function_is_a_list(client: Client) -> None:
    assert client.call("TestFunctionOneResultListed")["result"] == [{"type": "variable", "value": 123}]


def test_failing_function_is_aborted_and_igor_stays(client: Client) -> None:
    reply = client.call("TestFunctionBreaks")
    assert reply["errorCode"]["value"] == 107
    assert "division by zero" in reply["history"]
    assert client.call("TestFunctionNoArgs")["errorCode"]["value"] == 0


@pytest.mark.parametrize(
    "put",
    [
        ("AmplitudeSetpointVolts", 0), ("AmplitudeSetpointVolts", -1), ("IntegralGain", -10), ("TipVoltage", "nan"),
        ("ScanRate", 0), ("ScanLines", 0), ("ScanPoints", -5), ("ScanSize", 0), ("FastRatio;SlowRatio", 0),
        ("SlowRatio", -1), ("ScanSize", "nan"), ("XOffset", "inf"),
    ],
    ids=str,
)  # fmt: skip
def test_impossible_scan_is_interrupted(igor: WithTestFunctions, client: Client, put: tuple[str, Any]) -> None:
    client.call("PV", *put)
    assert client.call("DoScanFunc", "DoScan")["errorCode"]["value"] == 0
    while client.call("GV", "ScanStatus")["result"]["value"]:
        pass
    assert igor.rig.scan is None


def test_any_put_value_leaves_names_and_numbers_intact(client: Client, tmp_path: Path) -> None:
    client.call("PV", "BaseSuffix", "nan")
    client.call("PS", "BaseName", "../nul\0\\out")
    assert client.call("ARCheckSuffix")["errorCode"]["value"] == 0
    client.call("PV", "ForceSpotNumber", 7)
    assert client.call("GoToSpot")["errorCode"]["value"] == 107
    assert client.call("GV", "ScanSize")["errorCode"]["value"] == 0


def test_translators_requests_are_valid_for_the_xop(client: Client) -> None:
    reply = client.ask(xop.request("TestFunctionStrVarStr", ["1", 2.0, "é"], "é7"))
    assert reply == {"errorCode": {"value": 0}, "messageID": "é7", "result": {"type": "string", "value": "1_2_é"}}


def test_early_errors_are_replied_without_an_id(client: Client) -> None:
    message = called("TestFunctionNoArgs") | {"version": 2}
    assert "messageID" not in client.ask(message)
    assert client.call("NoSuchFunction")["messageID"] == "1"


def test_igor_ignores_case(client: Client) -> None:
    assert client.call("gv", "SCANSIZE")["result"]["value"] == 1e-06
    assert client.call("GV", "NoSuchValue")["result"]["value"] == "nan"


def test_request_of_1024_bytes_is_answered_and_a_longer_one_lost(client: Client) -> None:
    spare = 1024 - len(json.dumps(called("TestFunctionStrVarStr", "", 1, "")))
    assert client.call("TestFunctionStrVarStr", "x" * spare, 1, "")["errorCode"]["value"] == 0
    client.send(called("TestFunctionStrVarStr", "x" * (spare + 1), 1, ""))
    assert client.silent()
    assert client.call("TestFunction1Arg", 4)["result"]["value"] == 4, "connected again by itself"


def test_req_socket_works_until_a_reply_is_lost(address: str) -> None:
    client = Client(address, zmq.REQ)
    assert client.call("TestFunction1Arg", 4)["result"]["value"] == 4
    client.send(called("TestNotUtf8"))
    assert client.silent(), "a text that is not UTF-8 has no reply"
    with pytest.raises(zmq.ZMQError):
        client.send(called("TestFunction1Arg", 4))
    client.close()


@pytest.mark.parametrize("correlated", [True, False])
def test_request_with_wrong_frames_has_no_reply(address: str, correlated: bool) -> None:
    client = Client(address, zmq.REQ if correlated else zmq.DEALER)
    if correlated:
        client.socket.setsockopt(zmq.REQ_CORRELATE, 1)
        client.send(called("TestFunctionNoArgs"))
    else:
        client.socket.send(json.dumps(called("TestFunctionNoArgs")).encode())
    assert client.silent()
    client.close()


def test_busy_igor_rejects_malformed_requests_at_once_and_queues_others(tmp_path: Path) -> None:
    igor = WithTestFunctions(port=0, faults=[Fault("busy", 0.0, 1, 1.0)])
    with igor.running(tmp_path, ExperimentClock.starting_now()) as address:
        client = Client(address)
        client.send(called("TestFunction1Arg", 4))
        client.send(b"not JSON")
        assert client.receive()["errorCode"]["value"] == 3
        assert client.receive()["result"]["value"] == 4
        client.close()


def test_dialog_opened_by_a_function_blocks_all_clients(client: Client) -> None:
    client.send(called("DoScanFunc", "NoSuchButton"))
    assert client.silent()
    client.send(called("TestFunction1Arg", 4))
    client.send(b"not JSON")
    assert client.silent()


def test_dialog_opened_by_a_function_can_be_closed(client: Client, tmp_path: Path) -> None:
    client.send(called("DoScanFunc", "Blah"))
    assert client.silent()
    client.send(called("TestFunction1Arg", 4, message_id="2"))
    button = tmp_path / "delete-to-press-OK.txt"
    assert "Something called DoScanFunc with an invalid CtrlName 'Blah'" in button.read_text(encoding="utf-8")
    button.unlink()
    assert client.receive()["result"]["value"] == 1, "as DoScanFunc gives after the dialog"
    assert client.receive()["messageID"] == "2", "then Igor does what was asked meanwhile"
    assert client.call("GV", "ScanStatus")["result"]["value"] == 0
    client.send(called("DoScanFunc", "Blah"))
    assert client.silent(), "the next dialog has a button of its own"
    assert button.exists()


def test_dialog_that_lasts_for_a_while_can_be_closed_before(tmp_path: Path) -> None:
    faults = [Fault("dialog", 0.0, 1, 1e6), Fault("dialog", 0.0, 1, 0.3)]
    with WithTestFunctions(port=0, faults=faults).running(tmp_path, ExperimentClock.starting_now()) as address:
        client, button = Client(address), tmp_path / "delete-to-press-OK.txt"
        client.send(called("TestFunction1Arg", 4))
        assert client.silent()
        button.unlink()
        assert client.receive()["result"]["value"] == 4
        assert client.call("TestFunction1Arg", 5)["result"]["value"] == 5, "after 0.3 s"
        assert client.call("TestFunction1Arg", 6)["result"]["value"] == 6
        assert not button.exists()
        client.close()


def test_command_is_cut_from_a_buttons_name(client: Client, igor: WithTestFunctions) -> None:
    assert client.call("DoScanFunc", "DownScanButton_3")["result"]["value"] == 0
    assert client.call("GV", "ScanStatus")["result"]["value"] == 1, "at once, though it begins later"
    assert client.call("GV", "ScanDown")["result"]["value"] == 1
    assert client.call("DoScanFunc", "StopScanButton")["result"]["value"] == 0
    assert client.call("GV", "ScanStatus")["result"]["value"] == 0
    assert client.call("DoForceFunc", "NoSuchForce")["result"]["value"] == 1


def test_do_force_func_returns_nan_for_a_start_and_zero_for_a_refusal(client: Client) -> None:
    assert client.call("DoForceFunc", "SingleForce")["result"]["value"] == "nan"
    assert client.call("ARGetStatus")["result"]["value"] & 0x10
    assert client.call("DoForceFunc", "SingleForce")["result"]["value"] == 0


def test_spots_exist_after_their_initialisation(client: Client) -> None:
    failed = client.call("SetProbePosX", 1e-7)
    assert failed["errorCode"]["value"] == 107
    assert "Index out of range" in failed["history"]
    assert client.call("InitProbePos")["errorCode"]["value"] == 0
    assert client.call("SetProbePosX", 1e-7)["errorCode"]["value"] == 0
    assert client.call("GetProbePosX")["result"]["value"] == 1e-7


@pytest.mark.parametrize(("procedures", "missing"), [("none", "GetBaseName"), ("spots", "AfspmLook")])
def test_procedures_not_included_are_missing(tmp_path: Path, procedures: str, missing: str) -> None:
    igor = WithTestFunctions(port=0, procedures=procedures)
    with igor.running(tmp_path) as address:
        client = Client(address)
        assert client.call(missing)["errorCode"]["value"] == 101
        client.close()


def test_files_are_read_by_igor2(tmp_path: Path) -> None:
    binarywave = pytest.importorskip("igor2.binarywave")
    igor = WithTestFunctions(port=0, noise={"white_m": 0.0})
    clock = ExperimentClock.starting_now(speed=200.0)
    with igor.running(tmp_path, clock) as address:
        client = Client(address)
        for name, value in (("ScanPoints", 16), ("ScanLines", 8), ("SlowRatio", 0.5), ("LastScan", 1)):
            client.call("PV", name, value)
        client.call("DoScanFunc", "UpScan")
        path = tmp_path / "Image0000.ibw"
        deadline_s = clock.monotonic_s() + DEADLINE_S
        while client.call("GV", "ScanStatus")["result"]["value"] and clock.monotonic_s() < deadline_s:
            pass
        while clock.monotonic_s() < deadline_s:
            try:
                wave = binarywave.load(str(path))["wave"]
                break
            except Exception:  # not there, or not whole
                continue
        client.close()
    assert wave["bin_header"]["noteSize"] == len(wave["note"])
    assert wave["wData"].shape == (16, 8, len(igor.rig.channels))
    assert wave["labels"][2][1:3] == [b"HeightTrace", b"HeightRetrace"]
    assert igor.rig.scan is not None
    drawn = igor.rig.scan.channels()["Height"][1]
    np.testing.assert_allclose(wave["wData"][:, :, 0].T, drawn, rtol=1e-6)
    note = wave["note"].split(b"\r")
    assert b"FastScanSize: 1e-06" in note
    assert b"SlowScanSize: 5e-07" in note
    assert b"StartHeadTemp: 32.125 \xb0C" in note, "which is not UTF-8, as in real files"
    np.testing.assert_allclose(wave["wave_header"]["sfA"][:2], [1e-6 / 15, 0.5e-6 / 7])


@pytest.mark.parametrize("reads", ["off", "on"])
def test_feedback_is_held_until_after_the_end_of_a_force_curve(tmp_path: Path, reads: str) -> None:
    emulator = AsylumEmulator(port=0, feedback={"hold_s": 20.0, "hold_reads": reads})
    clock = ExperimentClock.starting_now(speed=20.0)
    with emulator.running(tmp_path, clock) as address, closing(Client(address)) as client:

        def number(name: str) -> int:
            return int(client.call(name)["result"]["value"])

        def until(holds: Callable[[], bool]) -> None:
            deadline_s = clock.monotonic_s() + DEADLINE_S
            while not holds():
                assert clock.monotonic_s() < deadline_s

        assert number("AfspmFeedbackOn")
        client.call("DoForceFunc", "SingleForce_0")
        assert number("ARGetStatus") & 0x10
        until(lambda: not number("ARGetStatus") & 0x10)
        assert number("AfspmFeedbackOn") == (reads == "on")
        assert emulator.rig.is_held(clock.now_s())
        until(lambda: not emulator.rig.is_held(clock.now_s()))
        assert number("AfspmFeedbackOn")


def test_values_of_the_panel_are_in_force_at_once(tmp_path: Path) -> None:
    emulator = AsylumEmulator(port=0)
    with emulator.running(tmp_path) as address, closing(Client(address)) as client:
        for name, value in (("TipVoltage", 0.5), ("IntegralGain", 12.0), ("AmplitudeSetpointVolts", 0.6)):
            client.call("PV", name, value)
        setup = emulator.rig.setup
        assert (setup.bias_v, setup.feedback.integral_gain, setup.feedback.setpoint) == (0.5, 1800.0, 0.6)
        client.call("PV", "TipVoltage", "nan")
        assert setup.bias_v == 0.5
