"""A TCP connection that is given up is closed softly: its controller is not reset in mid-answer."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from deadlines import DEADLINE_S

from afspm.translator import tcp
from afspm.translator.driver_base import ControllerLost
from afspm.translator.tcp import Receiver, TcpConnection

Connect = Callable[[float], tuple[TcpConnection, socket.socket]]
PART = b"half of it"


@pytest.fixture
def connect() -> Iterator[Connect]:
    opened: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE_S)

        def made(timeout_s: float) -> tuple[TcpConnection, socket.socket]:
            connection = TcpConnection(server.getsockname(), timeout_s, time.monotonic, ("", ""))
            theirs, _ = server.accept()
            theirs.settimeout(DEADLINE_S)
            opened.append(theirs)
            return connection, theirs

        yield made
    for one in opened:
        one.close()


def whole(receiver: Receiver) -> bytearray:
    return receiver.exactly(2 * len(PART))


def test_late_answer_is_read_and_not_answered_by_a_reset(connect: Connect) -> None:
    # results Z2
    connection, theirs = connect(0.05)
    with pytest.raises(ControllerLost, match=r"no answer to Status within 0\.05 s"):
        connection.ask("Status", b"?", whole)
    assert theirs.recv(100) == b"?"
    assert theirs.recv(100) == b"", "half-closed"
    for _ in range(2):  # after a reset the second one fails
        theirs.sendall(PART)
    theirs.close()
    drained()


def test_silent_controller_is_given_up_and_wakes_who_waits(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "_DRAIN_S", 0.05)
    connection, theirs = connect(DEADLINE_S)
    errors: list[Exception] = []

    def ask() -> None:
        try:
            connection.ask("WaitEndOfScan", b"?", whole)
        except ControllerLost as error:
            errors.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    assert theirs.recv(100) == b"?"
    connection.close()
    asking.join(DEADLINE_S)
    assert len(errors) == 1
    drained()
    assert theirs.recv(100) == b""


def test_connection_without_a_question_is_closed_at_once(connect: Connect) -> None:
    connection, theirs = connect(DEADLINE_S)
    theirs.sendall(2 * PART)
    assert connection.ask("Status", b"?", whole) == 2 * PART
    connection.close()
    assert not [one for one in threading.enumerate() if one.name.startswith("draining")]
    with pytest.raises(ControllerLost, match="the connection was lost during Status"):
        connection.ask("Status", b"?", whole)


def drained() -> None:
    for one in threading.enumerate():
        if one.name.startswith("draining"):
            one.join(DEADLINE_S)
            assert not one.is_alive()
