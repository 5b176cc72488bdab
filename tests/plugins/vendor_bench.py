"""Shared parts of the makers' tests: a translator as a process, an emulated microscope, and a raw peer."""

from __future__ import annotations

import itertools
import json
import math
import os
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Condition, Event, Thread
from typing import IO, Any, ClassVar, Generic, TypeVar

import zmq
from deadlines import DEADLINE_S
from tests.plugins.hosts import host

from afspm import wire
from afspm.basics import ExitCode, ExperimentClock, Launch, Sockets
from afspm.emulation import Emulator
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Region,
    Request,
    Response,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.simulation.faults import Fault
from afspm.supervisor import FreePorts

PATIENT: Mapping[str, Any] = {"reply_timeout_s": 120.0}
"""As long as a controller on a busy computer may need to answer."""

SOON: Mapping[str, Any] = {"reply_timeout_s": 2.5}
"""For tests of a silent controller."""

TURNED = Region((40e-9, -25e-9), (300e-9, 100e-9), math.radians(30))
"""An oblong, rotated frame away from the middle, so that no two values can be confused."""

SHAPE = (12, 32)
FLAT = {"noise": {"white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0}}
"""A microscope without noise."""


class Peer:
    """The translator's scheduler, as a raw peer."""

    def __init__(self, serve: str, publish: str) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self._asked = (f"bench/{secrets.token_hex(4)}/{number}" for number in itertools.count())
        self._request = self._context.socket(zmq.REQ)
        self._request.connect(serve)
        self._packets = self._context.socket(zmq.SUB)
        for prefix in (b"", b"ScanLines"):  # by the first a plain socket means what version 1 has
            self._packets.subscribe(prefix)
        self._packets.connect(publish)
        self.newest_ns: dict[bytes, int] = {}
        for each in (self._request, self._packets):
            each.setsockopt(zmq.LINGER, 0)
            each.setsockopt(zmq.RCVTIMEO, int(DEADLINE_S * 1000))

    def ask(self, kind: int, subject: Any) -> Response:
        request = Request(kind, subject, wire.frames.encode_subject(subject), next(self._asked))
        self._request.send_multipart(wire.encode_request(request))
        return wire.decode_response(self._request.recv_multipart())

    def act(self, action: str) -> Response:
        return self.ask(ControlRequest.ACTION, action)

    def act_once_free(self, action: str) -> Response:
        """Repeat a request until the answer is not "busy"; return the answer."""
        deadline_s = time.monotonic() + DEADLINE_S
        while (response := self.act(action)).code == ControlResponse.NOT_FREE:
            assert time.monotonic() < deadline_s, response.reason
        return response

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

    def has_news(self, within_s: float) -> bool:
        """Return whether a packet arrives within some real time."""
        return bool(self._packets.poll(round(1000.0 * within_s)))

    def next(self) -> Any:
        """Return the next published packet; one that a replay repeats, or that is older than what came, is skipped."""
        while True:
            envelope, payload, stamp = self._packets.recv_multipart()
            time_ns = wire.frames.decode_time(stamp)
            # a plain socket that has just joined gets what is kept after what is published meanwhile
            if time_ns > self.newest_ns.get(envelope, 0):
                self.newest_ns[envelope] = time_ns
                return wire.decode(envelope.decode(), payload)

    def until(self, wanted: Callable[[Any], bool] | ScopeState) -> list[Any]:
        """Return all published packets up to the first wanted one."""
        received: list[Any] = []
        deadline_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline_s:
            try:
                received.append(self.next())
            except zmq.Again:
                break
            newest = received[-1]
            if newest == ScopeStatus(wanted) if isinstance(wanted, ScopeState) else wanted(newest):
                return received
        raise AssertionError(f"waited for {wanted}, received {received}")

    def close(self) -> None:
        self._context.destroy(linger=0)


class TranslatorLog:
    """The lines of a translator's standard error, over all its restarts."""

    def __init__(self) -> None:
        self.text = ""
        self._more = Condition()

    def listen(self, pipe: IO[bytes]) -> None:
        """Collect lines until the stream ends."""
        with pipe:
            for line in pipe:
                with self._more:
                    self.text += line.decode()
                    self._more.notify_all()

    def until(self, *wanted: str) -> None:
        """Wait for a line with one of the texts."""
        with self._more:
            found = self._more.wait_for(lambda: any(words in self.text for words in wanted), DEADLINE_S)
            assert found, f"the translator never logged {wanted}:\n{self.text}"


class TranslatorProcess:
    """A translator as a process, and its peer; both end with the stack."""

    def __init__(
        self,
        class_: str,
        settings: dict[str, Any],
        folder: Path,
        stack: ExitStack,
        clock: ExperimentClock,
        log: TranslatorLog | None = None,
        *,
        retracts: bool = False,
    ) -> None:
        ports = FreePorts()
        serve, publish = f"tcp://127.0.0.1:{ports.take()}", f"tcp://127.0.0.1:{ports.take()}"
        launch = Launch(
            "translator",
            class_,
            settings,
            Sockets(publish=publish, serve=serve),
            clock=clock.as_dict(),
            run_dir=str(folder),
            state_dir=str(folder / "state"),
            retracts=retracts,
        )
        self._process = host({**os.environ, "TMPDIR": str(folder), "TEMP": str(folder)})
        self._listening = Thread(target=(log or TranslatorLog()).listen, args=(self._process.stderr,))
        self._listening.start()
        stack.callback(self._end)
        self._process.stdin.write(launch.to_json().encode() + b"\n")
        self._process.stdin.flush()
        self.peer = Peer(serve, publish)
        stack.callback(self.peer.close)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(DEADLINE_S)
        self._listening.join(DEADLINE_S)

    def let_go(self) -> int:
        """Close its standard input, as a stopped run does; return the exit code."""
        self._process.stdin.close()
        code = self._process.wait(DEADLINE_S)
        self._listening.join(DEADLINE_S)
        return code

    def _end(self) -> None:
        self.kill()
        self._process.stdin.close()


class AtPanel(Emulator):
    """An emulator with a person at its panel."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.to_do: SimpleQueue[Callable[[], None]] = SimpleQueue()

    def tick(self, now_s: float) -> float | None:
        while not self.to_do.empty():
            self.to_do.get()()
        return super().tick(now_s)


Emulated = TypeVar("Emulated", bound=AtPanel)


class VendorBench(Generic[Emulated]):
    """An emulator and its translator. Each maker's bench names both::

        class Bench(VendorBench[Emulated]): emulated = Emulated translator = "afspm.plugins.mine.Mine" data_name =
            "mine" settings = PATIENT

    Attributes:
        emulated: class of the emulator.
        translator: class of the translator, as in an experiment file.
        data_name: name of the folder in which the emulator saves.
        settings: default settings of the translator, besides the address.
    """

    emulated: type[Emulated]
    translator: ClassVar[str]
    data_name: ClassVar[str]
    settings: Mapping[str, Any]

    def __init__(self, folder: Path, stack: ExitStack, speed: float, emulator: dict[str, Any]) -> None:
        self.folder, self._stack = folder, stack
        self.clock = ExperimentClock.starting_now(speed=speed)
        self.data = folder / self.data_name
        self._log = TranslatorLog()
        stack.callback(lambda: print(self._log.text))  # noqa: T201 (shown of a test that failed)
        self._emulator_settings: dict[str, Any] = {"port": FreePorts().take(), "surface": "steps", **emulator}
        self._controller = stack.enter_context(ExitStack())
        self.start_controller_again()

    def start_controller_again(self, **settings: Any) -> None:
        """Start a new controller at the address of the last one, without its state, and with changed settings."""
        self._controller.close()
        self.emulator = self.emulated(**{**self._emulator_settings, **settings})
        self.address = self._controller.enter_context(self.emulator.running(self.data, self.clock))

    def at_panel(self, do: Callable[[Emulated], object]) -> None:
        """Execute something in the emulator's thread; return when done."""
        done = Event()

        def job() -> None:
            do(self.emulator)
            done.set()

        self.emulator.to_do.put(job)
        self.emulator.woken.post()
        assert done.wait(DEADLINE_S)

    def strike(self, kind: str, count: int = 1, duration_s: float = 1.0) -> None:
        """Trigger a fault now."""
        fault = Fault(kind, 0.0, count, duration_s)
        self.at_panel(lambda emulator: emulator.faults.demand(fault, self.clock.now_s()))

    def start(self, *, retracts: bool = False, **settings: Any) -> Peer:
        """Start the translator as a process."""
        given = {"address": self.address, **self.settings, **settings}
        self._process = TranslatorProcess(
            self.translator, given, self.folder, self._stack, self.clock, self._log, retracts=retracts
        )
        return self._process.peer

    def events(self, kind: str) -> list[dict[str, Any]]:
        """Return the events of a kind in the emulator's ground truth."""
        lines = (self.data / "truth.jsonl").read_text(encoding="utf-8").splitlines()
        return [event for event in map(json.loads, lines) if event["event"] == kind]

    def kill(self) -> None:
        """Kill the translator."""
        self._process.kill()

    def let_go(self) -> int:
        """Stop the translator as a stopped run does; return its exit code."""
        return self._process.let_go()

    def log_text(self) -> str:
        """Return the translator's log so far; complete once it is killed."""
        return self._log.text

    def until_logged(self, *wanted: str) -> None:
        """Wait until the translator's log contains one of the texts."""
        self._log.until(*wanted)


OneBench = TypeVar("OneBench", bound=VendorBench[Any])


def benches(kind: type[OneBench], folder: Path) -> Iterator[Callable[..., OneBench]]:
    """Yield a maker's `bench` fixture: makes benches that end with the test."""
    with ExitStack() as stack:

        def make(speed: float = 100.0, **emulator: Any) -> OneBench:
            return kind(folder, stack, speed, emulator)

        yield make


# --- received packets, and starts of tests ---


def states(received: Sequence[Any]) -> list[str]:
    """Return the states in received packets."""
    return [one.state.name for one in received if isinstance(one, ScopeStatus)]


def scans(received: Sequence[Any]) -> list[Scan]:
    return [one for one in received if isinstance(one, Scan)]


def ready(peer: Peer, region: Region = TURNED, shape: tuple[int, int] = SHAPE) -> None:
    """Set a small frame, and receive all packets about it."""
    peer.until(ScopeState.FREE)
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, shape, ""))
    assert response.ok, response.reason
    peer.until(lambda one: isinstance(one, ScanParameters) and one.region == region and one.shape == shape)
    peer.until(ScopeState.FREE)


