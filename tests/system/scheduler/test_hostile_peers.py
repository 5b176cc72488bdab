"""Programs of another user, and programs without a key: they are kept out, and the scheduler serves all others."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from afspm.model import ControlRequest
from afspm.supervisor.ports import SocketFolder

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory and open files are read from /proc")
GREETING = b"\xff" + bytes(8) + b"\x7f\3\1NULL".ljust(55, b"\0")
PING = b"\4\7\4PING\0\0"
MB = 1 << 20
MOST_GROWTH_MB = 100
SECONDS = 2.0
HALF_OPEN = 400


class Raw:
    """A connection that sends ZMTP byte by byte, without a key."""

    made: ClassVar[list[Raw]] = []

    def __init__(self, address: str, kind: bytes) -> None:
        host, port = address.removeprefix("tcp://").split(":")
        self.socket = socket.create_connection((host, int(port)))
        self.made.append(self)
        ready = b"\5READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
        self.socket.sendall(GREETING + bytes([4, len(ready)]) + ready)
        self.socket.setblocking(False)

    def say(self, data: bytes, within_s: float = SECONDS) -> bool:
        """Send all data, or until the time is over; False: the connection was closed."""
        until_s = time.monotonic() + within_s
        view = memoryview(data)
        while view and time.monotonic() < until_s:
            with contextlib.suppress(BlockingIOError):
                try:
                    view = view[self.socket.send(view[: 1 << 16]) :]
                except (BrokenPipeError, ConnectionResetError):
                    return False
        return True


def frame(payload: bytes, *, more: bool = False) -> bytes:
    return (
        bytes([more, len(payload)]) + payload
        if len(payload) < 256
        else bytes([2 | more]) + struct.pack(">Q", len(payload)) + payload
    )


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    while Raw.made:
        Raw.made.pop().socket.close()


@pytest.fixture
def friend(locked_rig: Any) -> Any:
    locked_rig.start()
    found = locked_rig.component("Experiment")
    locked_rig.linked(found)
    return found


@pytest.fixture
def serves_as_before(locked_rig: Any, friend: Any) -> Iterator[None]:
    """Check afterwards that another client is answered, and that the process has not grown."""
    before = memory_mb(locked_rig.process.pid, "VmRSS")
    yield
    assert friend.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok
    assert locked_rig.process.poll() is None
    assert memory_mb(locked_rig.process.pid, "VmHWM") - before < MOST_GROWTH_MB


def memory_mb(pid: int, field: str) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


def address_of(rig: Any, kind: bytes) -> str:
    return str(rig.serve if kind == b"DEALER" else rig.publish)


ATTACKS: dict[str, tuple[bytes, Callable[[int], bytes]]] = {
    "endless parts to the control socket": (b"DEALER", lambda _: frame(bytes(4000), more=True) * 100),
    "endless parts to the publisher": (b"SUB", lambda _: frame(bytes(4000), more=True) * 100),
    "requests and heartbeats": (
        b"DEALER",
        lambda _: (frame(b"", more=True) + frame(b"\5", more=True) + frame(b"start-scan") + PING) * 3000,
    ),
    "short subscriptions": (
        b"SUB",
        lambda n: b"".join(frame(b"\1%d" % (3000 * n + one)) for one in range(3000)),
    ),
    "replays": (b"XSUB", lambda _: b"".join(frame(b"\1\0replay/a/%d\0-1\0" % one) for one in range(500))),
}


@pytest.mark.usefixtures("serves_as_before")
@pytest.mark.parametrize("attack", ATTACKS)
def test_program_without_a_key_is_disconnected_after_any_input(locked_rig: Any, attack: str) -> None:
    kind, data = ATTACKS[attack]
    peer = Raw(address_of(locked_rig, kind), kind)
    assert not all(peer.say(data(n)) for n in range(2000))


@pytest.mark.usefixtures("serves_as_before")
@pytest.mark.parametrize("kind", [b"DEALER", b"SUB"])
def test_connections_that_never_finish_the_exchange_of_keys_are_ended(locked_rig: Any, kind: bytes) -> None:
    host, port = address_of(locked_rig, kind).removeprefix("tcp://").split(":")
    files = Path(f"/proc/{locked_rig.process.pid}/fd")
    before = len(list(files.iterdir()))
    silent = [socket.create_connection((host, int(port))) for _ in range(HALF_OPEN)]
    locked_rig.until(lambda: len(list(files.iterdir())) > before + HALF_OPEN // 2)
    late = locked_rig.component("Visitor")  # joins meanwhile
    assert late.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok
    locked_rig.until(lambda: len(list(files.iterdir())) < before + HALF_OPEN // 10)
    for one in silent:
        one.close()


STRANGER = """
import os, socket, sys
os.setgroups([]); os.setgid(65534); os.setuid(65534)
for path in sys.argv[1:]:
    try:
        socket.socket(socket.AF_UNIX).connect(path)
        print("connected")
    except OSError as error:
        print(type(error).__name__)
"""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may become another user")
def test_unix_sockets_of_a_run_are_out_of_reach_of_other_users() -> None:
    folder = SocketFolder()
    try:
        path = folder.address().removeprefix("ipc://")
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(path)
            bound.listen()
            Path(path).chmod(0o777)  # whatever the umask is
            connected = subprocess.run([sys.executable, "-c", STRANGER, path], capture_output=True, text=True)
            assert connected.stdout.split() == ["PermissionError"], connected.stderr
            with socket.socket(socket.AF_UNIX) as own:
                own.connect(path)
            folder.path.chmod(0o755)  # so that the test can fail
            connected = subprocess.run([sys.executable, "-c", STRANGER, path], capture_output=True, text=True)
            assert connected.stdout.split() == ["connected"], connected.stderr
    finally:
        folder.close()
    assert not folder.path.exists()
