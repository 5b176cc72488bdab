"""A scheduler in its own process, with the test as its translator and its components."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from deadlines import DEADLINE_S

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.model import ControlRequest, ControlResponse, Request, Response
from afspm.supervisor.ports import FreePorts
from afspm.transport import keys
from afspm.transport.network import Network
from afspm.transport.port import ControlConnected, ControlDisconnected, PacketReceived, ReplyReceived, RequestReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort

ANY = "tcp://127.0.0.1:0"


class Component:
    """A component that records received packets."""

    def __init__(self, rig: Rig, name: str, envelopes: list[str] | None, owner: str) -> None:
        self._rig, self.name = rig, name
        network = rig.network(owner or name, {rig.publish: "scheduler", rig.serve: "scheduler"})
        self.port = ZmqPort(network, name, rig.clock, subscribe=[rig.publish], envelopes=envelopes, control=rig.serve)
        self.found: list[Any] = []
        self._asked = 0

    def send(self, kind: int, subject: Any = None, key: str | None = None) -> str:
        """Send a request; return its id."""
        self._asked += 1
        request_id = key or f"{self.name}/session/{self._asked}"
        self.port.send(wire.encode_request(Request(kind, subject, id=request_id)))
        return request_id

    def answer_to(self, request_id: str) -> Response | None:
        answers = [i.response for i in self.found if isinstance(i, ReplyReceived) and i.response.id == request_id]
        return answers[-1] if answers else None

    def ask(self, kind: int, subject: Any = None, key: str | None = None) -> Response:
        """Send a request once the scheduler is connected, and wait for the answer."""
        self._rig.until(self.connected)
        request_id = self.send(kind, subject, key)
        answer: Response = self._rig.until(lambda: self.answer_to(request_id))
        return answer

    def packets(self, prefix: str = "") -> list[tuple[str, bytes]]:
        return [
            (i.packet.envelope, bytes(i.packet.payload))
            for i in self.found
            if isinstance(i, PacketReceived) and i.packet.envelope.startswith(prefix)
        ]

    def connected(self) -> bool:
        """Whether it counts as connected; requests without a connection are dropped."""
        changes = [i for i in self.found if isinstance(i, ControlConnected | ControlDisconnected)]
        return bool(changes) and isinstance(changes[-1], ControlConnected)


class Rig:
    """Scheduler, translator and components. `asked` has the translator's requests; `answer` gives their answers."""

    def __init__(self, folder: Path, keys_folder: Path | None = None) -> None:
        self._folder = folder
        self._keys_folder = keys_folder
        self.clock = ExperimentClock.real()
        ports = FreePorts()
        self.publish, self.serve = ports.address(), ports.address()
        self.answer: Callable[[Request], Response | None] = lambda request: Response(0, id=request.id)
        self.asked: list[Request] = []
        self.components: list[Component] = []
        self.peers: list[Any] = []  # of version 1
        self.settings: dict[str, Any] = {}
        self.request_timeout_s = 20.0
        self.class_ = "afspm.scheduler.Scheduler"
        self.translator: ZmqServerPort | None = self.make_translator(ANY, ANY)
        self.source = str(self.translator.publish_address), self.translator.serve_address
        self.process: subprocess.Popen[bytes] | None = None

    def make_translator(self, publish: str, serve: str) -> ZmqServerPort:
        return ZmqServerPort(self.network("translator"), self.clock, serve=serve, publish=publish, allowed="scheduler")

    def network(self, owner: str, servers: dict[str, str] | None = None) -> Network:
        return Network(None if self._keys_folder is None else keys.load(self._keys_folder, owner, servers))

    def launch(self) -> Launch:
        return Launch(
            "scheduler",
            self.class_,
            self.settings,
            Sockets(self.publish, (self.source[0],), self.serve, self.source[1]),
            clock=self.clock.as_dict(),
            state_dir=str(self._folder / "state"),
            request_timeout_s=self.request_timeout_s,
            keys=None
            if self._keys_folder is None
            else {"folder": str(self._keys_folder), **dict.fromkeys(self.source, "translator")},
        )

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "afspm.supervisor.host"], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        assert self.process.stdin is not None
        self.process.stdin.write(self.launch().to_json().encode() + b"\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()

    def component(self, name: str, envelopes: list[str] | None = None, owner: str = "") -> Component:
        """Return a connected component with the key of `owner`, or its own."""
        component = Component(self, name, envelopes, owner)
        self.components.append(component)
        self.until(component.connected)
        return component

    def linked(self, component: Component) -> None:
        """Wait until the scheduler has found its translator: earlier requests are refused."""
        self.until(lambda: component.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok)
        self.asked.clear()

    def pump(self) -> None:
        """Process pending messages of all parts played by the test."""
        if self.translator is not None:
            for received in self.translator.poll(0.001):
                if isinstance(received, RequestReceived):
                    if received.frames == [wire.CLOSE]:  # as a translator of version 1 would
                        self.translator.reply([bytes([ControlResponse.CMD_NOT_SUPPORTED])])
                        continue
                    request = wire.decode_request(received.frames)
                    if not request.id.startswith("scheduler/"):
                        self.asked.append(request)
                    response = self.answer(request)
                    self.translator.reply(None if response is None else wire.encode_response(response))
        for component in self.components:
            component.found += component.port.poll(0.001)
        for peer in self.peers:
            peer.pump()

    def until(self, condition: Callable[[], Any], timeout_s: float = DEADLINE_S) -> Any:
        """Pump until the condition is true; return its value."""
        deadline_s = time.monotonic() + timeout_s
        while not (value := condition()):
            assert time.monotonic() < deadline_s, "it did not happen in time"
            assert self.process is None or self.process.poll() is None or self.process.returncode >= 80
            self.pump()
        return value

    def publish_packet(self, name: str, payload: bytes) -> None:
        assert self.translator is not None
        self.translator.publish(name, payload)

    def close(self) -> None:
        for component in self.components:
            component.port.close()
        if self.translator is not None:
            self.translator.close()
        if self.process is not None:
            self.kill()
