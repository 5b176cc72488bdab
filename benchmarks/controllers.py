"""The time that translators of vendors' controllers add to a request: everything except the wait for the controller.

The emulated controllers are processes of their own, and their time is not counted.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
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
from benchmarks.processes import CLOCK, Roles, roles
from benchmarks.rows import Row, measurement

REQUESTS = effort(200, 2)
AT_MOST_MS = 1.0
WAITS = ((Receiver, "some"), (ZmqConnection, "_await_reply"))
"""The classes and their methods that wait for the answer of a controller, over TCP and over ZeroMQ."""
VENDORS = {
    name.lower(): name
    for name in entry_points.names(entry_points.DRIVERS)
    if f"{name}Emulator" in entry_points.names(entry_points.EMULATORS)
}
"""The drivers of the emulated controllers, by the names of the emulators."""
FRAME = ScanParameters(Region((1e-7, -5e-8), (4e-7, 3e-7), 0.1), (48, 64), "m")


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


def own_s(made: Translator, port: Answers, waiting: Waiting, request: Request) -> float:
    """Return the time from a request to its answer, minus the wait for the controller."""
    frames = wire.encode_request(request)
    waiting.s, began = 0.0, perf_counter()
    made.handle(RequestReceived(frames))
    response = wire.decode_response(port.last)
    assert response.ok, response.reason
    return port.at_s - began - port.waited_s


def controller(vendor: str) -> Iterator[Row]:
    bias = [Parameter(names.TIP_BIAS_VOLTAGE, text, "V") for text in ("0.1", "0.2")]
    speed = [Parameter(names.SCAN_SPEED, text, "m/s") for text in ("1e-6", "2e-6")]
    frames = [FRAME, ScanParameters(FRAME.region.moved_to((0.0, 0.0)), FRAME.shape, "m")]  # type: ignore[union-attr]
    port = Answers(waiting := Waiting())
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        made = translator(vendor, stack.enter_context(roles()), folder, port)
        stack.callback(made.driver.close)
        for wait in WAITS:
            stack.enter_context(waiting.counted(*wait))
        asked = [Parameter(names.SCAN_SPEED, None, None)]
        set_ = bias if names.TIP_BIAS_VOLTAGE in made.driver.table else speed
        for what, kind, subjects in (
            ("a value asked for", ControlRequest.PARAM, asked),
            ("a value set", ControlRequest.PARAM, set_),
            ("a frame set", ControlRequest.SET_SCAN_PARAMS, frames),
        ):
            times = []
            for number in range(REQUESTS):
                request = Request(kind, subjects[number % len(subjects)], id=f"{what}/{number}")
                times.append(own_s(made, port, waiting, request))
                while made.driver.status().state is not ScopeState.FREE:
                    pass
                made.look()
            yield Row(f"{vendor}'s translator, {what}", "ms", median(times) * 1e3, None, AT_MOST_MS)


for _vendor in VENDORS:  # one that fails leaves the others to be measured
    measurement(partial(controller, _vendor), _vendor)
