"""The time of a request to translators of vendors' controllers.

Where the maker has a Python client, a plain script with this client does the same work at an emulated controller of its
own, and the row is the ratio of both, the waits for the controllers included. Elsewhere the row is the time that the
translator adds: everything except the wait for the controller.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from afspm import wire
from afspm.basics import entry_points
from afspm.model import ControlRequest, Parameter, Region, Request, ScanParameters, ScopeState, names
from afspm.storage.memory import Memory
from afspm.translator.tcp import Receiver
from afspm.translator.translator import Translator, TranslatorRun
from afspm.translator.zmq_connection import ZmqConnection
from afspm.transport.port import RequestReceived, Served
from benchmarks.effort import effort
from benchmarks.plain_clients import ASKED, CLIENTS, FRAME, SET, Work
from benchmarks.processes import CLOCK, Roles, roles
from benchmarks.rows import Row, alternate, measurement

REQUESTS = effort(200, 2)
PAIRS = effort(100, 2)
AT_MOST_MS = {ASKED: 1.0, SET: 1.0, FRAME: 4.0}
"""Besides waiting for the controller. A frame is five or more questions, and each is a turn of its network."""
AT_MOST_TIMES = {
    "nanonis": {ASKED: 1.5, SET: 3.0, FRAME: 3.0},
    "park": {ASKED: 2.5, SET: 3.0, FRAME: 7.0},
}
"""Beside a script with the maker's client. A translator asks more than the script: for the state before it sets, and
afterwards for each value that may have changed with it."""
WAITS = ((Receiver, "some"), (ZmqConnection, "_await_reply"))
"""The classes and their methods that wait for the answer of a controller, over TCP and over ZeroMQ."""
VENDORS = {
    name.lower(): name
    for name in entry_points.names(entry_points.DRIVERS)
    if f"{name}Emulator" in entry_points.names(entry_points.EMULATORS)
}
"""The drivers of the emulated controllers, by the names of the emulators."""
_REGION = Region((1e-7, -5e-8), (4e-7, 3e-7), 0.1)
FRAMES = (ScanParameters(_REGION, (48, 64), "m"), ScanParameters(_REGION.moved_to((0.0, 0.0)), (48, 64), "m"))


class Waiting:
    """The time spent waiting for a controller."""

    def __init__(self) -> None:
        self.s = 0.0

    @contextmanager
    def counted(self, link: Any, method: str) -> Iterator[None]:
        plainly = getattr(link, method)

        @wraps(plainly)
        def timed(*arguments: Any) -> Any:
            began = perf_counter()
            try:
                return plainly(*arguments)
            finally:
                self.s += perf_counter() - began

        setattr(link, method, timed)
        try:
            yield
        finally:
            setattr(link, method, plainly)


class Answers:
    """A network without losses and delays.

    It notes the time of the last answer, and how long was waited for the controller until then.
    """

    def __init__(self, waiting: Waiting) -> None:
        self.clock = CLOCK
        self.last: Sequence[bytes] = ()
        self.at_s = self.waited_s = 0.0
        self._waiting = waiting

    def poll(self, timeout_s: float | None) -> list[Served]:
        return []

    def waiting_request(self) -> None: ...

    def reply(self, frames: Sequence[bytes] | None) -> None:
        self.at_s, self.waited_s, self.last = perf_counter(), self._waiting.s, frames or ()

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None: ...

    def wake_up(self, incoming: Served | None = None) -> None: ...

    def is_connected(self, connection: bytes) -> bool:
        return True

    def close(self) -> None: ...


def translator(vendor: str, processes: Roles, folder: Path, port: Answers) -> Translator:
    """Return a translator in this process, connected to an emulated controller in another."""
    address = processes.start("emulator", vendor=vendor, folder=str(folder / "files"))
    microscope = entry_points.load(entry_points.DRIVERS, VENDORS[vendor])
    memory = Memory(folder / "state.json", synced=False)
    made = Translator(microscope(address=address), port, memory, TranslatorRun(folder), logging.getLogger("benchmark"))
    made.look()
    return made


@dataclass(frozen=True)
class Took:
    """The time from a request to its answer, with the wait for the controller and without."""

    whole_s: float
    own_s: float


def took(made: Translator, port: Answers, waiting: Waiting, request: Request) -> Took:
    frames = wire.encode_request(request)
    waiting.s, began = 0.0, perf_counter()
    made.handle(RequestReceived(frames))
    response = wire.decode_response(port.last)
    assert response.ok, response.reason
    whole_s = port.at_s - began
    return Took(whole_s, whole_s - port.waited_s)


def controller(vendor: str) -> Iterator[Row]:
    bias = [Parameter(names.TIP_BIAS_VOLTAGE, text, "V") for text in ("0.1", "0.2")]
    speed = [Parameter(names.SCAN_SPEED, text, "m/s") for text in ("1e-6", "2e-6")]
    port = Answers(waiting := Waiting())
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        processes = stack.enter_context(roles())
        made = translator(vendor, processes, folder, port)
        stack.callback(made.driver.close)
        for wait in WAITS:
            stack.enter_context(waiting.counted(*wait))
        plain: Work = {}
        if client := CLIENTS.get(vendor):
            address = processes.start("emulator", vendor=vendor, folder=str(folder / "plain"))
            plain = stack.enter_context(client(address, FRAMES))
        asked = [Parameter(names.SCAN_SPEED, None, None)]
        set_ = bias if names.TIP_BIAS_VOLTAGE in made.driver.table else speed
        numbers = itertools.count()
        for what, kind, subjects in (
            (ASKED, ControlRequest.PARAM, asked),
            (SET, ControlRequest.PARAM, set_),
            (FRAME, ControlRequest.SET_SCAN_PARAMS, FRAMES),
        ):

            def ours(what: str = what, kind: int = kind, subjects: Sequence[Any] = subjects) -> Took:
                number = next(numbers)
                request = Request(kind, subjects[number % len(subjects)], id=f"{what}/{number}")
                found = took(made, port, waiting, request)
                while made.driver.status().state is not ScopeState.FREE:
                    pass
                made.look()
                return found

            name = f"{vendor}'s translator, {what}"
            if not plain:
                own_ms = median(ours().own_s for _ in range(REQUESTS)) * 1e3
                yield Row(name, "ms", own_ms, None, AT_MOST_MS[what])
                continue

            def bare(work: Callable[[int], object] = plain[what]) -> float:
                number, began = next(numbers), perf_counter()
                work(number)
                return perf_counter() - began

            whole_s, bare_s = alternate(lambda ours=ours: ours().whole_s, bare, PAIRS)  # type: ignore[misc]
            target = AT_MOST_TIMES[vendor][what]
            yield Row(f"{name}, beside the maker's client", "ms", whole_s * 1e3, bare_s * 1e3, target)


for _vendor in VENDORS:  # one that fails leaves the others to be measured
    measurement(partial(controller, _vendor), _vendor)
