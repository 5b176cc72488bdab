"""Connections over links that come and go: nothing waits for the operating system's patience."""

from __future__ import annotations

import logging
import multiprocessing
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zmq
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import TransportError
from afspm.transport import network
from afspm.transport.frames import receive_frames, send_frames
from afspm.transport.network import CONNECTED, LinkTimes, Monitor, Network
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.scheduler_sockets import TranslatorLink

WITHIN_MS = 10_000
LOST = int(zmq.EVENT_CONNECT_RETRIED)
PIPES = pytest.mark.skipif(not network.HAS_PRIVATE_SOCKETS, reason="needs an address that is free again at once")


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
def test_attempt_to_connect_is_ended_and_begun_again(unreachable: int, open_: Any) -> None:
    assert LinkTimes().connect <= 3_000  # a partition must heal within ten seconds
    ours = open_(Network(times=LinkTimes(connect=300)))
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


class Translator:
    """A translator's socket at `address`, which takes one message after the other."""

    def __init__(self, address: str) -> None:
        self._network = Network()
        self.socket = self._network.socket(zmq.ROUTER)
        self._network.bind(self.socket, address)

    def take(self) -> list[bytes]:
        assert self.socket.poll(WITHIN_MS), "no message came"
        return [frame.bytes for frame in receive_frames(self.socket)]

    def close(self) -> None:
        self._network.close()


def _link(ours: Network, address: str) -> TranslatorLink:
    log = RateLimitedLog(logging.getLogger("test"), ExperimentClock.real())
    link = TranslatorLink(ours, address, log, b"epoch")
    # an attempt to connect again: by then libzmq has told the socket of the lost connection
    link.monitor = Monitor(ours, link.socket, CONNECTED | LOST)
    return link


def _await(monitor: Monitor, kind: int) -> None:
    while True:
        assert monitor.socket.poll(WITHIN_MS), "the connection did not change"
        if kind in [event.kind for event in monitor.drain()]:
            return


def _lose_connection_before_last_frame(address: str) -> None:
    ours = Network()
    link = _link(ours, address)
    translator = Translator(address)
    _await(link.monitor, CONNECTED)
    for number in range(1, 21):  # 5 frames each: libzmq looks at its connections before the 100th
        assert link.send(number, [b"request"])
        sender, *before, _ = translator.take()
        assert send_frames(translator.socket, [sender, *before, b"\1", b"reason"])
        assert link.socket.poll(WITHIN_MS)
        if number == 20:
            translator.close()
            _await(link.monitor, LOST)
        assert [reply.number for reply in link.receive()] == [number]
    ours.close()


@PIPES
def test_connection_lost_behind_an_answer_ends_neither_scheduler_nor_answer(tmp_path: Path) -> None:
    # in a process of its own: libzmq would abort it
    address = f"ipc://{tmp_path}/serve"
    process = multiprocessing.get_context("spawn").Process(target=_lose_connection_before_last_frame, args=(address,))
    process.start()
    process.join(DEADLINE_S)
    assert process.exitcode == 0


@pytest.mark.parametrize("cut_at", range(4))
def test_request_after_one_that_was_cut_off_is_sent(cut_at: int) -> None:
    class Cut:
        """As libzmq after a connection lost in a message: all frames up to the next end of a message are dropped."""

        def __init__(self) -> None:
            self.sent: list[bytes] = []
            self.drops = False

        def send(self, frame: bytes, flags: int) -> None:
            if frame == b"%d" % cut_at:
                self.drops = cut_at > 0 and bool(flags & zmq.SNDMORE)
                raise zmq.Again
            if not self.drops:
                self.sent.append(frame)
            self.drops = self.drops and bool(flags & zmq.SNDMORE)

    socket: Any = Cut()
    assert not send_frames(socket, [b"0", b"1", b"2", b"3"])
    assert send_frames(socket, [b"a", b"b"])
    assert socket.sent[cut_at:] == [b"a", b"b"]
