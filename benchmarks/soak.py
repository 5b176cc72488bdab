"""`python -m benchmarks.soak [COUNT]`: malformed requests and packets (default: a million) against real processes.

A scheduler, a translator with its simulated microscope and a component, each in a process of its own, receive hostile
input: truncated and overlong messages, wrong numbers of frames, unknown numbers, random bytes, bytes that are not even
ZeroMQ, frames that announce gigabytes, unfinished handshakes, under known names and ever new ones. After every batch
each must answer as before, and in the end none may have grown.
"""

from __future__ import annotations

import json
import random
import socket
import sys
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zmq

from afspm import wire
from afspm.model import ControlRequest, Region, Request, Scan
from afspm.transport.network import Network
from afspm.transport.port import PacketReceived, ReplyReceived
from afspm.transport.zmq_port import ZmqPort
from benchmarks.processes import CLOCK, Roles, roles

BATCH = 2_000
GROWTH_MB = 32.0
"""How much a process may grow from the first tenth to the end. In a short run the tables of what was answered are still
filling up by then (20 MB in the scheduler); in a run of a million nothing is left but what is just queued (4 MB)."""
BURSTS = 0.05
"""So many batches are followed by a burst."""
MOST_UNFINISHED = 300
"""Connections held open at a time that never finish to greet."""
GREETING = b"\xff" + bytes(8) + b"\x7f\3\0NULL".ljust(55, b"\0")
READY = b"\4\x1c\5READY\x0bSocket-Type\0\0\0\6DEALER"
"""What a peer of ZeroMQ says first, and then."""
NAMES = (b"Experiment", b"Tip Corrector", b"", b"\xff\xfe", b"x" * 255, b"scheduler")


