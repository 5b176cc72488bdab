"""How much a peer may send that nobody takes, or that it does not finish."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import pytest
import zmq

from afspm.clock import ExperimentClock
from afspm.transport import tcp_guard
from afspm.transport.network import Network
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import PeerAsked, Router
from afspm.transport.tcp_guard import MOST_UNREAD_BYTES, UNFINISHED_BYTES, UNFINISHED_S, ConnectionBacklog, TcpInfo
from afspm.transport.zmq_server import ZmqServerPort

ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()


def test_what_is_taken_waits_no_more_however_much_it_is() -> None:
    peer = ConnectionBacklog(0.0)
    for step in range(1, 100):
        assert peer.unread(step * MOST_UNREAD_BYTES, 0.1 * step, settled=True) == 0


def test_what_is_not_taken_waits() -> None:
    peer = ConnectionBacklog(0.0)
    assert peer.unread(MOST_UNREAD_BYTES, 0.0, settled=True) == 0
    assert peer.unread(3 * MOST_UNREAD_BYTES, 0.0, settled=False) == 2 * MOST_UNREAD_BYTES


@pytest.mark.parametrize(("received", "unfinished"), [(2 * UNFINISHED_BYTES, True), (UNFINISHED_BYTES // 2, False)])
def test_a_message_that_is_large_has_to_be_finished_in_time(received: int, unfinished: bool) -> None:
    peer = ConnectionBacklog(0.0)
    peer.unread(received, 0.1, settled=False)
    peer.unread(received, UNFINISHED_S, settled=False)
    assert not peer.is_unfinished()
    peer.unread(received, UNFINISHED_S + 0.2, settled=False)
    assert peer.is_unfinished() is unfinished


def test_heartbeats_of_a_night_are_no_unfinished_message() -> None:
    peer = ConnectionBacklog(0.0)
    for second in range(2, 12 * 3600, 2):
        assert peer.unread(second * 20, float(second), settled=False) < 100
        assert not peer.is_unfinished()


def test_what_a_subscriber_has_not_acknowledged_waits_for_it_until_all_has_arrived() -> None:
    peer = ConnectionBacklog(0.0)
    assert peer.unsent(TcpInfo(acked=100, received=0, all_arrived=True), sent=5000) == 0
    assert peer.unsent(TcpInfo(acked=1100, received=0, all_arrived=False), sent=9000) == 3000
    assert peer.unsent(TcpInfo(acked=4100, received=0, all_arrived=True), sent=9000) == 0


@pytest.mark.parametrize("answering", ["a translator", "a scheduler"])
def test_a_client_that_is_answered_is_never_disconnected_however_much_it_asks(
    open_: Any, plain: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, answering: str
) -> None:
    monkeypatch.setattr(tcp_guard, "UNFINISHED_S", 0.0)
    monkeypatch.setattr(tcp_guard, "UNFINISHED_BYTES", 5000)
    monkeypatch.setattr(tcp_guard, "PERIOD_S", 0.01)
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
    router = Router(open_(Network()), ANY, RateLimitedLog(logging.getLogger("test"), CLOCK))

    def answer() -> None:
        while not (asked := [e for e in router.receive() if isinstance(e, PeerAsked)]):
            router.socket.poll(100)
        router.reply(asked[0].connection, [b"\0"])

    return answer, router.address
