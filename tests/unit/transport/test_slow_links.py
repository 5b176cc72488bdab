"""Large packets over a link slower than the heartbeats, and over one that is cut in the middle of a packet."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import socket
import struct
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest
import zmq
from systems import not_on_wine

from afspm.basics.clock import ExperimentClock
from afspm.transport import network
from afspm.transport.late_joiners import Marker, topic
from afspm.transport.network import LinkTimes, Network
from afspm.transport.port import PacketReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort

CLOCK = ExperimentClock.real()
ANY = "tcp://127.0.0.1:0"
HEARTBEAT_MS, PATIENCE_MS = 100, 400
BYTES_PER_HEARTBEAT = 100_000
"""At ten heartbeats a second: 1 MB/s."""
SCAN = bytes(range(256)) * 12_000
"""It takes thirty heartbeats, and the patience of the sockets ends after four."""
EVENTUALLY_S, BUSY_MS = 120.0, 60_000
_PING = b"\4PING"
_SO_ATTACH_FILTER, _RETURN = 26, 0x06  # from Linux's headers
WITHOUT_MAXRT = not_on_wine("without TCP_MAXRT a frame must arrive within the time for an answer")


class Connection:
    """A subscriber's connection through a `SlowLink`, with a thread for each direction."""

    def __init__(self, subscriber: socket.socket, publisher: socket.socket) -> None:
        self._subscriber, self._publisher = subscriber, publisher
        self._changed = threading.Condition()
        self._allowed = BYTES_PER_HEARTBEAT
        self._is_over = False
        self.passed = 0
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._up, self._down)]
        for thread in self._threads:
            thread.start()

    def cut(self) -> None:
        """Let nothing through any more: the system drops what the subscriber sends, and acknowledges none of it."""
        drop_all = ctypes.create_string_buffer(struct.pack("=HBBI", _RETURN, 0, 0, 0))
        program = struct.pack("@HP", 1, ctypes.addressof(drop_all))
        self._subscriber.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
        with self._changed:
            self._is_over = True
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._is_over = True
            self._changed.notify()
        for end in (self._subscriber, self._publisher):
            with contextlib.suppress(OSError):  # it is closed by the other side
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._subscriber.close()
        self._publisher.close()

    def _up(self) -> None:
        before = b""
        with contextlib.suppress(OSError):
            while received := self._subscriber.recv(4096):
                pings = (before + received).count(_PING)
                before = received[1 - len(_PING) :]
                self._publisher.sendall(received)
                with self._changed:
                    self._allowed += pings * BYTES_PER_HEARTBEAT
                    self._changed.notify()
            self._publisher.shutdown(socket.SHUT_RDWR)

    def _down(self) -> None:
        with contextlib.suppress(OSError):
            while self._may_pass() and (received := self._publisher.recv(min(self._allowed, 16_384))):
                self._subscriber.sendall(received)
                with self._changed:
                    self._allowed -= len(received)
                self.passed += len(received)

    def _may_pass(self) -> bool:
        with self._changed:
            self._changed.wait_for(lambda: self._allowed > 0 or self._is_over)
            return not self._is_over


class SlowLink:
    """A link to a publisher that carries 100 kB for each heartbeat of the subscriber.

    So its rate is measured by the clock of the sockets under test: a busy computer slows both down.
    """

    def __init__(self, publisher: str) -> None:
        host, _, port = publisher.removeprefix("tcp://").rpartition(":")
        self._publisher = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.connections: list[Connection] = []
        self._is_over = False
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            subscriber, _ = self._listener.accept()
            if self._is_over:
                subscriber.close()
                return
            self.connections.append(Connection(subscriber, socket.create_connection(self._publisher)))

    def close(self) -> None:
        self._is_over = True
        socket.create_connection(self._listener.getsockname()).close()  # it ends the wait of the thread
        self._thread.join()
        self._listener.close()
        for connection in self.connections:
            connection.close()