class Malice:
    """Makes messages that are nearly right, and others that are not, from a seed."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        import numpy as np

        scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((16, 16)), 1_800_000_000_000_000_000)
        self._packets = [[b"Scan2d", wire.encode(scan)[1], wire.encode_time(1_800_000_000_000_000_000)]]
        self._requests = [
            wire.encode_request(Request(ControlRequest.ACTION, "start-scan", id="Experiment/soak/1")),
            [b"\3", bytes.fromhex("0a3c0a310a1209"), b""],
            [bytes([ControlRequest.REQUEST_CTRL]), b"\0"],
            [bytes([ControlRequest.ADD_EXP_PRBLM]), b"\1"],
            [bytes([ControlRequest.SET_CONTROL_MODE]), b"\2"],
        ]

    def request(self) -> list[bytes]:
        frames = self._spoilt(self._requests)
        # calls that end the experiment, or announce its end to the translator, are left out
        ending = (bytes([ControlRequest.END_EXPERIMENT]), wire.CLOSE)
        return [b"\6" if frame in ending else frame for frame in frames]

    def packet(self) -> list[bytes]:
        frames = self._spoilt(self._packets)
        return [b"NOKILL"] if frames == [wire.KILL] else frames

    def _spoilt(self, good: list[list[bytes]]) -> list[bytes]:
        chance, frames = self._random, [*self._random.choice(good)]
        at = chance.randrange(len(frames))
        match chance.randrange(8):
            case 0:
                frames[at] = frames[at][: chance.randrange(len(frames[at]) + 1)]
            case 1:
                frames = frames[: chance.randrange(len(frames) + 1)] or [b""]
            case 2:
                frames += [b"more"] * chance.choice((1, 2, 5, 50))
            case 3:
                frames[0] = bytes([chance.randrange(256)])
            case 4:
                frames = [chance.randbytes(chance.randrange(60)) for _ in range(chance.randrange(1, 6))]
            case 5:
                flipped = bytearray(frames[at] or b"\0")
                flipped[chance.randrange(len(flipped))] ^= 1 << chance.randrange(8)
                frames[at] = bytes(flipped)
            case 6:
                frames[at] = frames[at] + chance.randbytes(chance.choice((1, 10, 1000)))
            case 7:
                frames[-1] = chance.randbytes(chance.randrange(300))
        return frames


class Soak:
    """One run. `processes` are started and ended by the caller."""

    def __init__(self, processes: Roles, seed: int) -> None:
        self.malice = Malice(seed)
        self._random = random.Random(seed)
        self._context: Any = processes.enter_context(zmq.Context())
        self._context.setsockopt(zmq.LINGER, 0)
        serve = processes.microscope(initial={"scan-resolution-x": 16, "scan-resolution-y": 16})
        self._noise = self._context.socket(zmq.PUB)
        self._noise.setsockopt(zmq.SNDHWM, 0)
        noise = f"tcp://127.0.0.1:{self._noise.bind_to_random_port('tcp://127.0.0.1')}"
        # a shorter journal than the usual one of a thousand packets: it is full in the first tenth
        cache = {"history": {"JournalEntries": 50}}
        self._scheduler_publish, self._scheduler = processes.scheduler(noise, serve, cache=cache)
        self._translator = serve
        self._heard = processes.start("soaked_component", source=self._scheduler_publish, noise=noise)
        self._friend = ZmqPort(
            Network(), "Friend", CLOCK, subscribe=[self._scheduler_publish, self._heard], control=self._scheduler
        )
        self._translators_friend = ZmqPort(Network(), "Friend", CLOCK, control=serve)
        processes.callback(self._friend.close)
        processes.callback(self._translators_friend.close)
        self._pids = [process.pid for process in processes.processes]
        self._asked = 0
        self._unfinished: deque[socket.socket] = deque()
        processes.callback(self._close_unfinished)

    def batch(self, count: int) -> None:
        """Send `count` messages, a third to each of the three processes; then check that all still serve."""
        targets = []
        for target in (self._scheduler, self._translator):
            dealer = self._context.socket(zmq.DEALER)
            dealer.setsockopt(zmq.SNDHWM, 0)
            if name := self._random.choice((*NAMES, b"somebody new %d" % self._random.randrange(10**9))):
                dealer.setsockopt(zmq.ROUTING_ID, name)
            dealer.connect(target)
            targets.append(dealer)
        for n in range(count):
            if n % 3 == 2:
                self._noise.send_multipart(self.malice.packet())
            else:
                delimiter = [b""] if self._random.random() < 0.9 else []
                targets[n % 3].send_multipart(delimiter + self.malice.request())
        self._strangers()
        if self._random.random() < BURSTS:
            self._burst()
        self.check()
        for dealer in targets:
            dealer.close(linger=10_000)

    def _strangers(self) -> None:
        # peers that speak no ZeroMQ, send oversized data, or subscribe to nonsense
        for address in (self._scheduler, self._translator, self._scheduler_publish):
            with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as raw:
                raw.sendall(self._random.randbytes(200))
            with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as raw:
                raw.sendall(GREETING)
                raw.sendall(READY + b"\2" + (1 << 40).to_bytes(8, "big") + b"the beginning of a terabyte")
            unfinished = socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])))
            unfinished.sendall(GREETING[: self._random.randrange(len(GREETING))])
            self._unfinished.append(unfinished)
        while len(self._unfinished) > MOST_UNFINISHED:
            self._unfinished.popleft().close()
        large = self._context.socket(zmq.DEALER)
        large.connect(self._random.choice((self._scheduler, self._translator)))
        large.send_multipart([b"", b"\1", bytes(3_000_000)])
        subscriber = self._context.socket(zmq.XSUB)
        subscriber.connect(self._scheduler_publish)
        for _ in range(20):
            subscriber.send(b"\1\0replay/" + self._random.randbytes(30))
            subscriber.send(self._random.randbytes(10) or b"\1")
        large.close(linger=100)
        subscriber.close(linger=100)

    def _burst(self) -> None:
        # a peer that sends more than any queue holds, with heartbeats in between, and hangs up in the middle
        for target in (self._scheduler, self._translator):
            peer = self._context.socket(zmq.DEALER)
            peer.setsockopt(zmq.SNDHWM, 0)
            peer.setsockopt(zmq.HEARTBEAT_IVL, 1)
            peer.connect(target)
            for _ in range(20_000):
                peer.send_multipart([b"", bytes([ControlRequest.ACTION_SUPPORT]), b"start-scan"])
            peer.close(linger=50)

    def _close_unfinished(self) -> None:
        for connection in self._unfinished:
            connection.close()

    def check(self) -> None:
        """Check that scheduler, translator and component answer as before. Raises TimeoutError."""
        for port in (self._friend, self._translators_friend):
            self._asked += 1
            request = Request(ControlRequest.ACTION_SUPPORT, "start-scan", id=f"Friend/soak/{self._asked}")
            _until(port, wire.encode_request(request), request.id)
        # each by its own address: the scheduler is the slowest, and what it has not taken yet would count as its memory
        missing = {self._scheduler_publish, self._heard}
        mark = b"\xa2\6\4" + self._asked.to_bytes(4)  # a field that no message has
        deadline_s = CLOCK.monotonic_s() + 60.0
        while CLOCK.monotonic_s() < deadline_s:
            stamp = wire.encode_time(CLOCK.now_ns())
            self._noise.send_multipart([b"FeedbackAnalysis", mark, stamp])
            self._noise.send_multipart([b"Mark", mark, stamp])
            found = self._friend.poll(0.05)
            marks = [i for i in found if isinstance(i, PacketReceived) and bytes(i.packet.payload) == mark]
            missing -= {one.source for one in marks}
            if not missing:
                return
        raise TimeoutError(f"no longer passed on what they hear: {missing}")

    def memory_mb(self) -> list[float]:
        """Return the resident memory of each process (on Linux; elsewhere nothing is measured)."""
        return [_resident_mb(pid) for pid in self._pids]


def _is_answer(incoming: Any, request_id: str) -> bool:
    return isinstance(incoming, ReplyReceived) and incoming.response.id == request_id


def _until(port: ZmqPort, frames: list[bytes], request_id: str) -> None:
    # asks until the answer comes
    deadline_s = CLOCK.monotonic_s() + 60.0
    while CLOCK.monotonic_s() < deadline_s:
        port.send(frames)
        if any(_is_answer(incoming, request_id) for incoming in port.poll(0.5)):
            return
    raise TimeoutError("no answer within a minute")


def _resident_mb(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * 4096 / 2**20


def soak(count: int, seed: int = 1) -> Iterator[dict[str, Any]]:
    """Yield, ten times, the number of messages sent and the sizes of the processes.

    Raises:
        TimeoutError, MemoryError: a process no longer serves, or has grown.
    """
    with roles() as processes:
        run = Soak(processes, seed)
        run.check()
        sent, early = 0, [0.0]
        while sent < count:
            before = 10 * sent // count
            run.batch(min(BATCH, count - sent))
            sent += min(BATCH, count - sent)
            if 10 * sent // count > before:
                now = run.memory_mb()
                early = now if early == [0.0] else early
                yield {"sent": sent, "memory_mb": [round(mb, 1) for mb in now]}
                if any(b - a > GROWTH_MB for a, b in zip(early, now, strict=True)):
                    raise MemoryError(f"from {early} MB to {now} MB")


if __name__ == "__main__":
    for progress in soak(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000):
        print(json.dumps(progress), flush=True)
