"""Peers of version 1 that are as brittle as the published ones: whatever their version does not have ends them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import zmq
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from afspm.wire.generated import analysis_pb2, control_pb2, feedback_pb2, scan_pb2, spectroscopy_pb2

MESSAGES: dict[str, type[Message]] = {
    made.DESCRIPTOR.name: made
    for made in (
        scan_pb2.Scan2d,
        spectroscopy_pb2.Spec1d,
        control_pb2.ScopeStateMsg,
        control_pb2.ControlState,
        scan_pb2.ScanParameters2d,
        feedback_pb2.ZCtrlParameters,
        spectroscopy_pb2.ProbePosition,
        analysis_pb2.SpatialROIWithScoreList,
        analysis_pb2.SpatialPointWithScoreList,
    )
}
OBJECTS: dict[int, type[Message] | None] = {
    1: control_pb2.ActionMsg,
    2: control_pb2.ParameterMsg,
    3: scan_pb2.ScanParameters2d,
    4: feedback_pb2.ZCtrlParameters,
    5: spectroscopy_pb2.ProbePosition,
    6: None,
    8: None,
    9: None,
    10: None,
    12: control_pb2.ActionMsg,
}
"""The objects of requests, by number; None: one byte."""
PARAM, REQUEST, RELEASE, END, LAST = 2, 6, 7, 11, 12


class Ended(Exception):
    """The peer has met what it does not know, and is no more."""


def check_request(frames: Sequence[bytes]) -> None:
    """Raises Ended if it is no request of version 1."""
    number = frames[0][0] if len(frames[0]) == 1 else 0
    if not 1 <= number <= LAST:
        raise Ended(f"there is no request {frames[0]!r}")
    if number in (RELEASE, END):
        if len(frames) != 1:
            raise Ended(f"request {number} has no object: {frames}")
        return
    if len(frames) != 2:
        raise Ended(f"request {number} has {len(frames)} frames: {frames}")
    made = OBJECTS[number]
    if made is not None:
        made.FromString(frames[1])
    elif len(frames[1]) != 1:
        raise Ended(f"the object of request {number} is {frames[1]!r}")


class Subscriber:
    """Knows nine messages, keeps the last of each, and looks at nothing else than that."""

    def __init__(self, socket: Any, address: str, *prefixes: bytes) -> None:
        self._socket = socket
        self._newest_ns = -1
        self.cache: dict[str, Message] = {}
        self.killed = False
        for prefix in (*(prefixes or (b"",)), b"KILL"):
            socket.setsockopt(zmq.SUBSCRIBE, prefix)
        socket.connect(address)

    def pump(self) -> None:
        """One look: whatever has come is taken in, and the last of it is all that is seen."""
        while self._socket.poll(0):
            self._take(self._socket.recv_multipart())

    def _take(self, frames: list[bytes]) -> None:
        envelope = frames[0].decode()
        if envelope == "KILL":
            self.killed = True
            return
        message = MESSAGES.get(envelope.split("_")[0])
        if message is None or len(frames) != 3:
            raise Ended(f"no packet of version 1: {envelope!r} of {len(frames)} frames")
        time_ns = Timestamp.FromString(frames[2]).ToNanoseconds()
        if time_ns <= self._newest_ns:
            return
        self._newest_ns = time_ns
        self.cache[envelope] = message.FromString(frames[1])

    def close(self) -> None:
        self._socket.close()

    @property
    def state(self) -> int | None:
        """What the microscope does, as far as it has seen."""
        told = self.cache.get("ScopeStateMsg")
        return None if told is None else int(getattr(told, "scope_state"))  # noqa: B009


class Client:
    """A component that asks: one request at a time, of which it awaits the answer."""

    def __init__(self, socket: Any, address: str, name: str) -> None:
        self._socket = socket
        if name:
            socket.setsockopt(zmq.ROUTING_ID, name.encode())
        socket.connect(address)

    def send(self, number: int, thing: Message | int | None = None) -> None:
        payload = thing.SerializeToString() if isinstance(thing, Message) else bytes([thing or 0])
        frames = [bytes([number])] if thing is None else [bytes([number]), payload]
        check_request(frames)
        self.asked = number
        self._socket.send_multipart(frames)

    def has_answer(self) -> bool:
        return bool(self._socket.poll(0))

    def answer(self) -> int:
        """The code. Raises Ended if it is no answer of version 1."""
        frames = self._socket.recv_multipart()
        if len(frames) > 2 or len(frames[0]) != 1:
            raise Ended(f"no response of version 1: {frames}")
        if self.asked == PARAM:
            if len(frames) < 2:
                raise Ended("an answer to REQ_PARAM has an object")
            control_pb2.ParameterMsg.FromString(frames[1])
        code: int = frames[0][0]
        return code


class Server:
    """A translator: REP and PUB sockets.

    Args:
        answer: the frames of the answer to a request.
    """

    def __init__(self, rep: Any, pub: Any, serve: str, publish: str) -> None:
        self._rep, self._pub = rep, pub
        self.asked: deque[list[bytes]] = deque()
        self.answer: Callable[[list[bytes]], list[bytes]] = lambda frames: [b"\0"]
        self._newest_ns = 0
        rep.bind(serve)
        pub.bind(publish)

    def pump(self) -> None:
        if self._rep.poll(0):
            frames = self._rep.recv_multipart()
            check_request(frames)
            self.asked.append(frames)
            self._rep.send_multipart(self.answer(frames))

    def publish(self, message: Message, time_ns: int) -> None:
        self._newest_ns = max(time_ns, self._newest_ns + 1000)
        stamp = Timestamp()
        stamp.FromNanoseconds(self._newest_ns)
        name = message.DESCRIPTOR.name.encode()
        self._pub.send_multipart([name, message.SerializeToString(), stamp.SerializeToString()])


class Router:
    """A scheduler of which one asks: it gives control to whoever wants it, and knows one problem that is set.

    Attributes:
        asked: name and frames of each request.
    """

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self.address = f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"
        self.holder = b""
        self.problems: set[int] = set()
        self.asked: list[tuple[str, list[bytes]]] = []

    def pump(self) -> None:
        if self._socket.poll(0):
            name, empty, *frames = self._socket.recv_multipart()
            if empty:
                raise Ended(f"no empty frame after the name of {name!r}")
            check_request(frames)
            self.asked.append((name.decode(), frames))
            self._socket.send_multipart([name, b"", *self._answer(name, frames[0][0], frames[1:])])

    def _answer(self, name: bytes, number: int, thing: list[bytes]) -> list[bytes]:
        if number == REQUEST:
            self.holder = name
        elif number == 8:
            self.problems.add(thing[0][0])
        elif number == 9:
            self.problems.remove(thing[0][0])  # it ends over one that is not set
        elif number < REQUEST or number == LAST:
            return [b"\0"] if name == self.holder else [b"\6"]
        return [b"\0"]


class Mediator(Router):
    """A scheduler with a cache: it asks a translator for the client in control, until a client ends the experiment.

    Args:
        socket: makes a socket of a type.
    """

    def __init__(self, socket: Callable[[int], Any], server: str, source: str) -> None:
        super().__init__(socket(zmq.ROUTER))
        self._publisher, self._translator, self._packets = socket(zmq.XPUB), socket(zmq.REQ), socket(zmq.SUB)
        self.published = f"tcp://127.0.0.1:{self._publisher.bind_to_random_port('tcp://127.0.0.1')}"
        self._translator.connect(server)
        self._packets.setsockopt(zmq.SUBSCRIBE, b"")
        self._packets.connect(source)
        self._cache: dict[bytes, list[bytes]] = {}
        self._newest_ns = 0
        self.ended = False

    def wait(self, timeout_ms: int) -> None:
        """Wait for a message, at most for a time."""
        poller = zmq.Poller()
        for socket in (self._socket, self._packets, self._publisher):
            poller.register(socket, zmq.POLLIN)
        poller.poll(timeout_ms)

    def pump(self) -> None:
        super().pump()
        while self._packets.poll(0):
            self._take(self._packets.recv_multipart())
        while self._publisher.poll(0):
            subscription = self._publisher.recv()
            for frames in self._cache.values() if subscription[:1] == b"\1" else ():
                if frames[0].startswith(subscription[1:]):
                    self._publisher.send_multipart(frames)

    def _take(self, frames: list[bytes]) -> None:
        name = frames[0].decode()
        if name not in MESSAGES or len(frames) != 3:
            raise Ended(f"no packet of version 1 by a translator: {name!r} of {len(frames)} frames")
        message = MESSAGES[name].FromString(frames[1])
        if isinstance(message, scan_pb2.Scan2d):
            frames[0] = f"Scan2d_{message.params.spatial.roi.size.x}_{message.channel}".encode()
        self._newest_ns = max(self._newest_ns, Timestamp.FromString(frames[2]).ToNanoseconds())
        self._publish(frames)

    def _publish(self, frames: list[bytes]) -> None:
        self._cache[frames[0]] = frames
        self._publisher.send_multipart(frames)

    def _answer(self, name: bytes, number: int, thing: list[bytes]) -> list[bytes]:
        if number == END:
            self._publisher.send(b"KILL")
            self.ended = True
            return [b"\0"]
        if number == RELEASE:
            self.holder = b""
        answer = super()._answer(name, number, thing)
        if answer == [b"\0"] and (number < REQUEST or number == LAST):
            self._translator.send_multipart([bytes([number]), *thing])
            answer = self._translator.recv_multipart()
        problems: Any = self.problems
        state = control_pb2.ControlState(client_in_control_id=self.holder.decode(), problems_set=problems)
        stamp = Timestamp()
        self._newest_ns += 1000
        stamp.FromNanoseconds(self._newest_ns)
        self._publish([b"ControlState", state.SerializeToString(), stamp.SerializeToString()])
        return answer
