"""The translator as a real process, an emulated GXSM beside it, and a peer on the translator's sockets."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

import pytest
import zmq

from afspm import wire
from afspm.clock import ExperimentClock
from afspm.emulators.faults import Fault
from afspm.emulators.gxsm import GxsmEmulator
from afspm.model import ControlRequest, Parameter, Request, Response, Scan, ScopeState, ScopeStatus
from afspm.runtime.launch import Launch, Sockets
from afspm.supervisor.ports import FreePorts

DEADLINE_S = 30.0


class Peer:
    """What a scheduler is to the translator."""

    def __init__(self, serve: str, publish: str) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self._request = self._context.socket(zmq.REQ)
        self._request.connect(serve)
        self._packets = self._context.socket(zmq.SUB)
        self._packets.subscribe(b"")
        self._packets.connect(publish)
        for socket in (self._request, self._packets):
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.RCVTIMEO, int(DEADLINE_S * 1000))
            socket.setsockopt(zmq.RECONNECT_IVL, 20)

    def ask(self, kind: int, subject: Any) -> Response:
        request = Request(kind, subject, wire.frames.encode_subject(subject))
        self._request.send_multipart(wire.encode_request(request))
        return wire.decode_response(self._request.recv_multipart())

    def act(self, action: str) -> Response:
        return self.ask(ControlRequest.ACTION, action)

    def set(self, name: str, value: object, unit: str | None = None) -> Response:
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return self.ask(ControlRequest.PARAM, Parameter(name, text, unit))

    def get_response(self, name: str) -> Response:
        return self.ask(ControlRequest.PARAM, Parameter(name))

    def get(self, name: str) -> str:
        response = self.get_response(name)
        assert response.ok, response.reason
        value = wire.frames.decode_parameter(response.payload).value
        assert value is not None
        return value

    def next(self) -> Any:
        """The next thing that is published."""
        envelope, payload, *_ = self._packets.recv_multipart()
        return wire.decode(envelope.decode(), payload)

    def until(self, wanted: Callable[[Any], bool] | ScopeState) -> list[Any]:
        """All that is published up to the first that is wanted."""
        heard: list[Any] = []
        deadline_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline_s:
            try:
                heard.append(self.next())
            except zmq.Again:
                break
            newest = heard[-1]
            if newest == ScopeStatus(wanted) if isinstance(wanted, ScopeState) else wanted(newest):
                return heard
        raise AssertionError(f"waited for {wanted}, heard {heard}")

    def close(self) -> None:
        self._context.destroy(linger=0)


def states(heard: Sequence[Any]) -> list[str]:
    """The states among what was heard, in words."""
    return [one.state.name for one in heard if isinstance(one, ScopeStatus)]


def scans(heard: Sequence[Any]) -> list[Scan]:
    return [one for one in heard if isinstance(one, Scan)]


class Emulated(GxsmEmulator):
    """With somebody at its panel."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.to_do: SimpleQueue[Callable[[], None]] = SimpleQueue()

    def tick(self, now_s: float) -> float | None:
        while not self.to_do.empty():
            self.to_do.get()()
        return super().tick(now_s)


class Process:
    """A translator, with the peer that it has."""

    def __init__(self, folder: Path, stack: ExitStack, clock: ExperimentClock, settings: dict[str, Any]) -> None:
        self.log = folder / "log.txt"
        ports = FreePorts()
        serve, publish = f"tcp://127.0.0.1:{ports.take()}", f"tcp://127.0.0.1:{ports.take()}"
        launch = Launch(
            "translator",
            "afspm.microscopes.gxsm.Gxsm",
            settings,
            Sockets(publish=publish, serve=serve),
            clock=clock.as_dict(),
            run_dir=str(folder),
            state_dir=str(folder / "state"),
            simulated=clock.real_s(1.0) != 1.0,
        )
        with self.log.open("ab") as log:
            command = [sys.executable, "-m", "afspm.runtime.host"]
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log)
        stack.callback(self._end)
        assert self.process.stdin is not None
        self.process.stdin.write(launch.to_json().encode() + b"\n")
        self.process.stdin.flush()
        self.peer = Peer(serve, publish)
        stack.callback(self.peer.close)

    def _end(self) -> None:
        self.process.kill()
        self.process.wait(DEADLINE_S)
        assert self.process.stdin is not None
        self.process.stdin.close()


class Bench:
    """An emulator and a translator of it."""

    def __init__(self, folder: Path, stack: ExitStack, speed: float, emulator: dict[str, Any]) -> None:
        if emulator.get("transport") == "shm" and not sys.platform.startswith("linux"):
            pytest.skip("Gxsm4's shared memory is there on Linux alone")
        self.folder, self._stack, self._speed = folder, stack, speed
        self.clock = ExperimentClock.starting_now(speed=speed)
        block = f"afspm_test_{os.getpid()}_{id(self)}"
        self._settings = {"port": 0, "surface": "steps", "block": block, **emulator}
        self.files = folder / "gxsm"
        self._start_controller()
        self.log = folder / "log.txt"

    def _start_controller(self) -> None:
        self.emulator = Emulated(**self._settings)
        self.address = self._stack.enter_context(self.emulator.running(self.files, self.clock))

    def start_controller_again(self) -> None:
        """Another one where the last was, which knows nothing of it."""
        if not self.address.startswith("shm"):
            self._settings["port"] = int(self.address.rpartition(":")[2])
        self._start_controller()

    def at_panel(self, do: Callable[[Emulated], None]) -> None:
        """Do something in the emulator's own thread; returns when it is done."""
        done = Event()

        def job() -> None:
            do(self.emulator)
            done.set()

        self.emulator.to_do.put(job)
        self.emulator.woken.post()
        assert done.wait(DEADLINE_S)

    def strike(self, kind: str, count: int = 1, duration_s: float = 1.0) -> None:
        """Have something go wrong from now on."""
        fault = Fault(kind, 0.0, count, duration_s)
        self.at_panel(lambda emulator: emulator.faults.demand(fault, self.clock.now_s()))

    def start(self, **settings: Any) -> Peer:
        """The translator, as a process of its own."""
        given = {"address": self.address, "reply_timeout_s": 2.0, "result_timeout_s": 2.0 * self._speed} | settings
        self._process = Process(self.folder, self._stack, self.clock, given)
        return self._process.peer

    def kill(self) -> None:
        """The translator."""
        self._process.process.kill()
        self._process.process.wait(DEADLINE_S)

    def said(self) -> str:
        """The translator's log."""
        return self.log.read_text()
