"""Both links to GXSM, with arbitrary or no answers."""

from __future__ import annotations

import json
import math
import os
import pickle
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.plugins.vendor_bench import answering

from afspm.basics import ConfigError
from afspm.driver import ControllerLost
from afspm.plugins.gxsm import bridge, pickles
from afspm.plugins.gxsm.activity import LineWatch
from afspm.plugins.gxsm.bridge_client import BridgeLink
from afspm.plugins.gxsm.errors import BadReply, GxsmError
from afspm.plugins.gxsm.hardware import Doing, Hardware, decoded, recognised
from afspm.plugins.gxsm.link import Address, Asking, open_link
from afspm.plugins.gxsm.settings import ANGSTROM_M, ScanFrame

VALUES: list[Any] = [
    1.5, -3, 10**30, -math.inf, "12.5 Å    ", "", (), (1, 2, "x"), [1, [2]], {"a": 1}, None, True,
    ("RangeX", "RangeY"), np.float64(2.5), tuple(f"name-{i}" for i in range(300)),
]  # fmt: skip
ARRAYS = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(4, dtype=">f4"),
    np.zeros((0, 3)),
    np.arange(5, dtype="<i4"),
]


on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="shared memory as Linux has it")

# --- pickles ---


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_values_are_read_as_they_were_pickled(protocol: int) -> None:
    for value in VALUES:
        if not isinstance(value, np.float64) or protocol > 2:
            assert pickles.loads(pickle.dumps(value, protocol)) == value


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("array", ARRAYS)
def test_arrays_are_read_alone_and_in_a_tuple(protocol: int, array: np.ndarray) -> None:
    content = pickle.dumps((array, ["Bias"], (1.0, 2.0)), protocol)
    whole = pickles.loads(content)
    assert isinstance(whole, tuple)
    for found in (
        pickles.loads(pickle.dumps(array, protocol)),
        whole[0],
        pickles.loads(content.replace(b"numpy._core", b"numpy.core")) if protocol == 3 else (array,),
    ):
        one = found[0] if isinstance(found, tuple) else found
        assert isinstance(one, np.ndarray)
        assert one.dtype == array.dtype
        np.testing.assert_array_equal(one, array)


def test_arrays_of_the_numpy_that_gxsm_has_are_read() -> None:
    # numpy 1, which GXSM has and afspm may have, has other module names; their lengths are in the bytes
    written = pickle.dumps(np.arange(3.0), 4)
    name, older_name = b"numpy._core.multiarray", b"numpy.core.multiarray"
    older = written.replace(bytes([len(name)]) + name, bytes([len(older_name)]) + older_name)
    assert older_name in older
    np.testing.assert_array_equal(pickles.loads(older), np.arange(3.0))


class _Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("evil",)


@pytest.mark.parametrize(
    "content",
    [
        *(pickle.dumps(_Evil(), protocol) for protocol in range(6)),
        pickle.dumps(os.system),
        pickle.dumps(np.array([object], dtype=object)),
        pickle.dumps(np.dtype("O")),
        pickle.dumps({1, 2}),
        pickle.dumps(1 + 2j),
        b"",
        b"\x80\x04.",
        b"\x80\x04N",
        b"\x80\x04]\x94h\x00a",
        b"\x80\x04h\xff.",
        b"\x80\x04\x8c\x05numpy\x8c\x07ndarray\x93.",
        b"\x80\x04(\x8c\x05numpy\x8c\x05dtype\x93)R.",
    ],
)
def test_pickle_of_no_value_is_refused_and_not_executed(content: bytes, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadReply):
        pickles.loads(content)
    assert not list(tmp_path.iterdir())


def test_self_containing_list_is_refused() -> None:
    ten_of = (b"(" + (b"h" + bytes([i])) * 10 + b"t\x94" for i in range(30))
    laughs = b"\x80\x04]\x94" + b"".join(ten_of)
    with pytest.raises(BadReply):
        pickles.loads(laughs + b".")
    itself: list[Any] = []
    itself.append(itself)
    with pytest.raises(BadReply):
        pickles.loads(pickle.dumps(itself))


