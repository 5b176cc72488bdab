"""Connections over links that come and go: nothing waits for the operating system's patience."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import zmq

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
def test_an_attempt_to_connect_is_given_up_and_begun_again(
    unreachable: int, open_: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert network._CONNECT_MS <= 3_000  # a partition is to heal within ten seconds
    monkeypatch.setattr(network, "_OPTIONS", (*network._OPTIONS, (zmq.CONNECT_TIMEOUT, 300)))
    ours = open_(Network())
    dealer = ours.socket(zmq.DEALER)
    monitor = Monitor(ours, dealer, zmq.EVENT_CONNECT_RETRIED)
    ours.connect(dealer, f"tcp://127.0.0.1:{unreachable}")
    assert monitor.socket.poll(5_000), "the system alone would try for two minutes"
