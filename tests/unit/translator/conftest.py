"""A microscope, a network and a clock under the control of a test."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_clock import FakeClock

from afspm import wire
from afspm.basics.errors import FileError, Refused
from afspm.basics.exit_codes import ExitCode
from afspm.driver import Driver, Value, action
from afspm.model import (
    ActByHand,
    ChannelRoles,
    ControlRequest,
    ControlResponse,
    MeasurementConditions,
    Region,
    Request,
    Response,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
    Spectrum,
    TipStatus,
    names,
)
from afspm.model.state import FeedbackUnits
from afspm.storage.memory import Memory
from afspm.translator.translator import Translator, TranslatorRun
from afspm.transport.port import RequestReceived, Served

TABLE = """
[parameters]
scan-top-left-x = { vendor = "X", unit = "nm", range = ["-10 um", "10 um"] }
scan-top-left-y = { vendor = "Y", unit = "nm", range = ["-10 um", "10 um"] }
scan-size-x = { vendor = "W", unit = "nm", range = ["1 nm", "10 um"] }
scan-size-y = { vendor = "H", unit = "nm", range = ["1 nm", "10 um"] }
scan-angle = { vendor = "A", unit = "deg", sign = -1, range = ["-180 deg", "180 deg"] }
scan-resolution-x = { vendor = "NX", unit = "px", type = "int", range = [2, 4096] }
scan-resolution-y = { vendor = "NY", unit = "px", type = "int", range = [2, 4096] }
probe-pos-x = { vendor = "PX", unit = "um", range = ["-10 um", "10 um"] }
probe-pos-y = { vendor = "PY", unit = "um", range = ["-10 um", "10 um"] }
zctrl-pgain = { vendor = "P", range = [0, 100] }
zctrl-setpoint = { vendor = "Setpoint", unit = "nA", range = [0, 10] }
x-feedback-on = { vendor = "Loop", type = "bool" }
scan-speed = { vendor = "Speed", unit = "um/s", range = [0.001, 100], resolution = 1e-4 }
x-mode = { vendor = "Mode", type = "text", choices = ["IV", "force"] }
x-serial = { vendor = "Serial", type = "text", read_only = true }
tip-bias-voltage = { vendor = "Bias", unit = "mV", range = ["-10 V", "10 V"], while_busy = true }
"""


class FakePort:
    """Records the answers and packets of a translator."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.replies: list[list[bytes]] = []
        self.packets: list[tuple[str, Any, int]] = []
        self.kept: list[str] = []

    def poll(self, timeout_s: float | None) -> list[Served]:
        return []

    def waiting_request(self) -> None: ...

    def reply(self, frames: Sequence[bytes] | None) -> None:
        self.replies.append(list(frames or []))

    def is_connected(self, connection: bytes) -> bool:
        return True

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None:
        assert time_ns is not None
        self.kept += [envelope] if keep else []
        self.packets.append((envelope, wire.decode(envelope, payload), time_ns))

    def wake_up(self, incoming: Served | None = None) -> None: ...

    def close(self) -> None: ...


