"""Peers that flood, never finish or hang up in the middle: the scheduler lives, stays small, and serves all others."""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from afspm.model import ControlRequest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="bounds in bytes are those of Linux")
GREETING = b"\xff" + bytes(8) + b"\x7f\3\1NULL".ljust(55, b"\0")
PING = b"\4\7\4PING\0\0"
MB = 1 << 20
MOST_GROWTH_MB = 200
SECONDS = 3.0


class Raw:
    """A connection that speaks ZMTP byte by byte."""

    made: ClassVar[list[Raw]] = []

    def __init__(self, address: str, kind: bytes) -> None:
        host, port = address.removeprefix("tcp://").split(":")
        self.socket = socket.create_connection((host, int(port)))
        self.made.append(self)
        ready = b"\5READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
        self.socket.sendall(GREETING + bytes([4, len(ready)]) + ready)
        heard = b""
        while b"READY" not in heard:
            heard += self.socket.recv(1000)
        self.socket.setblocking(False)

    def say(self, data: bytes, within_s: float = SECONDS) -> bool:
        """Send until all is gone, or the time is over; False: the connection was ended."""
        until_s = time.monotonic() + within_s
        view = memoryview(data)
        while view and time.monotonic() < until_s:
            with contextlib.suppress(BlockingIOError):
                try:
                    view = view[self.socket.send(view[: 1 << 16]) :]
                except (BrokenPipeError, ConnectionResetError):
                    return False
        return True

    def hang_up(self) -> None:
        """At once, whatever is on its way (RST)."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


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
def friend(rig: Any) -> Any:
    rig.start()
    found = rig.component("Friend")
    rig.linked(found)
    return found


@pytest.fixture
def serves_as_before(rig: Any, friend: Any) -> Iterator[None]:
    """Afterwards another client is answered, and the process has not grown."""
    before = memory_mb(rig.process.pid, "VmRSS")
    yield
    assert friend.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok
    assert rig.process.poll() is None
    assert memory_mb(rig.process.pid, "VmHWM") - before < MOST_GROWTH_MB


def memory_mb(pid: int, field: str) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


@pytest.mark.usefixtures("serves_as_before")
def test_peers_that_hang_up_while_their_requests_and_heartbeats_wait(rig: Any) -> None:
    for _ in range(4):
        peer = Raw(rig.serve, b"DEALER")
        peer.say((frame(b"", more=True) + frame(b"\5", more=True) + frame(b"start-scan") + PING) * 300_000, 0.5)
        peer.hang_up()


@pytest.mark.usefixtures("serves_as_before")
@pytest.mark.parametrize("kind", [b"DEALER", b"SUB"])
def test_a_message_whose_parts_never_end(rig: Any, kind: bytes) -> None:
    peer = Raw(rig.serve if kind == b"DEALER" else rig.publish, kind)
    part = frame(bytes(4000), more=True) * 100
    assert not all(peer.say(part) for _ in range(2000))  # 800 MB


def ended(peer: Raw) -> bool:
    peer.socket.settimeout(0.05)
    with contextlib.suppress(TimeoutError):
        try:
            while peer.socket.recv(1000):
                pass
        except ConnectionResetError:
            pass
        return True
    return False


@pytest.mark.usefixtures("serves_as_before")
@pytest.mark.parametrize(
    "prefixes",
    [[bytes([65 + n]) * (MB - 1000) for n in range(20)], [b"%d" % n + bytes(7000) for n in range(100)]],
    ids=["one of 1 MB", "many of 7 kB"],
)
def test_subscriptions_to_more_than_any_peer_needs(rig: Any, prefixes: list[bytes]) -> None:
    peer = Raw(rig.publish, b"SUB")
    peer.say(b"".join(frame(b"\1" + prefix) for prefix in prefixes))
    assert rig.until(lambda: ended(peer))


@pytest.mark.usefixtures("serves_as_before")
def test_a_peer_that_asks_for_replays_again_and_again(rig: Any, friend: Any) -> None:
    for _ in range(20):
        rig.publish_packet("Scan2d", b"")
    peer = Raw(rig.publish, b"XSUB")
    peer.say(b"".join(frame(b"\1\0replay/a/%d\0-1\0" % n) for n in range(5000)))
    assert rig.until(lambda: ended(peer))