GOOD = [pickle.dumps(value, 4) for value in (*VALUES[:-1], *ARRAYS, (ARRAYS[0], ["a"], ["b"], (1.0, 2.0)))]


@given(st.binary(max_size=80))
@settings(max_examples=300)
def test_any_bytes_are_a_value_or_refused(content: bytes) -> None:
    for whole in (content, b"\x80\x04" + content + b"."):
        with suppress(BadReply):
            pickles.loads(whole)


@given(st.sampled_from(GOOD), st.integers(0, 10_000), st.binary(min_size=1, max_size=6), st.booleans())
@settings(max_examples=400)
def test_damaged_pickles_are_a_value_or_refused(content: bytes, at: int, damage: bytes, cut: bool) -> None:
    at %= len(content)
    with suppress(BadReply):
        pickles.loads(content[:at] + damage + (b"" if cut else content[at + len(damage) :]))


# --- the bridge ---


@contextmanager
def talking(*replies: bytes, silent: bool = False) -> Iterator[BridgeLink]:
    """Open a link to a bridge that answers each call with the next of some bytes, and may then disconnect."""
    secret = Path("~/secret").expanduser()
    secret.write_text("s" * 64)
    secret.chmod(0o600)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        answers = Thread(target=_answer, args=(listener, secret.read_bytes(), replies, silent))
        answers.start()
        link = BridgeLink(listener.getsockname(), 0.3 if silent else 10.0, time.monotonic, secret)
        try:
            yield link
        finally:
            link.close()
            answers.join()


def _answer(listener: socket.socket, known: bytes, replies: tuple[bytes, ...], silent: bool) -> None:
    client, _ = listener.accept()
    with client, client.makefile("rb") as lines, suppress(OSError):
        introduction = bridge.Introduction(known, "{}:{}".format(*client.getsockname()))
        for _ in range(2):
            client.sendall(introduction.reply(bridge.parsed(lines.readline())).encode() + b"\n")
        for reply in replies:
            lines.readline()
            client.sendall(reply)
        client.settimeout(DEADLINE_S)
        while silent and client.recv(1000):
            pass


def test_an_error_in_gxsm_leaves_the_connection_as_it_is() -> None:
    with talking(b'{"error": "SystemError: no"}\n', b'{"value": -Infinity}\n') as link:
        with pytest.raises(GxsmError, match="get: SystemError: no"):
            link.call("get", "nonsense")
        assert link.call("get", "nonsense") == -math.inf


@pytest.mark.parametrize(
    "reply",
    [
        b"\n",
        b"{}\n",
        b"[1]\n",
        b'{"value": 1, "error": "x"}\n',
        b'{"value": 1}\n{"value": 2}\n',
        b"\xff\xfe\n",
        b'{"value": {"array": "|O", "shape": [1], "bytes": "AAAA"}}\n',
        b'{"value": {"array": "<f8", "shape": [2], "bytes": "AAAA"}}\n',
        b'{"value": {"array": "<f8", "shape": [-1], "bytes": ""}}\n',
        b'{"value": {"array": "<f8", "shape": [1], "bytes": "%%%"}}\n',
        b"[" * 100_000 + b"\n",
    ],
)
def test_malformed_answer_ends_the_link(reply: bytes) -> None:
    with talking(reply, b'{"value": 1}\n') as link:
        with pytest.raises(BadReply):
            link.call("y_current")
        with pytest.raises(ControllerLost, match="the connection was lost"):
            link.call("y_current")


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        (b"", "the connection was closed"),
        (b'{"error": "JSONDecodeError: x"}\n', "JSONDecodeError: x"),
        (b'{"value": "afspm bridge"}\n', "the bridge is of another version"),
        (b'{"value": ["0", "\\ud800"]}\n', "does not know the bridge's secret"),
    ],
)
def test_a_program_in_place_of_the_bridge_is_refused(tmp_path: Path, reply: bytes, reason: str) -> None:
    secret = tmp_path / "secret"
    secret.write_text("x" * 64)
    secret.chmod(0o600)
    with pytest.raises(ControllerLost, match=reason), answering(reply) as address:
        BridgeLink(address, 10.0, time.monotonic, secret).call("get", "RangeX")


