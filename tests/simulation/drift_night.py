"""A night under a Drift Compensated Scheduler: the same cast and the same faults, on a sample that drifts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from afspm.model import Packet, Region, RegistrationOutcome, Scan, ScanParameters, ScopeState
from afspm.model.geometry import XY
from afspm.plugins.drift.frame.messages import (
    Forecasted,
    Registered,
    RescanWanted,
    ScanJob,
    StartWorker,
    WorkerGone,
    WorkerReport,
)
from afspm.plugins.drift.frame.sample_frame import SampleFrame
from afspm.plugins.drift.frame.settings import DriftCompensationSettings, RescanRule
from afspm.plugins.drift.track.mapping import Mapping
from afspm.plugins.drift.track.paper import PaperForecast
from afspm.scheduler.events import Effect, Publish
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_time import START_S
from tests.simulation.codec import TableCodec
from tests.simulation.invariants import InvariantViolated
from tests.simulation.microscope import SHAPE, FakeMicroscope, FakeScan, Habits
from tests.simulation.night import Night, NightCodec, Plan

WANTED = Region((0.0, 0.0), (2e-6, 2e-6))
LONGEST_S = 2.0
CERTAIN_M = 1e-12


def drift_m(time_s: float) -> np.ndarray:
    """Return the position of the sample: it moves fast at first, then slower."""
    since_s = time_s - START_S
    settled = float(1.0 - np.exp(-since_s / 7200.0))
    return np.array([1e-6, -0.5e-6]) * settled + np.array([1e-11, 0.0]) * since_s


@dataclass(frozen=True)
class PlacedScan(FakeScan):
    """A scan with its place and its end."""

    region: Region = WANTED
    begun_s: float = 0.0
    end_ns: int = 0
    sample: Region | None = None
    """As it was published."""


class DriftTable(NightCodec):
    """A substitute for the wire format that knows places."""

    def decode_packet(self, message: str, payload: bytes | memoryview) -> Any:
        thing = self.decode(payload)
        if not isinstance(thing, PlacedScan):
            return thing
        unit = "m" if thing.channel == "Height" else "V"
        return Scan(thing.region, thing.channel, unit, np.ones(SHAPE), thing.end_ns, f"scan-{thing.number}")

    def relocated(self, message: str, payload: bytes | memoryview, told: bytes) -> bytes:
        thing, there = self.decode(payload), self.decode(told)
        if isinstance(thing, PlacedScan):
            return self.encode(replace(thing, sample=there.region))
        return self.encode(replace(thing, region=there.region) if isinstance(thing, ScanParameters) else there)

    def encode_mapping(
        self, registered: Registered, filename: str, center_m: XY, *, correcting: bool, channel: str | None
    ) -> bytes:
        return self.encode(("mapping", registered.key, str(registered.matrix)))

    def encode_rescan(self, wanted: RescanWanted) -> bytes:
        return self.encode(wanted)


class DriftingMicroscope(FakeMicroscope):
    """A microscope whose moves take a moment."""

    region = Region((0.3e-6, 0.0), (2e-6, 2e-6))
    scan_began_s = 0.0

    def _publish(self, message: str, thing: object) -> None:
        if isinstance(thing, FakeScan):
            now_ns = self.timeline.now_ns()
            thing = PlacedScan(thing.number, thing.channel, thing.tip_is_good, self.region, self.scan_began_s, now_ns)
        super()._publish(message, thing)

    def _begin(self, state: ScopeState) -> None:
        self.scan_began_s = self.timeline.now_s()
        super()._begin(state)

    def _publish_region(self) -> None:
        self._publish_state(ScopeState.MOVING)
        super()._publish_region()
        self.later(0.05 * self.timeline.random.random(), self._moved)

    def _moved(self) -> None:
        if self.state is ScopeState.MOVING:
            self._publish_state(ScopeState.FREE)


class PlayedWorker:
    """A worker with true registrations after a delay, and its earlier answers on disk; sometimes it dies or hangs."""

    def __init__(self, night: DriftNight) -> None:
        self._night = night
        self._life = 0
        self._reports: list[WorkerReport] = []
        self.wake: Callable[[], None] = lambda: None
        self.registered = 0
        self.failed = 0

    def take(self, job: object) -> None:
        if isinstance(job, StartWorker):
            self._life += 1
            self._reports.clear()
            self._say(Forecasted(self._night.known))
        else:
            assert isinstance(job, ScanJob), "nothing is handed over"
            self._register(job)

    def _register(self, job: ScanJob) -> None:
        chance = self._night.timeline.random.random()
        if chance < self._night.trouble / 2:
            self.failed += 1
            self._say(WorkerGone("it died"))
        elif chance >= self._night.trouble:
            self._say(self._answer(job))
        else:
            self.failed += 1  # it hangs

    def _answer(self, job: ScanJob) -> Registered:
        said = self._night.answers
        if job.key not in said:
            said[job.key] = self._new_answer(job)
            self._night.known = said[job.key].forecast
            self.registered += 1
        return said[job.key]

    def _new_answer(self, job: ScanJob) -> Registered:
        middle_s = (job.start_s + job.end_s) / 2
        there_m = drift_m(middle_s)
        rate_m_s = (drift_m(middle_s + 1.0) - drift_m(middle_s - 1.0)) / 2
        step = np.zeros((3, 3))
        step[:2, 2] = -rate_m_s
        mapping = Mapping.of_drift(there_m)
        zero = np.zeros((2, 2))
        forecast = PaperForecast(middle_s, mapping.matrix, step, zero, zero).to_dict()
        plain = zero.tolist()
        matrix = mapping.matrix.tolist()
        return Registered(
            job.key, middle_s, matrix, plain, rate_m_s.tolist(), plain, RegistrationOutcome.REGISTERED, False, "",
            [0.0, 0.0], [], "", forecast, [],
        )  # fmt: skip

    def _say(self, said: WorkerReport) -> None:
        self._night.scheduler.later(0.3 * self._night.timeline.random.random(), self._arrive, self._life, said)

    def _arrive(self, life: int, said: WorkerReport) -> None:
        if life == self._life:
            self._reports.append(said)
            self.wake()

    def reports(self) -> Iterator[WorkerReport]:
        while self._reports:
            yield self._reports.pop(0)

    def close(self) -> None:
        """Do nothing: the worker ends with the scheduler's life."""


