"""The simulated microscope as a real process, and peers that know nothing but the wire format."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.supervisor.ports import FreePorts
from afspm.wire.generated import control_pb2, feedback_pb2, scan_pb2, spectroscopy_pb2

MESSAGES: dict[str, Any] = {
    "ScopeStateMsg": control_pb2.ScopeStateMsg,
    "ScanParameters2d": scan_pb2.ScanParameters2d,
    "Scan2d": scan_pb2.Scan2d,
    "Spec1d": spectroscopy_pb2.Spec1d,
    "ProbePosition": spectroscopy_pb2.ProbePosition,
    "ZCtrlParameters": feedback_pb2.ZCtrlParameters,
}


class Peer:
    """A scheduler of version 1: a REQ and a SUB socket, plain frames, generated messages."""

    def __init__(self, serve: str, publish: str) -> None:
        self._context = zmq.Context()
        self._serve = serve
        self._request = self._connected()
        self._subscriber = self._context.socket(zmq.SUB)
        self._subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        self._subscriber.setsockopt(zmq.RECONNECT_IVL, 20)
        self._subscriber.connect(publish)
        self._newest = b""

    def _connected(self) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.REQ)
        socket.setsockopt(zmq.RECONNECT_IVL, 20)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self._serve)
        return socket

    def ask(self, number: int, payload: bytes | None = None, request_id: str = "") -> list[bytes]:
        frames = [bytes([number])]
        if payload is not None or request_id:
            frames.append(payload or b"")
        if request_id:
            frames.append(request_id.encode())
        answer = self.ask_frames(frames, DEADLINE_S)
        assert answer is not None, "no answer"
        return answer

    def ask_frames(self, frames: list[bytes], timeout_s: float) -> list[bytes] | None:
        """The answer, or None: then the socket is a new one, as a peer of version 1 has to do it."""
        self._request.send_multipart(frames)
        if self._request.poll(int(timeout_s * 1000)):
            return self._request.recv_multipart()
        self._request.close()
        self._request = self._connected()
        return None

    def act(self, name: str, request_id: str = "") -> int:
        return self.ask(1, control_pb2.ActionMsg(action=name).SerializeToString(), request_id)[0][0]

    def set(self, name: str, value: str, unit: str | None = None) -> list[bytes]:
        return self.ask(2, control_pb2.ParameterMsg(parameter=name, value=value, units=unit).SerializeToString())

    def get(self, name: str) -> tuple[str, str]:
        answer = self.ask(2, control_pb2.ParameterMsg(parameter=name).SerializeToString())
        assert answer[0] == b"\0", answer
        message = control_pb2.ParameterMsg.FromString(answer[1])
        return message.value, message.units

    def next(self, timeout_s: float = DEADLINE_S) -> tuple[str, Any, bytes] | None:
        """The next packet: envelope, message, timestamp."""
        while self._subscriber.poll(int(timeout_s * 1000)):
            envelope, payload, stamp = self._subscriber.recv_multipart()
            if envelope.decode() in MESSAGES:
                return envelope.decode(), MESSAGES[envelope.decode()].FromString(payload), stamp
        return None

    def until(self, state: int) -> list[tuple[str, Any]]:
        """All that is heard up to this state, the state included."""
        heard: list[tuple[str, Any]] = []
        deadline_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline_s:
            packet = self.next(deadline_s - time.monotonic())
            assert packet is not None, f"waited for state {state}, heard {heard}"
            heard.append(packet[:2])
            if packet[0] == "ScopeStateMsg" and packet[1].scope_state == state:
                return heard
        raise AssertionError(f"waited for state {state}, heard {heard}")

    def ready(self) -> Peer:
        """Once everything that comes of having subscribed has been heard; what comes next is news."""
        self.until(3)
        value, unit = self.get("zctrl-pgain")
        for mark in ("0.375", value):  # a float32 keeps it exactly
            assert self.set("zctrl-pgain", mark, unit or None)[0] == b"\0"
            packet = None
            while not (
                packet and packet[0] == "ZCtrlParameters" and abs(packet[1].proportionalGain - float(mark)) < 1e-6
            ):
                packet = self.next()
                assert packet is not None
        return self

    def close(self) -> None:
        self._context.destroy(linger=0)


class Running:
    """A translator process that can be killed and started again."""

    def __init__(self, folder: Path, settings: dict[str, Any], speed: float) -> None:
        ports = FreePorts()
        self.folder, self.log = folder, folder / "log.txt"
        self.serve, self.publish = f"tcp://127.0.0.1:{ports.take()}", f"tcp://127.0.0.1:{ports.take()}"
        self.clock = ExperimentClock.starting_now(start_s=1_767_225_600.0, speed=speed)
        self.launch = Launch(
            "translator",
            "afspm.simulation.simulator.Simulator",
            settings,
            Sockets(publish=self.publish, serve=self.serve),
            clock=self.clock.as_dict(),
            run_dir=str(folder),
            state_dir=str(folder / "state"),
            simulated=True,
        )
        self._peers: list[Peer] = []
        self.start()

    def start(self) -> None:
        self.folder.mkdir(exist_ok=True)
        # into a file: a pipe that nobody reads fills up and holds the process
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "afspm.supervisor.host"], stdin=subprocess.PIPE, stderr=log
            )
        assert self.process.stdin is not None
        self.process.stdin.write(self.launch.to_json().encode() + b"\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        self.process.kill()
        self._reap()

    def wait(self, timeout_s: float) -> int:
        """The exit code of a process that ends by itself."""
        code = self.process.wait(timeout_s)
        self._reap()
        return code

    def _reap(self) -> None:
        self.process.wait(DEADLINE_S)
        assert self.process.stdin is not None
        self.process.stdin.close()

    def peer(self) -> Peer:
        peer = Peer(self.serve, self.publish)
        self._peers.append(peer)
        return peer

    def truth(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "truth.jsonl").read_text().splitlines()]

    def stop(self) -> int:
        """End its standard input, as a parent that goes does; returns the exit code."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        return self.process.wait(DEADLINE_S)

    def close(self) -> None:
        for peer in self._peers:
            peer.close()
        if self.process.poll() is None:
            self.process.kill()
        self._reap()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Any]:
    running: list[Running] = []

    def start(settings: dict[str, Any] | None = None, speed: float = 1000.0) -> Running:
        quick = {"initial": {"scan-resolution-x": 16, "scan-resolution-y": 8}}
        running.append(Running(tmp_path / str(len(running)), quick | (settings or {}), speed))
        return running[-1]

    yield start
    for one in running:
        one.close()