def test_a_missing_secret_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ControllerLost, match="the bridge's secret can't be read"), answering() as address:
        BridgeLink(address, 10.0, time.monotonic, tmp_path / "secret").call("get", "RangeX")


@pytest.mark.skipif(os.name == "nt", reason="permissions as Unix has them")
def test_readable_secret_is_refused(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("x" * 64)
    secret.chmod(0o644)
    with pytest.raises(ControllerLost, match="other users can read"), answering(b"") as address:
        BridgeLink(address, 10.0, time.monotonic, secret).call("get", "RangeX")


@pytest.mark.parametrize("part", [0, 1, 5, 11])
@pytest.mark.parametrize("silent", [False, True])
def test_truncated_answer_is_noticed_in_time(part: int, silent: bool) -> None:
    with (
        talking(b'{"value": 1}\n'[:part], silent=silent) as link,
        pytest.raises(ControllerLost, match="no answer to get within" if silent else "closed after"),
    ):
        link.call("get", "RangeX")


@given(st.binary(max_size=120), st.booleans())
@settings(max_examples=60)
def test_any_bytes_are_an_answer_or_a_named_error(content: bytes, as_value: bool) -> None:
    reply = b'{"value": ' + content + b"}\n" if as_value else content + b"\n"
    with talking(reply) as link, suppress(ControllerLost, GxsmError):
        link.call("get", "RangeX")


@given(st.recursive(st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(), st.lists, max_leaves=8))
@settings(max_examples=40)
def test_any_value_survives_the_bridge(value: Any) -> None:
    with talking(json.dumps({"value": value}).encode() + b"\n") as link:
        assert link.call("get", "RangeX") == value


# --- addresses and processes ---


@pytest.mark.parametrize("text", ["", "nonsense", "host:", ":65431", "127.0.0.1:port", "shm:a/b"])
def test_malformed_address_is_a_config_error(text: str) -> None:
    with pytest.raises(ConfigError):
        Address.parse(text)


def test_addresses() -> None:
    assert Address.parse("127.0.0.1:65431") == Address(host="127.0.0.1", port=65431)
    assert Address.parse("shm") == Address(block="gxsm4_py_shm_data_block", process="gxsm4")
    assert Address.parse("shm:@123") == Address(block="gxsm4_py_shm_data_block", process="123")
    assert Address.parse("shm:mine@other") == Address(block="mine", process="other")


def test_refused_connection_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ControllerLost, match=r"is bridge.py running in GXSM's console\?"):
        open_link(Address(host="127.0.0.1", port=port), 1.0, time.monotonic)


@on_linux
def test_unknown_process_is_reported() -> None:
    with pytest.raises(ControllerLost, match="no process is called 'no-such-gxsm'"):
        open_link(Address.parse("shm:nothing@no-such-gxsm"), 1.0, time.monotonic)


@on_linux
def test_a_process_that_the_signal_would_end_is_never_signalled() -> None:
    # A GXSM started with -s, or another program of the same name.
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        with pytest.raises(ControllerLost, match="does not serve its shared memory"):
            open_link(Address.parse(f"shm:nothing@{process.pid}"), 1.0, time.monotonic)
        assert process.poll() is None


def test_shared_memory_is_for_linux_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(ConfigError, match=r"run bridge\.py in GXSM's console"):
        open_link(Address.parse("shm"), 1.0, time.monotonic)


@pytest.fixture
def block() -> Iterator[Path]:
    if not sys.platform.startswith("linux"):
        pytest.skip("shared memory as Linux has it")
    path = Path("/dev/shm", f"afspm_test_block_{os.getpid()}")
    path.write_bytes(bytes(16_777_344))
    yield path
    path.unlink()


LISTENS = "import signal; signal.signal(signal.SIGUSR1, lambda *_: None); print(flush=True); input()"