class Lab:
    """A publisher, and a subscriber behind a slow link that awaits no answer for long.

    Args:
        stalled_ms: time after which the subscriber ends its connection if nothing that it sends is acknowledged.
    """

    def __init__(self, open_: Any, until: Any, stalled_ms: int) -> None:
        self._until = until
        # the patience of the publisher must not end while a busy computer runs nothing of the test
        ours, theirs = (
            Network(times=LinkTimes(check=HEARTBEAT_MS, answered=PATIENCE_MS, alive=BUSY_MS, stalled=one))
            for one in (BUSY_MS, stalled_ms)
        )
        self.publisher = open_(ZmqServerPort(ours, CLOCK, serve=ANY, publish=ANY))
        self.link = open_(SlowLink(self.publisher.publish_address))
        self._subscriber = open_(ZmqPort(theirs, "Left", CLOCK, subscribe=[self.link.address]))
        self._found: list[Any] = []
        self.publisher.publish("Note", b"first")
        self.until(lambda: self.payloads == [b"first"])

    @property
    def payloads(self) -> list[bytes]:
        return [bytes(one.packet.payload) for one in self._found if isinstance(one, PacketReceived)]

    def until(self, condition: Callable[[], bool]) -> None:
        self._until(condition, (self.publisher, []), (self._subscriber, self._found), timeout_s=EVENTUALLY_S)


@pytest.fixture
def make_lab(open_: Any, until: Any) -> Callable[[int], Lab]:
    return lambda stalled_ms: Lab(open_, until, stalled_ms)


@WITHOUT_MAXRT
def test_packet_arrives_at_1_mb_per_s_on_one_connection_in_many_times_the_patience(
    make_lab: Callable[[int], Lab], caplog: pytest.LogCaptureFixture
) -> None:
    lab = make_lab(BUSY_MS)
    connection = lab.link.connections[-1]

    def has_arrived() -> bool:
        assert lab.link.connections[-1] is connection, "the packet begins again from its first byte"
        return lab.payloads[1:] == [SCAN]

    lab.publisher.publish("Scan2d", SCAN)
    lab.until(has_arrived)
    assert len(SCAN) / BYTES_PER_HEARTBEAT > 5 * PATIENCE_MS / HEARTBEAT_MS
    assert connection.passed < 1.1 * len(SCAN)
    assert not caplog.records


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can drop what arrives at a connection")
def test_packet_cut_off_in_the_middle_is_noticed_sent_again_and_logged(
    make_lab: Callable[[int], Lab], caplog: pytest.LogCaptureFixture
) -> None:
    lab = make_lab(500)
    connection = lab.link.connections[-1]
    lab.publisher.publish("Scan2d", SCAN)
    lab.until(lambda: connection.passed > len(SCAN) // 2)
    with caplog.at_level(logging.WARNING, "afspm.transport"):
        connection.cut()
        lab.until(lambda: len(lab.payloads) > 1)
    assert lab.payloads == [b"first", SCAN]
    (warning,) = caplog.messages
    assert warning.startswith(f"Left has lost its connection to {lab.publisher.publish_address} (reconnection 1): ")
    assert "1 packet (3.1 MB) had not arrived" in warning
    assert "to all subscribers so far 3.1 MB" in warning


def test_subscriber_awaits_answers_only_where_nothing_else_ends_its_connection(
    open_: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def awaited_ms(kind: int) -> int:
        return int(ours.socket(kind).getsockopt(zmq.HEARTBEAT_TIMEOUT))

    ours = open_(Network())
    monkeypatch.setattr(network, "_can_end_stalled", lambda: True)
    assert awaited_ms(zmq.XSUB) == 0
    assert awaited_ms(zmq.DEALER) == awaited_ms(zmq.ROUTER) == LinkTimes().answered
    monkeypatch.setattr(network, "_can_end_stalled", lambda: False)
    assert awaited_ms(zmq.XSUB) == LinkTimes().answered


@pytest.mark.parametrize(
    ("of_marker", "subscriber", "reconnections"),
    [
        (topic("Left", 0), "Left", 0),
        (topic("a/b", 12), "a/b", 12),
        (b"\0replay/Left", "", 0),
        (b"\0replay/Left/x", "Left", 0),
        (b"\0replay/\xff/1" + 5000 * b"0", "�", 0),
    ],
)
def test_marker_holds_the_subscribers_name_and_number_of_reconnections(
    of_marker: bytes, subscriber: str, reconnections: int
) -> None:
    marker = Marker.decode(of_marker + b"\0-1\0Scan2d")
    assert marker is not None
    assert (marker.subscriber, marker.reconnections) == (subscriber, reconnections)
