"""The port log: all inputs and outputs of a component, for a later replay without the experiment (`afspm what-if`).

Inputs: events of the port, readings of the clock, and the saved memory at each start of the process. Outputs: requests
and published packets, as bytes.

A line of the file is a list; its first item is its kind:

- ["life", facts]: a process starts.
- ["poll", timeout_s, monotonic_s, now_ns, events, readings]
- ["send", frames, handled, readings], ["publish", envelope, payload, handled, readings]
- ["end", how]: the process ends by itself; after a kill this line is missing.

`readings` are the readings of the clock since the previous line; `handled` is the packet whose handler sent a message.
Packets of scans and spectra above `INLINE_BYTES` have only time and envelope here: the run's record has their values.
"""

from __future__ import annotations

import json
import threading
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypedDict

from afspm import wire
from afspm.basics import PlainList, Publication
from afspm.basics.clock import Clock
from afspm.basics.plain_data import Plain
from afspm.client.keyed_results import kept_in
from afspm.model import Packet
from afspm.storage.line_log import REQUESTS_FOLDER, LineLog
from afspm.transport import Port
from afspm.transport.port import CaughtUp, Incoming, PacketReceived, ReplyReceived
from afspm.transport.process.context import ProcessContext

INLINE_BYTES = 4096
"""Packets of scans and spectra above this size are in the run's record only."""
SUFFIX = ".jsonl"
_IN_FILES = ("Scan2d", "Spec1d")


class LifeFacts(TypedDict):
    """The facts in a line "life".

    Attributes:
        launch: the launch line of the process, without its keys.
        speed: experiment time per real time.
        memory, measurements: texts of the files saved by the previous life; None if missing or damaged.
        results: names of the files with kept results.
    """

    launch: Plain
    session: str
    speed: float
    monotonic_s: float
    now_ns: int
    memory: str | None
    measurements: str | None
    results: list[str]


class RecordedClock:
    """A clock that records each reading by the component's own thread."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._thread = threading.get_ident()
        self._readings: PlainList = []

    def now_ns(self) -> int:
        time_ns = self._clock.now_ns()
        self._keep("n", time_ns)
        return time_ns

    def now_s(self) -> float:
        time_s = self._clock.now_s()
        self._keep("s", time_s)
        return time_s

    def monotonic_s(self) -> float:
        time_s = self._clock.monotonic_s()
        self._keep("m", time_s)
        return time_s

    def real_s(self, experiment_s: float) -> float:
        real_s = self._clock.real_s(experiment_s)
        self._keep("r", real_s)
        return real_s

    def late(self, since: float | Publication | None = None) -> AbstractContextManager[None]:
        return self._clock.late(since)

    def passing(self) -> AbstractContextManager[None]:
        return self._clock.passing()

    def published(self, what: Publication) -> None:
        self._clock.published(what)

    def awaits(self, what: Publication) -> bool:
        return self._clock.awaits(what)

    def taken(self) -> PlainList:
        """Return the readings since the last call, as a flat list: kind, value, kind, value …"""
        taken, self._readings = self._readings, []
        return taken

    def _keep(self, kind: str, value: float) -> None:
        if threading.get_ident() == self._thread:
            self._readings += (kind, value)


class RecordedPort:
    """A port (`afspm.transport.port.Port`) that passes all calls on to another port, and writes the port log.

    Args:
        wants: returns whether the component has a handler for a packet.
        handled: returns the packet of the running handler; None outside of handlers.
    """

    def __init__(
        self, port: Port, log: LineLog, wants: Callable[[Packet], bool], handled: Callable[[], Packet | None]
    ) -> None:
        self._port = port
        self._log = log
        self._wants = wants
        self._handled = handled
        self._real = port.clock
        self._clock = RecordedClock(port.clock)

    @property
    def clock(self) -> Clock:
        return self._clock

    def send(self, frames: Sequence[bytes]) -> None:
        # before the call: a kill in it may come when the request is on its way
        self._log.add(["send", [_text(frame) for frame in frames], self._place(), self._clock.taken()])
        with self._call():
            self._port.send(frames)

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        with self._call():
            came = self._port.poll(timeout_s)
        now = (self._real.monotonic_s(), self._real.now_ns())
        self._log.add(["poll", timeout_s, *now, [self._plain(one) for one in came], self._clock.taken()])
        return came

    def publish(self, envelope: str, payload: bytes) -> None:
        self._log.add(["publish", envelope, _text(payload), self._place(), self._clock.taken()])
        with self._call():
            self._port.publish(envelope, payload)

    def request_since(self, since_ns: int) -> None:
        self._port.request_since(since_ns)

    def wake_up(self, incoming: Incoming | None = None) -> None:
        self._port.wake_up(incoming)

    def wakeup_fileno(self) -> int:
        return self._port.wakeup_fileno()

    def close(self) -> None:
        self._port.close()

    def end(self, how: int | str) -> None:
        """Log that the component ends by itself; `how` is an exit code, or the type of an error."""
        self._log.add(["end", how])
        self._log.close()

    @contextmanager
    def _call(self) -> Iterator[None]:
        try:
            yield
        except Exception:
            raise
        except BaseException:  # the process dies in this call: the requests of its `finally` blocks count no more
            self._log.close()
            raise

    def _place(self) -> PlainList | None:
        packet = self._handled()
        return None if packet is None else [packet.time_ns, packet.envelope]

    def _plain(self, incoming: Incoming) -> PlainList:
        match incoming:
            case PacketReceived(packet, source):
                return ["packet", packet.envelope, packet.time_ns, source, self._payload(packet)]
            case ReplyReceived(response):
                return ["reply", *map(_text, wire.encode_response(response))]
            case CaughtUp(source):
                return ["caught up", source]
            case _:
                return [type(incoming).__name__]

    def _payload(self, packet: Packet) -> str | None:
        is_long = len(packet.payload) > INLINE_BYTES
        if packet.envelope.startswith("ScanLines"):  # many: kept only for a component that looks at them
            return _text(packet.payload) if self._wants(packet) else None
        return None if is_long and packet.envelope.startswith(_IN_FILES) else _text(packet.payload)


def recorded(
    port: Port, context: ProcessContext, wants: Callable[[Packet], bool], handled: Callable[[], Packet | None]
) -> RecordedPort:
    """Return a port that writes the port log of a process into the folder of its run."""
    launch = context.launch
    log = LineLog(log_path(Path(launch.run_dir or "."), launch.name), context.log)
    state = Path(launch.state_dir) if launch.state_dir else None
    facts: LifeFacts = {
        "launch": json.loads(replace(launch, keys=None, beat_token="").to_json()),
        "session": context.session,
        "speed": 1.0 / (port.clock.real_s(1.0) or 1.0),
        "monotonic_s": port.clock.monotonic_s(),
        "now_ns": port.clock.now_ns(),
        "memory": _content(state, f"{launch.name}.json"),
        "measurements": _content(state, f"{launch.name}.scope.json"),
        "results": [] if state is None else kept_in(state, launch.name),
    }
    log.add(["life", facts])
    return RecordedPort(port, log, wants, handled)


def log_path(run_dir: Path, name: str) -> Path:
    """Return the file of a component's port log."""
    return run_dir / REQUESTS_FOLDER / f"{name}{SUFFIX}"


def _content(folder: Path | None, name: str) -> str | None:
    try:
        return None if folder is None else (folder / name).read_text(encoding="utf-8")
    except (OSError, ValueError):  # none yet; a damaged one is read by `Memory`, which has the error
        return None


def _text(payload: bytes | memoryview) -> str:
    return b64encode(payload).decode()
