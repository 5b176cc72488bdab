"""The ZeroMQ connection to a controller, over real sockets."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import zmq
from deadlines import DEADLINE_S

from afspm.basics.errors import ConfigError
from afspm.translator.driver_base import ControllerLost
from afspm.translator.zmq_connection import ZmqConnection

HINTS = ("an address", "does it listen?", "does it answer?")


@pytest.fixture
def controller() -> Iterator[zmq.Socket[bytes]]:
    context = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.bind("tcp://127.0.0.1:0")
    yield socket
    context.destroy(linger=0)


def address(controller: zmq.Socket[bytes]) -> str:
    return controller.getsockopt_string(zmq.LAST_ENDPOINT).rstrip("\0")


def test_connection_made_before_connect_returns_is_noticed(
    controller: zmq.Socket[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy computer the handshake is over before `connect` has returned."""
    seen = controller.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
    connect = zmq.Socket.connect

    def slow(socket: zmq.Socket[bytes], where: str) -> object:
        done = connect(socket, where)
        if where == address(controller):
            assert seen.poll(5_000)
        return done

    monkeypatch.setattr(zmq.Socket, "connect", slow)
    with seen:
        ZmqConnection(address(controller), 0.2, time.monotonic, HINTS).close()


def test_address_without_a_listener_is_reported() -> None:
    with pytest.raises(ControllerLost, match="nothing listens"):
        ZmqConnection("tcp://127.0.0.1:1", 5.0, time.monotonic, HINTS)


def test_invalid_address_is_reported() -> None:
    with pytest.raises(ConfigError, match="is not an address"):
        ZmqConnection("nonsense", 5.0, time.monotonic, HINTS)


def test_reply_of_several_frames_closes_the_connection(controller: zmq.Socket[bytes]) -> None:
    connection = ZmqConnection(address(controller), 5.0, time.monotonic, HINTS)
    connection.begin("a scan", b"scan")
    who, *_ = controller.recv_multipart()
    controller.send_multipart([who, b"", b"one", b"two"])
    connection.wait(DEADLINE_S)
    with pytest.raises(ControllerLost, match="3 frames"):
        connection.reply("a scan", bytes)
    with pytest.raises(ControllerLost, match="was lost"):
        connection.begin("another", b"scan")


def test_reply_that_can_not_be_decoded_closes_the_connection(controller: zmq.Socket[bytes]) -> None:
    def parse(raw: bytes) -> bytes:
        raise ControllerLost(f"garbage: {raw!r}")

    connection = ZmqConnection(address(controller), 5.0, time.monotonic, HINTS)
    connection.begin("a scan", b"scan")
    who, *_ = controller.recv_multipart()
    controller.send_multipart([who, b"", b"?"])
    connection.wait(DEADLINE_S)
    with pytest.raises(ControllerLost, match="garbage"):
        connection.reply("a scan", parse)
    with pytest.raises(ControllerLost, match="was lost"):
        connection.begin("another", b"scan")
