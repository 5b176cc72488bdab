"""A client of afspm that uses nothing of afspm: ZeroMQ, Protocol Buffers, and the page of the wire format.

It stands for a client in any language, and is the one that `afspm test-client` is itself tested with. One thread owns
the sockets; all others ask it, and wait for what changes.
"""

from __future__ import annotations

import base64
import importlib
import itertools
import json
import os
import sys
import tempfile
import threading
import time
from collections import deque
from functools import partial
from pathlib import Path

import numpy as np
import zmq
from google.protobuf.timestamp_pb2 import Timestamp
from zmq.utils.monitor import recv_monitor_message

PROTO = Path(__file__).resolve().parents[2] / "proto"
STATE = ("ScopeStateMsg", "ControlState", "ScanParameters2d", "ProbePosition", "Scan2d", "Spec1d")
ACTION, PARAM, SET_SCAN, SET_PROBE, REQUEST, RELEASE, FLAG, CLEAR, MODE, END = 1, 2, 3, 5, 6, 7, 8, 9, 10, 11
CLOCK, OTHER_RUN = 101, 100
SUCCESS, NO_RESPONSE, ALREADY, WRONG_MODE, NOT_IN_CONTROL, NOT_FREE, WRONG_PROBLEM = 0, 3, 4, 5, 6, 7, 10
CONFIG, ENDED = 78, 80
METRES = {"": 1.0, "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "pm": 1e-12, "angstrom": 1e-10}
DEGREES = {"": 1.0, "deg": 1.0, "degree": 1.0, "°": 1.0, "rad": 180.0 / np.pi}


def say(line):
    """Write a line for people: a level first, and then what there is to say."""
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


def compiled(folder: Path) -> dict:
    """Compile the messages (with grpcio-tools), and return their classes by name."""
    from grpc_tools import protoc

    known = Path(importlib.import_module("grpc_tools").__file__).parent / "_proto"
    with tempfile.TemporaryDirectory() as out:
        files = sorted(str(file) for file in folder.glob("*.proto"))
        if protoc.main(["protoc", f"-I{folder}", f"-I{known}", f"--python_out={out}", *files]):
            raise SystemExit(CONFIG)
        sys.path.insert(0, out)
        try:
            modules = [importlib.import_module(f"{file.stem}_pb2") for file in folder.glob("*.proto")]
        finally:
            sys.path.remove(out)
    return {name: getattr(m, name) for m in modules for name in m.DESCRIPTOR.message_types_by_name}


MESSAGES = compiled(PROTO)
control_pb2 = importlib.import_module("control_pb2")
VALUES_FIELD = {"Scan2d": 4, "ScanLines": 4}


class Refused(Exception):
    """A request was refused, or not answered."""

    def __init__(self, response):
        super().__init__(response.reason or str(response.code))
        self.response = response


class Response:
    """The answer to a request: code, object, reason and detail."""

    def __init__(self, code, payload=b"", reason="", detail=0):
        self.code, self.payload, self.reason, self.detail = code, payload, reason, detail

    @property
    def ok(self):
        return self.code == SUCCESS


class Packet:
    """A published message; `message` is decoded, but for `values`, which stay in the buffer that was received."""

    def __init__(self, frames):
        if not 2 <= len(frames) <= 3:
            raise ValueError(f"a packet of {len(frames)} frames")
        self.envelope = bytes(frames[0]).decode()
        self.name = self.envelope.split("_", 1)[0]
        self.time_ns = None
        if len(frames) == 3 and len(frames[2]):
            time = Timestamp.FromString(bytes(frames[2]))
            self.time_ns = time.seconds * 1_000_000_000 + time.nanos
        head, values = without_values(frames[1], VALUES_FIELD.get(self.name))
        self.message = MESSAGES[self.name].FromString(head)
        self.values = values
        if self.name == "Spec1d":
            self.values = np.array(self.message.data.values).reshape(-1, max(1, self.message.data.num_variables))
        elif self.name == "ScanLines":
            self.values = values.reshape(-1, self.message.params.data.shape.x)
        elif self.name == "Scan2d" and values.size:
            self.values = values.reshape(self.shape)

    @property
    def shape(self):
        """(rows, columns) of a scan."""
        pixels = self.message.params.data.shape
        return pixels.y, pixels.x

    @property
    def region(self):
        """(centre, size, angle) in m and degrees."""
        spatial = self.message.params.spatial
        scale, turn = METRES[spatial.length_units], DEGREES[spatial.angular_units]
        corner, size = spatial.roi.top_left, spatial.roi.size
        center = ((corner.x + size.x / 2) * scale, (corner.y + size.y / 2) * scale)
        return center, (size.x * scale, size.y * scale), spatial.roi.angle * turn


def without_values(payload, field):
    """Split the packed doubles of a field off a message, without a copy: (the rest, the values)."""
    data, at, rest, values = memoryview(payload), 0, b"", np.empty(0)
    while field is not None and at < len(data):
        begin = at
        key, at = varint(data, at)
        if key & 7 == 0:
            _, at = varint(data, at)
        elif key & 7 == 2:
            length, at = varint(data, at)
            at += length
            if key >> 3 == field:
                values = np.frombuffer(data[at - length : at], "<f8")
                continue
        else:
            at += {1: 8, 5: 4}[key & 7]
        rest += data[begin:at]
    return (bytes(data) if field is None else rest), values


def varint(data, at):
    """Return a varint, and where what follows begins."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


class Client:
    """A component's connection to its experiment. Methods may be called from any thread."""

    def __init__(self, launch):
        self.launch, self.name = launch, launch["name"]
        self.changed = threading.Condition()
        self.ended, self.stopped, self.caught_up, self.connected, self.connections = False, False, False, False, 0
        self.scope_state, self.control = "SS_UNDEFINED", MESSAGES["ControlState"]()
        self.inbox, self.log, self.logged = [], deque(maxlen=64), 0
        self.answers, self._waiting = {}, set()
        self._life, self._numbers = f"{launch['run']}-{os.urandom(4).hex()}", itertools.count(1)
        self._heard = 0.0
        self._outbox, self._context = deque(), zmq.Context()
        self._doorbell, self._bell = self._pair()
        self._dealer = self._connected_dealer(launch["sockets"]["control"])
        self._subscriptions = [Subscription(self, address) for address in launch["sockets"]["subscribe"]]
        self._beating = threading.Thread(target=self._beat, daemon=True)
        for thread in (self._beating, threading.Thread(target=self._serve, daemon=True)):
            thread.start()

    # --- the thread that owns the sockets ---

    def _pair(self):
        ends = [self._context.socket(zmq.PAIR) for _ in range(2)]
        ends[0].bind("inproc://bell")
        ends[1].connect("inproc://bell")
        return ends

    def secured(self, socket, address):
        """Set the keys of a connection, if it has any."""
        keys = self.launch.get("keys") or {}
        owner = (keys.get("servers") or {}).get(address)
        if owner is None and keys.get("everywhere"):
            raise SystemExit(CONFIG)
        if owner is not None:
            socket.curve_publickey, socket.curve_secretkey = keys["public"].encode(), keys["secret"].encode()
            socket.curve_serverkey = next(key for key, name in keys["peers"].items() if name == owner).encode()
        socket.linger, socket.reconnect_ivl, socket.reconnect_ivl_max = 200, 20, 200
        return socket

    def _connected_dealer(self, address):
        socket = self.secured(self._context.socket(zmq.DEALER), address)
        secret = (self.launch.get("keys") or {}).get("secret") or os.urandom(8).hex()
        socket.routing_id = self.name.encode() + b"\0" + secret[:10].encode()
        self._monitor = socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED)
        socket.connect(address)
        return socket

    def _serve(self):
        poller = zmq.Poller()
        readers = {self._bell: self._ring, self._dealer: self._take_answer, self._monitor: self._take_connection}
        for one in self._subscriptions:
            readers |= {one.socket: one.take, one.monitor: one.follow}
        for socket in readers:
            poller.register(socket, zmq.POLLIN)
        while not self.stopped:
            for socket, _ in poller.poll():
                readers[socket]()
            with self.changed:
                self.changed.notify_all()

    def _ring(self):
        self._bell.recv()
        while self._outbox:
            frames = self._outbox.popleft()
            if frames is None:  # a connection that leads nowhere
                self.connected, address = False, self.launch["sockets"]["control"]
                self._dealer.disconnect(address)
                self._dealer.connect(address)
            elif self.connected:
                self._dealer.send_multipart(frames)

    def _post(self, frames):
        with self.changed:
            self._outbox.append(frames)
            self._doorbell.send(b"")

    def _take_connection(self):
        self.connected = recv_monitor_message(self._monitor)["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED
        if self.connected:
            self.connections += 1
            self._dealer.send_multipart([b"", bytes([CLOCK]), b"", f"{self.name}/{self._life}/0".encode()])

    def _take_answer(self):
        frames = self._dealer.recv_multipart()[1:]
        if not frames or not frames[0]:
            return
        code, payload, reason, asked, detail = (*frames, *[b""] * 5)[:5]
        if code[0] == OTHER_RUN:
            self.leave(CONFIG, reason.decode())
        self._heard = time.monotonic()
        if asked in self._waiting:
            self.answers[asked] = Response(code[0], payload, reason.decode(), detail[0] if detail else 0)

    def take(self, packet):
        """Take in a packet, in the thread that owns the sockets."""
        if packet.name == "ScopeStateMsg":
            self.scope_state = control_pb2.ScopeState.Name(packet.message.scope_state)
        elif packet.name == "ControlState":
            self.control = packet.message
        if packet.name in STATE:
            self.log.append((self.logged, packet))
            self.logged += 1
        prefixes = self.launch["envelopes"]
        if prefixes is None or packet.envelope.startswith(tuple(prefixes)):
            self.inbox.append(packet)

    def _beat(self):
        address, token = self.launch["sockets"]["heartbeat"], self.launch["beat_token"].encode()
        context = zmq.Context()
        socket = context.socket(zmq.PUB)
        if address in (self.launch.get("keys") or {}).get("servers", {}):
            self.secured(socket, address)
        socket.linger = 500
        if address:
            socket.connect(address)
        while not self.stopped:
            socket.send_multipart([b"\0", b"0", b"", token])
            self.wait(lambda: self.stopped, self.launch["beat_period_s"])
        socket.send_multipart([b"\1", b"0", b"", token])
        socket.close()
        context.term()  # waits until the last beat is on its way: os._exit waits for nothing

    def leave(self, code, why=""):
        """End the program: the last beat says that it closes on purpose."""
        if why:
            say(f"ERROR {why}")
        with self.changed:
            self.stopped = True
            self.changed.notify_all()
        self._beating.join(1.0)
        os._exit(code)

    # --- asking ---

    def wait(self, done, timeout_s=None):
        """Wait until `done()`; False if that takes longer."""
        with self.changed:
            return self.changed.wait_for(done, timeout_s)

    def ready(self):
        """Wait until the scheduler is there, and all that it has kept for us."""
        self.wait(lambda: self.connected and self._subscriptions[0].caught_up)

    def request(self, number, payload=b""):
        """Send a request until it is answered; return the response."""
        asked = f"{self.name}/{self._life}/{next(self._numbers)}".encode()
        try_s, tries = self.launch["request_timeout_s"], 1 + self.launch["request_retries"]
        self._waiting.add(asked)
        sent, ever = 0, False
        try:
            while sent < tries:
                if not self.wait(lambda: self.connected, try_s * tries):
                    return Response(NO_RESPONSE, b"", "there is no connection to the scheduler", 2 if ever else 1)
                connection, begun = self.connections, time.monotonic()
                is_over = partial(self._is_answered_or_lost, asked, connection)
                self._post([b"", bytes([number]), payload, asked])
                ever = True
                self.wait(is_over, try_s)
                if asked in self.answers:
                    return self.answers.pop(asked)
                if self.connected and self.connections == connection:
                    sent += 1
                    if self._heard < begun and sent < tries:
                        self._post(None)
            return Response(NO_RESPONSE, b"", "the scheduler does not answer", 2)
        finally:
            self._waiting.discard(asked)

    def _is_answered_or_lost(self, asked, connection):
        return asked in self.answers or self.connections != connection or not self.connected

    def demand(self, number, payload=b""):
        """Send a request that must succeed, and return the object of the response. Raises Refused."""
        response = self.request(number, payload)
        if not response.ok:
            raise Refused(response)
        return response.payload

    @property
    def in_control(self):
        return self.control.client_in_control_id == self.name

    def take_control(self, problem=0, until_s=None):
        """Ask for control, and wait for it while it may come. Raises Refused if it does not in time."""
        while True:
            response = self.request(REQUEST, bytes([problem]))
            if response.ok:
                self.wait(lambda: self.in_control, 2.0)
                return
            left_s = None if until_s is None else until_s - time.monotonic()
            hopeless = problem and problem not in self.control.problems_set
            patient = response.code in (ALREADY, WRONG_MODE, WRONG_PROBLEM, NO_RESPONSE) and not hopeless
            if not patient or (left_s is not None and left_s <= 0):
                raise Refused(response)
            seen = self.control
            self.wait(lambda seen=seen: self.control is not seen, 2.0 if left_s is None else min(2.0, left_s))

    def scan(self, center_m, size_m, angle_deg, shape, timeout_s=None):
        """Take a scan, however often it is interrupted; return its channels, and how often it was."""
        parameters = MESSAGES["ScanParameters2d"]()
        roi = parameters.spatial.roi
        roi.top_left.x, roi.top_left.y = (c - s / 2 for c, s in zip(center_m, size_m, strict=True))
        roi.size.x, roi.size.y, roi.angle = *size_m, angle_deg
        parameters.data.shape.y, parameters.data.shape.x = shape
        return self._measure([(SET_SCAN, parameters)], "start-scan", "SS_SCANNING", "Scan2d", timeout_s)

    def spectrum(self, position_m, kind, timeout_s=None):
        """Take a spectrum, however often it is interrupted; return it in a list, and how often it was."""
        position = MESSAGES["ProbePosition"]()
        position.point.x, position.point.y = position_m
        settings = [(PARAM, MESSAGES["ParameterMsg"](parameter="x-spec-kind", value=kind)), (SET_PROBE, position)]
        return self._measure(settings, "start-spec", "SS_SPEC", "Spec1d", timeout_s)

    def _measure(self, settings, action, busy, message, timeout_s):
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        was_in_control, interruptions = self.in_control, 0
        try:
            while True:
                if not self.in_control:
                    self.take_control(0, until_s)
                try:
                    found = self._attempt(settings, action, busy, message)
                except Refused as refused:
                    if refused.response.code not in (NO_RESPONSE, NOT_IN_CONTROL, WRONG_MODE, NOT_FREE):
                        raise
                    found = None
                    self.wait(lambda: not self.in_control or self.scope_state == "SS_FREE", 5.0)
                if found:
                    return list(found.values()), interruptions
                interruptions += 1
                if until_s is not None and time.monotonic() > until_s:
                    raise Refused(Response(NO_RESPONSE, b"", "not in time", 2))
        finally:
            if not was_in_control and self.in_control and not self.ended:
                self.request(RELEASE)

    def _attempt(self, settings, action, busy, message):
        """Set, start and collect; None if it was interrupted."""
        for number, setting in settings:
            self.wait(lambda: self.scope_state == "SS_FREE", 10.0)
            mark = self.logged
            self.demand(number, setting.SerializeToString())
            if number != PARAM:  # what is set is published, if it changes anything
                self.wait(lambda mark=mark: any(p.name == "ScopeStateMsg" for p in self._since(mark)), 1.0)
        self.wait(lambda: self.scope_state == "SS_FREE", 10.0)
        mark = self.logged
        self.demand(ACTION, MESSAGES["ActionMsg"](action=action).SerializeToString())
        self.wait(lambda: busy in self._states(mark) or not self.in_control, 5.0)
        self.wait(lambda: self._is_over(mark, busy) or not self.in_control)
        states = self._states(mark)
        if busy not in states or "SS_INTERRUPTED" in states or not self._is_over(mark, busy):
            return None
        return {p.envelope: p for p in self._since(mark) if p.name == message}

    def _since(self, mark):
        return [packet for number, packet in tuple(self.log) if number >= mark]

    def _states(self, mark):
        return [
            control_pb2.ScopeState.Name(p.message.scope_state) for p in self._since(mark) if p.name == "ScopeStateMsg"
        ]

    def _is_over(self, mark, busy):
        states = self._states(mark)
        return busy not in states or states[-1] not in (busy, "SS_INTERRUPTED", "SS_UNDEFINED")


class Subscription:
    """A connection to one publisher: what it has kept, and then what it publishes, each packet once."""

    def __init__(self, client, address):
        self._client = client
        own = client.launch["envelopes"]
        self._prefixes = [""] if own is None else [*dict.fromkeys([*own, *STATE, "KILL"])]
        self._newest, self._newest_of, self._nonces, self._topic = -1, {}, itertools.count(), None
        self.caught_up = False
        self.socket = client.secured(client._context.socket(zmq.XSUB), address)
        self.socket.rcvhwm = 0
        self.monitor = self.socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
        for prefix in self._prefixes:
            self.socket.send(b"\1" + prefix.encode())
        self.socket.connect(address)

    def follow(self):
        """Ask for what was missed, after each connect."""
        recv_monitor_message(self.monitor)
        self._forget()
        self._topic = f"\0replay/{self._client.name}/{next(self._nonces)}".encode()
        self._marker = b"\0".join([self._topic, b"%d" % self._newest, *(p.encode() for p in self._prefixes)])
        self.socket.send(b"\1" + self._marker)

    def _forget(self):
        if self._topic is not None:
            self.socket.send(b"\0" + self._marker)
            self._topic = None

    def take(self):
        """Take the next packet; what can't be read is dropped."""
        frames = [frame.buffer for frame in self.socket.recv_multipart(copy=False)]
        first = bytes(frames[0])
        if first[:1] == b"\0":
            if first != self._topic:
                return
            del frames[0]
            if not frames:
                self._forget()
                self.caught_up = True
                return
        elif first == b"KILL" and len(frames) == 1:
            self._client.ended = True
            threading.Thread(target=self._client.leave, args=(ENDED,), daemon=True).start()
            return
        try:
            packet = Packet(frames)
        except Exception as error:
            say(f"WARNING dropped a packet: {error}")
            return
        if packet.time_ns is not None:
            if packet.time_ns <= self._newest_of.get(packet.envelope, -1):
                return
            self._newest_of[packet.envelope] = packet.time_ns
            self._newest = max(self._newest, packet.time_ns)
        self._client.take(packet)


def started():
    """Return a client as the launch line says; the program ends when standard input does."""
    client = Client(json.loads(sys.stdin.readline()))
    threading.Thread(target=lambda: (sys.stdin.read(), client.leave(0)), daemon=True).start()
    return client


def in_base64(data):
    """Return bytes as text."""
    return base64.b64encode(data).decode()
