"""Connections over links that come and go: nothing waits for the operating system's patience."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import zmq

from afspm.basics.errors import TransportError
from afspm.transport import network
from afspm.transport.network import Monitor, Network


@pytest.fixture
def unreachable() -> Iterator[int]:
    """A port at which attempts to connect are neither accepted nor refused, as where a link is down."""
    with ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        for _ in range(4):  # what waits to be accepted is full then, and the system drops what else comes
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(listener.getsockname())
        yield int(listener.getsockname()[1])


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse where what waits is full")
def test_attempt_to_connect_is_ended_and_begun_again(
    unreachable: int, open_: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert network._CONNECT_MS <= 3_000  # a partition is to heal within ten seconds
    monkeypatch.setattr(network, "_OPTIONS", (*network._OPTIONS, (zmq.CONNECT_TIMEOUT, 300)))
    ours = open_(Network())
    dealer = ours.socket(zmq.DEALER)
    monitor = Monitor(ours, dealer, zmq.EVENT_CONNECT_RETRIED)
    ours.connect(dealer, f"tcp://127.0.0.1:{unreachable}")
    assert monitor.socket.poll(5_000), "the system alone would try for two minutes"


def test_a_host_name_listens_at_every_address_of_the_computer(open_: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Debian's own name leads to 127.0.1.1, where no other computer could connect."""
    entry = (socket.AF_INET, socket.SOCK_STREAM, 0, "", ("127.0.0.1", 0))
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: [entry])
    ours = open_(Network(insecure=True))
    bound = ours.bind(ours.socket(zmq.ROUTER), "tcp://microscope-7:*")
    assert bound.startswith("tcp://0.0.0.0:")


@pytest.mark.parametrize(("ip", "reason"), [("192.0.2.7", "another computer: 192.0.2.7"), ("", "not know the name")])
def test_the_name_of_another_computer_is_refused(
    open_: Any, monkeypatch: pytest.MonkeyPatch, ip: str, reason: str
) -> None:
    def lookup(*_: object) -> Any:
        if not ip:
            raise socket.gaierror
        return [(socket.AF_INET, socket.SOCK_STREAM, 0, "", (ip, 0))]

    monkeypatch.setattr(socket, "getaddrinfo", lookup)
    ours = open_(Network(insecure=True))
    with pytest.raises(TransportError, match=reason):
        ours.bind(ours.socket(zmq.ROUTER), "tcp://microscope-7:29001")
