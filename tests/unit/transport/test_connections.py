"""How much a peer may send that nobody takes, or that it does not finish."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import pytest
import zmq

from afspm.clock import ExperimentClock
from afspm.transport import connections
from afspm.transport.complaints import Complaints
from afspm.transport.connections import MOST_UNREAD_BYTES, UNFINISHED_BYTES, UNFINISHED_S, Unread
from afspm.transport.network import Network
from afspm.transport.router import PeerAsked, Router
from afspm.transport.zmq_server import ZmqServerPort

ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()


def test_what_is_taken_waits_no_more_however_much_it_is() -> None:
    peer = Unread(0.0)
    for step in range(1, 100):
        assert not peer.is_too_much(step * MOST_UNREAD_BYTES, 0.1 * step, settled=True)


def test_more_than_may_wait_is_too_much_at_once() -> None:
    peer = Unread(0.0)
    assert not peer.is_too_much(MOST_UNREAD_BYTES, 0.1, settled=False)
    assert peer.is_too_much(MOST_UNREAD_BYTES + 100, 0.2, settled=False)


@pytest.mark.parametrize(("received", "too_much"), [(2 * UNFINISHED_BYTES, True), (UNFINISHED_BYTES // 2, False)])
def test_a_message_that_is_large_has_to_be_finished_in_time(received: int, too_much: bool) -> None:
    peer = Unread(0.0)
    assert not peer.is_too_much(received, 0.1, settled=False)
    assert not peer.is_too_much(received, UNFINISHED_S, settled=False)
    assert peer.is_too_much(received, UNFINISHED_S + 0.2, settled=False) is too_much


def test_heartbeats_of_a_night_are_no_unfinished_message() -> None:
    peer = Unread(0.0)
    for second in range(2, 12 * 3600, 2):
        assert not peer.is_too_much(second * 20, float(second), settled=False)


@pytest.mark.parametrize("answering", ["a translator", "a scheduler"])
def test_a_client_that_is_answered_is_never_disconnected_however_much_it_asks(
    open_: Any, plain: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, answering: str
) -> None:
    monkeypatch.setattr(connections, "UNFINISHED_S", 0.0)
    monkeypatch.setattr(connections, "UNFINISHED_BYTES", 5000)
    monkeypatch.setattr(connections, "PERIOD_S", 0.01)
    answer, address = translator(open_) if answering == "a translator" else scheduler(open_)
    asking, rounds, until_s = plain(zmq.REQ), 0, time.monotonic() + 0.3
    asking.connect(address)
    while rounds < 200 or time.monotonic() < until_s:
        asking.send_multipart([b"\5", bytes(100)])
        answer()
        assert asking.recv_multipart() == [b"\0"]
        rounds += 1
    assert not caplog.records


def translator(open_: Any) -> tuple[Callable[[], None], str]:
    server = open_(ZmqServerPort(Network(), CLOCK, serve=ANY, publish=None))

    def answer() -> None:
        while not server.poll(1.0):
            pass
        server.reply([b"\0"])

    return answer, server.serve_address


def scheduler(open_: Any) -> tuple[Callable[[], None], str]:
    router = Router(open_(Network()), ANY, Complaints(logging.getLogger("test"), CLOCK))

    def answer() -> None:
        while not (asked := [e for e in (*router.receive(), *router.follow()) if isinstance(e, PeerAsked)]):
            router.socket.poll(100)
        router.reply(asked[0].connection, [b"\0"])

    return answer, router.address
