"""One process of a measurement: `python -m benchmarks.roles <role> <arguments as JSON>`. Prints its addresses."""

from __future__ import annotations

import json
import logging
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import zmq

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import WireError
from afspm.model import Response
from afspm.simulation.emulation.emulator import find_emulator
from afspm.transport.network import Network
from afspm.transport.port import PacketReceived, RequestReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort
from benchmarks.codec import scan

ANY = "tcp://127.0.0.1:0"
MARK = "FeedbackAnalysis"
"""What is published beside scans: a message that every scheduler lets through."""
LAST = bytes.fromhex("0d0000803f")
LOG_BYTES = 64 << 20
PROBE = 100
"""Payloads up to this size are no scans: they ask whether anybody is there, or say that it was the last."""


def bound(socket: Any) -> str:
    return f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"


def ready(*addresses: str) -> None:
    print(*addresses, flush=True)


def bare_request_proxy() -> None:
    context: zmq.Context[Any] = zmq.Context()
    front, back = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
    ready(bound(front), bound(back))
    zmq.proxy(front, back)


def bare_rep(back: str) -> None:
    socket = zmq.Context().socket(zmq.REP)
    socket.connect(back)
    ready()
    while True:
        _, _, request_id = socket.recv_multipart()
        socket.send_multipart([b"\0", b"", b"", request_id])


def translator(scan_every_s: float | None = None) -> None:
    """Answer every request with a success, having read it; publish a scan of 512² now and then."""
    clock = ExperimentClock.real()
    port = ZmqServerPort(Network(), clock, serve=ANY, publish=ANY)
    ready(str(port.publish_address), port.serve_address)
    next_s = math.inf if scan_every_s is None else clock.monotonic_s()
    while True:
        if scan_every_s is not None and clock.monotonic_s() >= next_s:
            next_s += scan_every_s
            port.publish("Scan2d", wire.encode(replace(scan(512), time_ns=clock.now_ns()))[1])
        for received in port.poll(None if next_s == math.inf else max(0.0, next_s - clock.monotonic_s())):
            if isinstance(received, RequestReceived):
                try:
                    response = Response(0, id=wire.decode_request(received.frames).id)
                except WireError as error:
                    response = Response(error.response, reason=str(error))
                port.reply(wire.encode_response(response))


def emulator(vendor: str, folder: str) -> None:
    """Run an emulated controller."""
    made = find_emulator(vendor)(port=0)
    made.run(ExperimentClock.real(), Path(folder), logging.getLogger(vendor), ready)


def proxy_sockets(publisher: str, queue: int) -> tuple[Any, Any]:
    """Return the sockets of a proxy towards the publisher and the subscribers; print the address of the latter."""
    context: zmq.Context[Any] = zmq.Context()
    front, back = context.socket(zmq.XSUB), context.socket(zmq.XPUB)
    for socket in (front, back):
        socket.set_hwm(queue)
    front.connect(publisher)
    ready(bound(back))
    return front, back


def bare_packet_proxy(publisher: str, queue: int) -> None:
    front, back = proxy_sockets(publisher, queue)
    zmq.proxy(front, back)


def bare_logging_proxy(publisher: str, queue: int) -> None:
    """Append each packet to a file of bounded size before passing the packet on."""
    front, back = proxy_sockets(publisher, queue)
    poller = zmq.Poller()
    poller.register(front, zmq.POLLIN)
    poller.register(back, zmq.POLLIN)
    with tempfile.TemporaryFile(buffering=0) as log:
        while True:
            for socket, _ in poller.poll():
                if socket is back:
                    front.send(back.recv())
                    continue
                frames = front.recv_multipart(copy=False)
                for frame in frames:
                    log.write(frame.buffer)
                if log.tell() > LOG_BYTES:
                    log.seek(0)
                back.send_multipart(frames, copy=False)


class Tally:
    """Notifies the measuring process of the first arrival and of the last one of a batch."""

    def __init__(self, address: str) -> None:
        self._socket: Any = zmq.Context.instance().socket(zmq.PUSH)
        self._socket.connect(address)
        self._there = False
        self._count = 0

    def add(self, size: int) -> None:
        if size > PROBE:
            self._count += 1
        elif not self._there:
            self._there = True
            self._socket.send(b"there")
        elif size == len(LAST):
            self._socket.send(b"%d" % self._count)
            self._count = 0


def bare_subscriber(source: str, tally: str, queue: int) -> None:
    socket: Any = zmq.Context.instance().socket(zmq.SUB)
    socket.set_hwm(queue)
    socket.setsockopt(zmq.SUBSCRIBE, b"Scan2d")
    socket.setsockopt(zmq.SUBSCRIBE, MARK.encode())
    socket.connect(source)
    told = Tally(tally)
    ready()
    while True:
        told.add(len(socket.recv_multipart(copy=False)[1]))


def our_subscriber(source: str, tally: str, name: str) -> None:
    port = ZmqPort(Network(), name, ExperimentClock.real(), subscribe=[source], envelopes=["Scan2d", MARK])
    told = Tally(tally)
    ready()
    while True:
        for incoming in port.poll(None):
            if isinstance(incoming, PacketReceived):
                told.add(len(incoming.packet.payload))


def bare_replayer(count: int, size: int) -> None:
    """Send `count` messages to every subscriber."""
    socket: Any = zmq.Context.instance().socket(zmq.XPUB)
    socket.setsockopt(zmq.XPUB_VERBOSE, 1)
    ready(bound(socket))
    payload, stamp = bytes(size), wire.encode_time(1)
    while True:
        if socket.recv().startswith(b"\1"):
            for _ in range(count):
                socket.send(b"Scan2d", zmq.SNDMORE)
                socket.send(payload, zmq.SNDMORE, copy=False)
                socket.send(stamp)


def soaked_component(source: str, noise: str) -> None:
    """Receive from a scheduler and from a publisher of nonsense, and publish each "Mark" again."""
    port = ZmqPort(Network(), "Soaked", ExperimentClock.real(), subscribe=[source, noise], publish=ANY)
    ready(str(port.publish_address))
    while True:
        for incoming in port.poll(None):
            if isinstance(incoming, PacketReceived) and incoming.packet.envelope == "Mark":
                port.publish("Mark", bytes(incoming.packet.payload))


if __name__ == "__main__":
    globals()[sys.argv[1]](**json.loads(sys.argv[2]))