def test_silent_memory_is_given_up(block: Path) -> None:
    command = [sys.executable, "-c", LISTENS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        address = Address.parse(f"shm:{block.name}@{process.pid}")
        with pytest.raises(ControllerLost, match=r"no answer to get within 0\.2 s"):
            open_link(address, 0.2, time.monotonic).call("get", "RangeX")
        again = open_link(address, 0.2, time.monotonic)
        with pytest.raises(ControllerLost, match="busy with an earlier call of 'get'"):
            again.call("set", "RangeX", "1")
        assert block.read_bytes()[:4] == b"get\0", "nothing was written over it"
        process.kill()
        process.wait()
        with pytest.raises(ControllerLost, match="no process is called"):
            open_link(address, 0.2, time.monotonic)


def status(block: Path) -> int:
    return int.from_bytes(block.read_bytes()[100:108], "little", signed=True)


def test_request_left_to_an_ended_gxsm_is_withdrawn(block: Path) -> None:
    # The next GXSM does not clear the memory: every call would wait for that answer.
    command = [sys.executable, "-c", LISTENS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        address = Address.parse(f"shm:{block.name}@{process.pid}")
        link = open_link(address, 0.2, time.monotonic)
        process.kill()
        process.wait()
        with pytest.raises(ControllerLost, match="has ended"):
            link.call("get", "RangeX")
        assert block.read_bytes()[:4] == bytes(4), "nothing was asked"
        assert status(block) == 0
    with block.open("r+b") as file:
        file.seek(100)
        file.write((1).to_bytes(8, "little"))
    with pytest.raises(ControllerLost, match="no process is called"):
        open_link(address, 0.2, time.monotonic)
    assert status(block) == 0, "a request of an earlier caller"


def test_a_gxsm_that_ends_during_a_call_is_noticed_at_once(block: Path) -> None:
    ends = LISTENS.replace("lambda *_: None", "lambda *_: __import__('os')._exit(1)")
    with subprocess.Popen([sys.executable, "-c", ends], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        link = open_link(Address.parse(f"shm:{block.name}@{process.pid}"), 60.0, time.monotonic)
        with pytest.raises(ControllerLost, match="Gxsm4 has ended"):
            link.call("get", "RangeX")
        assert status(block) == 0


CALLS = """
import sys, time
from afspm.plugins.gxsm.link import Address, open_link
open_link(Address.parse(sys.argv[1]), float(sys.argv[2]), time.monotonic).call("get", "RangeX")
"""


@pytest.mark.parametrize("named", ["", "of-all-callers.lock"])
def test_callers_with_other_temporary_folders_share_one_lock(block: Path, tmp_path: Path, named: str) -> None:
    # results R7
    lock = str(tmp_path / named) if named else ""

    def caller(timeout_s: float, folder: Path) -> subprocess.Popen[bytes]:
        folder.mkdir()
        command = [sys.executable, "-c", CALLS, f"shm:{block.name}@{gxsm.pid}", str(timeout_s)]
        environment = {**os.environ, "GXSM_PYSHM_LOCK_FILE": lock, "TMPDIR": str(folder)}
        return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)

    shows = [sys.executable, "-c", LISTENS.replace("lambda *_: None", "lambda *_: print(flush=True)")]
    with subprocess.Popen(shows, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as gxsm:
        assert gxsm.stdout is not None
        gxsm.stdout.readline()
        with caller(DEADLINE_S, tmp_path / "a") as first:
            gxsm.stdout.readline()  # the first caller waits for its answer, and holds the lock
            with caller(0.2, tmp_path / "b") as second:
                complaint = second.communicate()[1].decode()
            first.kill()
        gxsm.kill()
    assert f"{lock or '/tmp/gxsm4_pyshm_transaction.lock'}: another program keeps GXSM's shared memory" in complaint


def test_too_small_memory_is_refused(block: Path) -> None:
    block.write_bytes(bytes(1000))
    command = [sys.executable, "-c", LISTENS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(ControllerLost, match="too small"):
            open_link(Address.parse(f"shm:{block.name}@{process.pid}"), 1.0, time.monotonic)


# --- hardware ---


def test_hardware_is_known_by_its_names() -> None:
    common = {"RangeX", "dsp-fbs-bias"}
    assert recognised(common, set()) is Hardware.SRANGER
    assert recognised({*common, "dsp-gvp-du00"}, set()) is Hardware.SRANGER
    assert recognised({*common, "dsp-GVP-VPJR"}, set()) is Hardware.RPSPMC
    assert recognised(common, {"GVP_CMD_UP_Z0"}) is Hardware.RPSPMC
    assert recognised({"RangeX", "sim-stm-bias"}, set()) is Hardware.SIMULATOR


def test_status_bits_depend_on_the_hardware() -> None:
    free = Doing(True, scanning=False, probing=False, paused=False, moving=False, approaching=False)
    assert decoded(Hardware.SRANGER, [1.0, 6.9e-310]) == free
    assert decoded(Hardware.RPSPMC, [17.0]) == free, "16: a program has ended"
    assert decoded(Hardware.SRANGER, [17.0]).moving
    assert decoded(Hardware.SRANGER, [9.0]).probing
    assert not decoded(Hardware.SRANGER, [9.0]).scanning
    assert decoded(Hardware.SRANGER, [129.0]).approaching
    assert decoded(Hardware.RPSPMC, [3.0]).measuring
    assert not decoded(Hardware.SRANGER, [9.0]).paused


@pytest.mark.parametrize("slots", [[], [math.nan], [-1.0], [6.9e-310], [1.5], [math.inf], [1e300]])
def test_uninitialised_memory_is_no_set_of_bits(slots: list[float]) -> None:
    with pytest.raises(BadReply):
        decoded(Hardware.SRANGER, slots)


# --- lines ---


@pytest.mark.parametrize(
    ("lines", "turns"),
    [
        ([119, -296, 0, 1, 5, 30, 59], 0),
        ([119, 0, 1, 30, 59, 59, 0], 1),
        ([30, 31, 40, 3, 7, 50, 2], 2),
        ([0, 59, 58, 30, 1, 0], 0),
        ([0, 59, 58, 30, 57, 40], 1),
        ([12] * 5, 0),
    ],
    ids=["down", "down-again", "found-running", "up", "up-again", "still"],
)
def test_lines_against_their_direction_belong_to_another_scan(lines: list[int], turns: int) -> None:
    watch = LineWatch(lines[0])
    assert sum(watch.turned(line, 60) for line in lines[1:]) == turns


class Targetless:
    """A GXSM with a frame of 1000 x 1000 Å about (200, 100) Å, and no usable target of the tip."""

    def __init__(self, target: float | Exception) -> None:
        self.target = target

    def call(self, method: str, *arguments: str | int | float) -> Any:
        ref = str(arguments[0])
        if ref in ("ScanX", "ScanY"):
            if isinstance(self.target, Exception):
                raise self.target
            return self.target
        return {
            "PointsX": 8.0,
            "PointsY": 8.0,
            "RangeX": 1000.0,
            "RangeY": 1000.0,
            "OffsetX": 200.0,
            "OffsetY": 100.0,
        }.get(ref, 0.0)

    def working_folder(self) -> Path | None:
        return None

    def close(self) -> None: ...


@pytest.mark.parametrize("target", [math.nan, GxsmError("no such entry")], ids=["nan", "refused"])
def test_missing_target_of_the_tip_is_the_centre_of_the_frame(target: float | Exception) -> None:
    frame = ScanFrame(Asking(Targetless(target)), ANGSTROM_M)
    assert frame.tip() == pytest.approx((200.0 * ANGSTROM_M, 100.0 * ANGSTROM_M))


def test_lost_link_is_no_missing_target_of_the_tip() -> None:
    with pytest.raises(ControllerLost, match="gone"):
        ScanFrame(Asking(Targetless(ControllerLost("gone"))), ANGSTROM_M).tip()


class OpeningAFile(Targetless):
    """GXSM while it opens a file: its range is 0 for a moment."""

    def __init__(self) -> None:
        super().__init__(0.0)
        self.readings = 0

    def call(self, method: str, *arguments: str | int | float) -> object:
        self.readings += arguments == ("RangeX",)
        value = super().call(method, *arguments)
        return 0.0 if self.readings < 3 and arguments[0] in ("RangeX", "RangeY") else value


def test_frame_is_read_again_while_gxsm_opens_a_file() -> None:
    region = ScanFrame(Asking(OpeningAFile()), ANGSTROM_M).region()
    assert region.size_m == pytest.approx((1000.0 * ANGSTROM_M,) * 2)