class DriftNight(Night):
    """Adds the invariants of places.

    Attributes:
        trouble: the chance that a registration fails.
        answers, known: the content of the worker's disk.
    """

    def __init__(self, plan: Plan, trouble: float = 0.0) -> None:
        self.trouble = trouble
        self.answers: dict[str, Registered] = {}
        self.known: dict[str, Any] | None = None
        self.places: dict[int, Region | None] = {}
        self.misplaced_m: list[float] = []
        self.published = 0
        self.worker = PlayedWorker(self)
        super().__init__(plan)
        self.scheduler.worker = self.worker
        self.scheduler.unsynced_s = 0.0  # where a scan lies is not found out twice
        self._carried_out = self.invariants.carried_out
        self.invariants.carried_out = self.carried_out  # type: ignore[method-assign]

    def make_codec(self) -> TableCodec:
        return DriftTable()

    def make_microscope(self, habits: Habits) -> FakeMicroscope:
        return DriftingMicroscope(self.timeline, self.codec, habits)

    def make_core(self) -> Callable[[], Any]:
        drift = DriftCompensationSettings(rescan=RescanRule("never"), longest_registration=LONGEST_S)
        frame = SampleFrame.initial(drift, self.codec, "scheduler")  # type: ignore[arg-type]
        return lambda: SchedulerCore(self.settings, self.codec, frame)

    def carried_out(self, host: SchedulerHost, effect: Effect) -> None:
        self._carried_out(host, effect)
        if isinstance(effect, Publish):
            self._look_at(effect.packet)

    def _look_at(self, packet: Packet) -> None:
        scan = self.codec.decode(packet.payload)
        if not isinstance(scan, PlacedScan) or not packet.envelope.startswith("Scan2d"):
            return
        self.published += 1
        if scan.sample is None:
            raise InvariantViolated(f"scan {scan.number} was published where the tip was")
        before = self.places.setdefault(scan.number, scan.sample)
        if before != scan.sample and self.invariants.memory_is_certain:
            raise InvariantViolated(f"scan {scan.number} is published at {before} and at {scan.sample}")
        middle_s = (scan.begun_s + scan.end_ns * 1e-9) / 2
        truth = np.subtract(scan.region.center_m, drift_m(middle_s))
        self.misplaced_m.append(float(np.hypot(*(truth - scan.sample.center_m))))