def small(made: VendorBench[Any], **settings: Any) -> Peer:
    """Start a translator that has found the microscope, with a frame of few pixels."""
    peer = made.start(**settings)
    peer.until(ScopeState.FREE)
    assert peer.set(names.SCAN_RESOLUTION_X, 16).ok
    assert peer.set(names.SCAN_RESOLUTION_Y, 8).ok
    peer.until(lambda one: getattr(one, "shape", None) == (8, 16))
    peer.until(ScopeState.FREE)
    return peer


def scanned(peer: Peer) -> dict[str, Scan]:
    """Scan; return the scan by channel."""
    response = peer.act(names.START_SCAN)
    assert response.ok, response.reason
    received = peer.until(ScopeState.FREE)
    assert states(received) == ["SCANNING", "FREE"]
    found = scans(received)
    assert received[-1 - len(found) : -1] == found, "the scans come before FREE, and nothing in between"
    return {scan.channel: scan for scan in found}


def moved(peer: Peer, x_m: float, y_m: float) -> list[Any]:
    """Move the probe; return all packets received meanwhile."""
    response = peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((x_m, y_m)))
    assert response.ok, response.reason
    received = peer.until(ScopeState.FREE)
    assert states(received) == ["MOVING", "FREE"]
    return received


def left_in_danger(made: VendorBench[Any], *, scanning: bool, retracts: bool) -> None:
    """Stop a run while the feedback is off, switched off by one of its components."""
    peer = made.start(retracts=retracts)
    ready(peer, shape=(64, 32))
    assert peer.set(names.FEEDBACK_ON, False).ok
    if scanning:
        assert peer.act(names.START_SCAN).ok
        peer.until(ScopeState.SCANNING)
    assert made.emulator.rig.engaged
    assert made.let_go() == ExitCode.ORPHAN


@contextmanager
def answering(*replies: bytes, silent: bool = False) -> Iterator[tuple[str, int]]:
    """Return the address of a server that answers each request with the next of some bytes, and may then disconnect."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ended = Thread(target=_answer, args=(listener, replies, silent))
        ended.start()
        try:
            yield listener.getsockname()
        finally:
            ended.join()


def _answer(listener: socket.socket, replies: tuple[bytes, ...], silent: bool) -> None:
    client, _ = listener.accept()
    with client, suppress(OSError):
        for reply in replies:
            client.recv(1000)
            client.sendall(reply)
        client.settimeout(DEADLINE_S)
        while silent and client.recv(1000):
            pass
