"""The time that a translator adds, with a controller that answers at once."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import zmq

from afspm import wire
from afspm.driver import Driver, Value, action
from afspm.model import ControlRequest, Parameter, Region, Request, Scan, ScopeState, ScopeStatus, Spectrum, names
from benchmarks.effort import effort
from benchmarks.processes import roles
from benchmarks.rows import Row, measurement

REQUESTS = effort(400, 3)
SCANS = effort(12, 1)
LASTS_S = effort(1.7, 0.1)


class Instant(Driver):
    """Answers everything at once. Its scans last `LASTS_S`, and contain the time of their end."""

    parameters_file = Path(__file__).with_name("instant.toml")

    def connect(self) -> None:
        self.values: dict[str, Value] = {name: float(self.table[name].range[0] > 0) for name in self.table}
        self.values |= {names.SCAN_RESOLUTION_X: 8, names.SCAN_RESOLUTION_Y: 8}
        self.ends_s = 0.0
        self.ended: list[float] = []

    def status(self) -> ScopeStatus:
        if self.ends_s and perf_counter() >= self.ends_s:
            self.ended.append(self.ends_s)
            self.ends_s = 0.0
        return ScopeStatus(ScopeState.SCANNING if self.ends_s else ScopeState.FREE)

    def get(self, vendor: str) -> Value:
        return self.values[vendor]

    def set(self, values: Mapping[str, Value]) -> None:
        self.values.update(values)

    def results(self) -> Sequence[str]:
        return [str(number) for number in range(len(self.ended))]

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        moment = np.full((8, 8), self.ended[int(result)])
        return [Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", moment)]

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        self.ends_s = perf_counter() + LASTS_S


@measurement
def translator() -> Iterator[Row]:
    with roles() as processes:
        publish, serve = processes.translator(f"{__name__}.Instant")
        context: Any = processes.enter_context(zmq.Context())
        requester, subscriber = context.socket(zmq.REQ), context.socket(zmq.SUB)
        requester.connect(serve)
        subscriber.subscribe(b"")
        subscriber.connect(publish)

        def ask(kind: int, subject: Any, request_id: str = "") -> None:
            requester.send_multipart(wire.encode_request(Request(kind, subject, id=request_id)))
            response = wire.decode_response(requester.recv_multipart())
            assert response.ok, response.reason

        for name, subject, identified in (
            ("a value asked for", Parameter(names.TIP_BIAS_VOLTAGE, None, None), False),
            ("a value set", Parameter(names.TIP_BIAS_VOLTAGE, "1", "V"), False),
            ("a value set, once and for all", Parameter(names.TIP_BIAS_VOLTAGE, "1", "V"), True),
        ):
            times = []
            for number in range(REQUESTS):
                began = perf_counter()
                ask(ControlRequest.PARAM, subject, f"benchmark/{name}/{number}" if identified else "")
                times.append(perf_counter() - began)
            yield Row(f"translator, {name}", "ms", statistics.median(times) * 1e3, None, 1.0)
        late = []
        for number in range(SCANS):
            ask(ControlRequest.ACTION, names.START_SCAN, f"benchmark/scan/{number}")
            while True:
                envelope, payload, _ = subscriber.recv_multipart()
                if envelope == b"Scan2d":
                    late.append(perf_counter() - float(wire.decode("Scan2d", payload).values[0, 0]))
                elif late[number:] and wire.decode(envelope.decode(), payload) == ScopeStatus(ScopeState.FREE):
                    break
        yield Row("translator, the end of a scan, noticed after", "ms", statistics.median(late) * 1e3, None, 20.0)
