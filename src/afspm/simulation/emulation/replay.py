"""`TraceReplay`: an emulated controller that plays back a recorded trace, to reproduce a bug report."""

from __future__ import annotations

import json
import selectors
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import zmq

from afspm.basics import entry_points
from afspm.driver import Introduction
from afspm.simulation.emulation.emulator import LOOPBACK, Emulator
from afspm.simulation.emulation.playback import Deviation, Playback
from afspm.storage.atomic import write_atomic
from afspm.translator.driver import Driver
from afspm.translator.trace import ZEROMQ, TraceHeader, read_trace
from afspm.transport import milliseconds

RESULT = "replay.json"
_AT_ONCE = 1 << 16


@dataclass
class ReplayClient:
    """A client, identified by its TCP socket or its ZeroMQ identity.

    Attributes:
        introduction: the authentication before the client's first request; None without authentication.
    """

    number: int
    tcp: socket.socket | None = None
    introduction: Introduction | None = None
    identity: bytes = b""
    received: bytearray = field(default_factory=bytearray)


class TraceReplay(Emulator):
    """An emulated controller that gives a trace's recorded answers, and reports the first different request.

    Args:
        trace: the file (`afspm trace`).
        files: the folder for the controller's files; by default the emulator's own folder. The translator must read
            this folder: session_dir, folders or scan_dir in its section.
        common: arguments of every emulator.

    Attributes:
        deviation: the first difference; empty without one.
    """

    vendor: ClassVar[str] = "replayed"

    def __init__(self, *, trace: str, files: str = "", **common: Any) -> None:
        super().__init__(**common)
        self._trace = Path(trace)
        self._files = Path(files) if files else None
        self.deviation = ""

    def check(self) -> None:
        super().check()
        read_trace(self._trace)

    def open(self) -> str:
        lines = read_trace(self._trace)
        self._introductions = _introductions(lines[0])
        self.playback = Playback(lines)
        self._clients: list[ReplayClient] = []
        if self.playback.transport == ZEROMQ:
            return self._open_zeromq()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self.woken.fileno(), selectors.EVENT_READ)
        self._listener = socket.create_server((LOOPBACK, self.port))
        self._selector.register(self._listener, selectors.EVENT_READ)
        return f"{LOOPBACK}:{self._listener.getsockname()[1]}"

    def _open_zeromq(self) -> str:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._router: zmq.Socket[bytes] = self._context.socket(zmq.ROUTER)
        self._router.setsockopt(zmq.LINGER, 0)
        self._router.bind(f"tcp://{LOOPBACK}:{self.port or '*'}")
        return self._router.getsockopt_string(zmq.LAST_ENDPOINT)

    def serve(self, timeout_s: float) -> None:
        if self.playback.transport == ZEROMQ:
            self._serve_zeromq(timeout_s)
        else:
            self._serve_tcp(timeout_s)
        while any(self._answer(client) for client in self._clients):
            pass  # repeated, since the answer to one client may release the answer to another
        self._write_files()

    def _serve_tcp(self, timeout_s: float) -> None:
        for key, _ in self._selector.select(timeout_s):
            if key.fileobj is self._listener:
                connected, _ = self._listener.accept()
                address = "{}:{}".format(*connected.getsockname())
                introduction = None if self._introductions is None else self._introductions(address)
                client = ReplayClient(self.playback.connect(), connected, introduction)
                self._clients.append(client)
                self._selector.register(connected, selectors.EVENT_READ, client)
            elif isinstance(key.data, ReplayClient) and key.data.tcp is not None:
                self._receive(key.data, key.data.tcp)

    def _receive(self, client: ReplayClient, tcp: socket.socket) -> None:
        part = b""
        with suppress(OSError):
            part = tcp.recv(_AT_ONCE)
        client.received += part
        if not part:
            self._drop(client)
        while b"\n" in client.received and client.introduction is not None and not client.introduction.is_over:
            line, _, rest = client.received.partition(b"\n")
            client.received[:] = rest
            reply = client.introduction.reply_to(bytes(line))
            if not reply:
                self._drop(client)
                return
            tcp.sendall(reply.encode() + b"\n")

    def _serve_zeromq(self, timeout_s: float) -> None:
        poller = zmq.Poller()
        poller.register(self.woken, zmq.POLLIN)
        poller.register(self._router, zmq.POLLIN)
        if self._router not in dict(poller.poll(milliseconds(timeout_s))):
            return
        identity, *frames = self._router.recv_multipart()
        client = next((one for one in self._clients if one.identity == identity), None)
        if client is None:
            client = ReplayClient(self.playback.connect(), identity=identity)
            self._clients.append(client)
        client.received[:] = frames[-1]

    def _answer(self, client: ReplayClient) -> bool:
        is_stranger = client.introduction is not None and not client.introduction.is_over
        if not client.received or is_stranger:
            return False
        try:
            answer = self.playback.ask(client.number, bytes(client.received))
        except Deviation as deviation:
            if not self.deviation:
                self.deviation = str(deviation)
                self.log.error("REPLAY differs from the recording at %s", deviation)
            self._drop(client)
            return True
        if answer is None:
            return False
        client.received.clear()
        if answer.content is None:
            self._drop(client)
        elif client.tcp is not None:
            client.tcp.sendall(answer.content)
        else:
            self._router.send_multipart([client.identity, b"", answer.content])
        return True

    def _drop(self, client: ReplayClient) -> None:
        # ZeroMQ has no connection to end: its client gets no answer
        client.received.clear()
        if client.tcp is not None:
            self._selector.unregister(client.tcp)
            client.tcp.close()
            client.tcp = None

    def _write_result(self) -> None:
        left = len(self.playback.missing)
        if not self.deviation:
            state = f"{left} exchanges of requests were not asked again" if left else "all was asked again"
            self.log.info("REPLAY: no difference from the recording; %s", state)
        facts = {"deviation": self.deviation, "not_asked": left, "same": not self.deviation and not left}
        write_atomic(self.folder / RESULT, [json.dumps(facts, ensure_ascii=False).encode()])

    def _write_files(self) -> None:
        folder = self._files or self.folder
        for one in self.playback.files():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / one.file).write_bytes(one.content)

    def close(self) -> None:
        if not hasattr(self, "playback"):
            return
        self._write_result()
        if self.playback.transport == ZEROMQ:
            self._context.destroy(linger=0)
            return
        for client in self._clients:
            if client.tcp is not None:
                client.tcp.close()
        self._listener.close()
        self._selector.close()


def _introductions(header: object) -> Callable[[str], Introduction] | None:
    name = header.driver if isinstance(header, TraceHeader) else ""
    driver: type[Driver] | None = entry_points.load(entry_points.DRIVERS, name)
    return None if driver is None else driver.introductions()
