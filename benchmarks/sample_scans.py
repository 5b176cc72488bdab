"""From a scan's end to its publication in sample coordinates, through the real scheduler and its worker.

The estimator answers at once, so that the registration itself is not measured. Before a scan is published, the worker's
state is on the disk, and the mapping announced.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from time import perf_counter

import numpy as np

from afspm import wire
from afspm.model import ScopeState, ScopeStatus
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.transport.network import Network
from afspm.transport.port import PacketReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort
from benchmarks.codec import scan
from benchmarks.effort import effort
from benchmarks.processes import CLOCK, roles
from benchmarks.roles import ANY
from benchmarks.rows import Row, measurement

SCANS = effort({128: 400, 512: 100}, {128: 2, 512: 2})
_FIRST_S = 60.0
"""The worker starts, and loads its libraries."""


class Still:
    """An estimator for a sample that does not move."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        center_m = np.array(reference.region.center_m)
        return Registration(
            accepted=True,
            reason="",
            displacement_m=np.zeros(2),
            covariance_m2=np.eye(2) * 1e-20,
            linear=np.zeros((2, 2)),
            center_m=center_m,
        )


class _Line:
    """A translator and a listener in this process, the scheduler in another."""

    def __init__(self, translator: ZmqServerPort, listener: ZmqPort) -> None:
        self._translator = translator
        self._listener = listener

    def published_s(self, payload: bytes) -> float:
        """Return the time of a scan from publication to the listener, s."""
        began = perf_counter()
        self._translator.publish("Scan2d", payload)
        while perf_counter() - began < _FIRST_S:
            self._translator.poll(0.0)
            if any(isinstance(one, PacketReceived) for one in self._listener.poll(1e-3)):
                return perf_counter() - began
        raise TimeoutError("a scan was not published")

    def state(self, state: ScopeState) -> None:
        self._translator.publish(*wire.encode(ScopeStatus(state)))


@measurement
def sample_scans() -> Iterator[Row]:
    for pixels, count in SCANS.items():
        with roles() as processes:
            translator = ZmqServerPort(Network(), CLOCK, serve=ANY, publish=ANY)
            processes.callback(translator.close)
            drift = {
                "estimator": "benchmarks.sample_scans.Still",
                "at_start": "nothing",
                "longest_registration": _FIRST_S,
                "rescan": {"rule": "never"},
            }
            source, _ = processes.scheduler(
                str(translator.publish_address),
                translator.serve_address,
                class_="afspm.plugins.drift.frame.scheduler.DriftCompensatedScheduler",
                drift=drift,
            )
            listener = ZmqPort(Network(), "Listener", CLOCK, subscribe=[source], envelopes=["Scan2d"])
            processes.callback(listener.close)
            line, taken = _Line(translator, listener), scan(pixels)
            took_s = []
            for _ in range(count + 1):
                line.state(ScopeState.SCANNING)
                took_s.append(line.published_s(wire.encode(replace(taken, time_ns=CLOCK.now_ns()))[1]))
                line.state(ScopeState.FREE)
            for share in (50, 99):
                took_ms = float(np.percentile(took_s[1:], share)) * 1e3
                name = f"{share} % of scans of {pixels}² are out in sample coordinates within"
                yield Row(name, "ms", took_ms, None, 200.0)