class FakeMicroscope(Driver):
    """A controller whose state, values and files are set by the test."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.state = ScopeState.FREE
        self.values: dict[str, Value] = {
            "X": 0.0, "Y": 0.0, "W": 1000.0, "H": 500.0, "A": 0.0, "NX": 8, "NY": 4, "PX": 0.0, "PY": 0.0,
            "P": 1.0, "Setpoint": 1.0, "Loop": True, "Speed": 1.0, "Mode": "IV", "Serial": "007",
            "Bias": 100.0, "Engaged": True,
        }  # fmt: skip
        self.files: dict[str, list[Scan | Spectrum] | Exception | None] = {}
        self.done: list[str] = []
        self.set_calls = 0
        self.lost = False
        self.retracts_slowly = False
        self.stuck: dict[str, Value] = {}
        self.fails: BaseException | None = None
        self.confused: Exception | None = None
        self.fails_to_connect: Exception | None = None
        self.paused: bool | None = None
        self.evidence = ""
        self.withdrawal = ""
        self.at_status: Callable[[], object] = list
        self.after_set: Callable[[Mapping[str, Value]], object] = dict
        self.got = 0
        self.connected = 0

    def connect(self) -> None:
        if self.lost:
            raise ConnectionError("unplugged")
        if self.fails_to_connect is not None:
            raise self.fails_to_connect
        self.connected += 1

    def status(self) -> ScopeStatus:
        if self.lost:
            raise ConnectionError("unplugged")
        if self.confused is not None:
            raise self.confused
        self.at_status()
        return ScopeStatus(self.state, paused=self.paused)

    def stopped_by_hand(self) -> str:
        return self.evidence

    def withdrew_tip(self) -> str:
        return self.withdrawal

    def get(self, vendor: str) -> Value:
        self.got += 1
        if self.lost:
            raise ConnectionError("unplugged")
        return self.values[vendor]

    def set(self, values: Mapping[str, Value]) -> None:
        if self.fails is not None:
            raise self.fails
        self.set_calls += 1
        self.values.update(values)
        self.values.update({name: stuck for name, stuck in self.stuck.items() if name in values})
        self.after_set(values)

    def results(self) -> Sequence[str]:
        return list(self.files)

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        found = self.files[result]
        if found is None:
            raise FileError("is not whole", where=result)
        if isinstance(found, Exception):
            raise found
        return found

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        if self.fails is not None:
            raise self.fails
        self.done.append("scan")
        self.state = ScopeState.SCANNING

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self.done.append("stop")
        self.state = ScopeState.FREE

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        self.done.append("spec")
        self.state = ScopeState.SPEC

    @action("x-tune")
    def tune(self) -> None:
        raise Refused(ControlResponse.ACTION_ERROR, "no resonance was found")

    @action("x-explode")
    def explode(self) -> None:
        raise ZeroDivisionError("a bug of the implementer")

    @action(names.RETRACT, state=ScopeState.COARSE_MOTOR)
    def retract(self) -> None:
        if self.lost:
            raise ConnectionError("unplugged")
        self.done.append("retract")
        if self.retracts_slowly:
            self.state = ScopeState.COARSE_MOTOR

    def command(self, text: str) -> None:
        self.done.append(text)


class LiveMicroscope(FakeMicroscope):
    """A controller with `there` lines of two channels."""

    there = 0

    def lines(self, start: int) -> list[ScanLines]:
        region = Region((0.0, 0.0), (1e-6, 1e-6))
        values = np.arange(start, self.there)[:, None] * np.ones((1, 3))
        return [ScanLines(region, (8, 3), name, "m", start, values) for name in ("Height", "Phase")]


def a_scan(channel: str = "Height") -> Scan:
    return Scan(Region((0.0, 0.0), (1e-6, 1e-6)), channel, "m", np.zeros((2, 3)), 5, "one.dat")


_BESIDE = (TipStatus, ActByHand, MeasurementConditions, ChannelRoles, FeedbackUnits)


class Bench:
    """A translator on a fake network, with short calls for requests."""

    def __init__(
        self, folder: Path, settings: dict[str, Any] | None = None, kind: type[FakeMicroscope] = FakeMicroscope
    ) -> None:
        self.clock = FakeClock()
        self.folder = folder
        self.beside: list[TipStatus | ActByHand | MeasurementConditions | ChannelRoles | FeedbackUnits] = []
        self.microscope = kind(**(settings or {}))
        self.start()

    def start(self, *, retracts: bool = True, feedback_off: str = "") -> None:
        """Start the translator's process, or restart it after a kill: only the disk survives."""
        self.port = FakePort(self.clock)
        memory, log = Memory(self.folder / "translator.json"), logging.getLogger("test")
        run = TranslatorRun(self.folder, retracts=retracts, feedback_off=feedback_off)
        self.translator = Translator(self.microscope, self.port, memory, run, log)
        self.translator.look()

    def run_to_the_end(self, *last: Served, after_s: tuple[float, Callable[[], object]] = (math.inf, list)) -> ExitCode:
        """Run until the translator ends; `last` arrives at once, and `after_s` calls a function after a time."""
        at_s, happens = self.clock.t_s + after_s[0], after_s[1]

        def poll(timeout_s: float | None) -> list[Served]:
            self.clock.t_s += timeout_s or 0.0
            if self.clock.t_s >= at_s:
                happens()
            return list(last)

        self.port.poll = poll  # type: ignore[method-assign]
        return self.translator.run()

    def ask(self, kind: ControlRequest, subject: Any = None, request_id: str = "", payload: bytes = b"") -> Response:
        return self.ask_frames(wire.encode_request(Request(kind, subject, payload, request_id)))

    def ask_frames(self, frames: Sequence[bytes]) -> Response:
        self.translator.handle(RequestReceived(list(frames)))
        return wire.decode_response(self.port.replies[-1])

    def look(self, after_s: float = 0.1) -> None:
        self.clock.t_s += after_s
        self.translator.look()

    def heard(self) -> list[Any]:
        """Return the packets since the last call: states by name, other packets by the name of their message.

        Those about the tip and the person at the panel are left out: see `beside`.
        """
        packets, self.port.packets, self.port.kept = self.port.packets, [], []
        self.beside += [thing for _, thing, _ in packets if isinstance(thing, _BESIDE)]
        rest = [(name, thing) for name, thing, _ in packets if not isinstance(thing, _BESIDE)]
        return [thing.state.name if isinstance(thing, ScopeStatus) else name for name, thing in rest]


@pytest.fixture
def fake_clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def scan() -> Any:
    return a_scan


@pytest.fixture
def make_bench(tmp_path: Path) -> Any:
    table = tmp_path / "parameters.toml"
    table.write_text(TABLE)
    FakeMicroscope.parameters_file = table

    def make(settings: dict[str, Any] | None = None) -> Bench:
        return Bench(tmp_path, settings)

    return make


@pytest.fixture
def make_live_bench(make_bench: Any, tmp_path: Path) -> Any:
    """Make benches whose controller shows its lines."""
    return lambda settings: Bench(tmp_path, settings, LiveMicroscope)


@pytest.fixture
def bench(make_bench: Any) -> Bench:
    made: Bench = make_bench()
    made.heard()
    return made
