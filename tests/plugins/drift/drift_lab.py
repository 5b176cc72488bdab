"""A drift compensated scheduler core over the real wire format, with a worker that the test plays."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from afspm import wire
from afspm.components import restored, snapshot
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Packet,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegistrationOutcome,
    Request,
    Response,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.plugins.drift.frame.messages import (
    Compensated,
    Forecasted,
    Registered,
    ScanJob,
    StartWorker,
    WorkerReport,
)
from afspm.plugins.drift.frame.sample_frame import SampleFrame
from afspm.plugins.drift.frame.scheduler import DriftWireCodec
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.plugins.drift.frame.state import DriftState
from afspm.plugins.drift.track import forecast_from_dict
from afspm.plugins.drift.track.mapping import Mapping
from afspm.plugins.drift.track.paper import PaperForecast
from afspm.scheduler import (
    PROBE_CHANGES,
    REGION_CHANGES,
    Delegate,
    ExperimentLimits,
    FrameReported,
    Input,
    PacketIn,
    RequestIn,
    SavedState,
    SchedulerCore,
    Tick,
    TranslatorCaughtUp,
    TranslatorUp,
    scan_values,
)
from afspm.scheduler.events import Connected, Effect, Forward, Publish, Reply, SaveState, TranslatorReply
from afspm.scheduler.safety.limit_checker import is_get
from afspm.scheduler.saved_state import KIND, VERSION
from afspm.scheduler.settings import SchedulerSettings
from afspm.wire.generated.spectroscopy_pb2 import ProbePosition as ProbePositionMessage

NS = 10**9
START_S = 1_750_000_000.0
HERE = Region((0.0, 0.0), (2e-6, 2e-6))
SHAPE = (128, 128)


class FakeWorker:
    """Remembers its jobs."""

    def __init__(self) -> None:
        self.starts = 0
        self.jobs: list[ScanJob] = []
        self.velocities: list[tuple[float, tuple[float, float]]] = []

    def take(self, job: object) -> None:
        if isinstance(job, StartWorker):
            self.starts += 1
        elif isinstance(job, ScanJob):
            self.jobs.append(job)
        elif isinstance(job, Compensated):
            self.velocities.append((job.time_s, job.velocity_m_s))


def forecast(
    drift_m: tuple[float, float] = (0.0, 0.0),
    rate_m_s: tuple[float, float] = (0.0, 0.0),
    *,
    at_s: float = START_S,
    angle_rad: float = 0.0,
    rate_sd_m_s: float = 0.0,
) -> dict[str, Any]:
    """Return a forecast of a sample displaced by `drift_m` at a time, with its velocity.

    Args:
        angle_rad: rotation of the sample about (0, 0).
    """
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    linear = np.array([[cos, -sin], [sin, cos]])
    step = np.zeros((3, 3))
    step[:2, 2] = -np.array(rate_m_s)
    covariance = np.eye(2) * rate_sd_m_s**2
    return PaperForecast(
        at_s, Mapping.of(linear, -np.array(drift_m)).matrix, step, np.zeros((2, 2)), covariance
    ).to_dict()


def registered(
    job: ScanJob,
    plain: dict[str, Any],
    *,
    lost: bool = False,
    rescan: str = "",
    outcome: RegistrationOutcome | None = None,
    failures: tuple[str, ...] = (),
) -> Registered:
    """Return the report of a worker that has this forecast."""
    outcome = outcome or (RegistrationOutcome.REFUSED if lost else RegistrationOutcome.REGISTERED)
    middle_s = (job.start_s + job.end_s) / 2
    there = forecast_from_dict(plain).at(middle_s)
    zero = [[0.0, 0.0], [0.0, 0.0]]
    return Registered(
        key=job.key,
        time_s=middle_s,
        matrix=there.mapping.matrix.tolist(),
        covariance_m2=zero,
        rate_m_s=there.rate_m_s.tolist(),
        rate_covariance=zero,
        outcome=outcome,
        lost=lost,
        reason="" if outcome.is_registered else "nothing is alike",
        residual_m=[0.0, 0.0],
        references=[],
        rescan=rescan,
        forecast=plain,
        failures=list(failures),
    )


def as_saved(state: SavedState) -> SavedState:
    """Return the state as it is read back from its file."""
    return restored(SavedState, json.loads(json.dumps(snapshot(state, KIND, VERSION))), KIND, VERSION)


def _asks_for_a_place(effect: Effect) -> bool:
    if not isinstance(effect, Forward) or effect.request.id or not is_get(effect.request):
        return False
    return effect.request.subject.name in REGION_CHANGES.keys() | PROBE_CHANGES.keys()


def position_message(change: PositionChange) -> ProbePositionMessage:
    """Return one coordinate of a position, as a peer may request it."""
    message = ProbePositionMessage(units="m")
    if change.x_m is not None:
        message.point.x = change.x_m
    if change.y_m is not None:
        message.point.y = change.y_m
    return message


class Lab:
    """A core with its effects, and short ways to give it inputs. Real and experiment time pass alike.

    Args:
        drift: None: the defaults, except that a night begins with one scan.
    """

    def __init__(
        self,
        drift: DriftCompensationSettings | None = None,
        limits: ExperimentLimits | None = None,
        *,
        state: SavedState | None = None,
        now_s: float = START_S,
        answer_start: bool = True,
        translator: bool = True,
    ) -> None:
        self.worker = FakeWorker()
        self.now_s = now_s
        settings = SchedulerSettings(limits=limits or ExperimentLimits())
        self._drift = drift or DriftCompensationSettings(at_start="nothing")
        codec = DriftWireCodec()
        self.core = SchedulerCore(settings, codec, SampleFrame.initial(self._drift, codec, "scheduler"))
        if state is not None:
            self.core.restore(as_saved(state))
        self.effects: list[Effect] = []
        self.asked = 0
        self.places: dict[str, float] = {}
        self.connections: dict[str, int] = {}
        self.done(self.core.start(self.now_s, self.now_ns))
        if translator:
            self.step(TranslatorUp())
            self.step(TranslatorCaughtUp())
        while answer_start and (forwards := self.forwards()):  # one is asked after the other
            for forward in forwards:
                self.answer(forward, ControlResponse.PARAM_NOT_SUPPORTED)
        if answer_start:
            self.effects.clear()

    @property
    def now_ns(self) -> int:
        return round(self.now_s * NS)

    @property
    def drift(self) -> DriftState:
        frame = self.core.state.frame
        assert isinstance(frame, SampleFrame)
        return frame.state

    def mapping_now(self) -> Mapping:
        """Return the mapping in force now."""
        mapping = self.drift.forecast.mapping_at(self._drift, self.now_s)
        assert mapping is not None
        return mapping

    def done(self, effects: list[Effect]) -> list[Effect]:
        self.effects += effects
        for effect in effects:
            if isinstance(effect, Delegate):
                self.worker.take(effect.job)
        return effects

    def step(self, event: Input) -> list[Effect]:
        done = self.done(self.core.step(event, self.now_s, self.now_ns)) + self.follow()
        return done + self._answer_places()

    def _answer_places(self) -> list[Effect]:
        # before a request the core asks the microscope for the places of scan and probe
        done: list[Effect] = []
        while (forward := next(filter(_asks_for_a_place, self.effects), None)) is not None:
            assert isinstance(forward, Forward)
            self.effects.remove(forward)
            name, code, payload = forward.request.subject.name, ControlResponse.PARAM_NOT_SUPPORTED, b""
            if name in self.places:
                unit = "rad" if name == names.SCAN_ANGLE else "m"
                payload = wire.encode(Parameter(name, repr(self.places[name]), unit))[1]
                code = ControlResponse.SUCCESS
            reply = TranslatorReply(forward.number, Response(int(code), payload))
            done += self.done(self.core.step(reply, self.now_s, self.now_ns)) + self.follow()
        return done

    def _has_in_force(self, thing: Any) -> None:
        if isinstance(thing, ScanParameters):
            self.places.update(one for one in scan_values(thing) if one[0] in REGION_CHANGES)
        elif isinstance(thing, ProbePosition):
            self.places.update(zip(PROBE_CHANGES, thing.xy_m, strict=True))

    def follow(self) -> list[Effect]:
        """Process everything that is due at once, as the scheduler's shell would."""
        done: list[Effect] = []
        while self.drift.following:
            done += self.done(self.core.step(Tick(), self.now_s, self.now_ns))
        return done

    def knows(self, plain: dict[str, Any]) -> None:
        """Give the worker this forecast."""
        self.says(Forecasted(plain))

    def says(self, report: WorkerReport) -> list[Effect]:
        """Let the worker report."""
        done = self.done(self.core.step(FrameReported(report), self.now_s, self.now_ns))
        return done + self.follow()

    # --- components ---

    def ask(self, kind: ControlRequest, subject: Any = None, *, id_: str = "", name: str = "series") -> list[Effect]:
        if name not in self.connections:
            self.connections[name] = len(self.connections) + 1
            self.step(Connected(self.connections[name]))
        self.asked += 1
        id_ = id_ or f"{name}/life/{self.asked}"
        if isinstance(subject, PositionChange):
            subject = position_message(subject)
        frames = wire.encode_request(Request(int(kind), subject, id=id_))
        return self.step(RequestIn(self.connections[name], name, wire.decode_request(frames)))

    def take_control(self, name: str = "series") -> None:
        self.ask(ControlRequest.REQUEST_CTRL, 0, name=name)

    # --- the microscope ---

    def forwards(self) -> list[Forward]:
        """Return the requests sent to the translator since the last call."""
        found = [effect for effect in self.effects if isinstance(effect, Forward)]
        self.effects = [effect for effect in self.effects if not isinstance(effect, Forward)]
        return found

    def sent(self) -> Forward:
        """Return the only request that was sent."""
        (one,) = self.forwards()
        return one

    def answer(
        self, forward: Forward, code: ControlResponse = ControlResponse.SUCCESS, told: Parameter | None = None
    ) -> list[Effect]:
        if code is ControlResponse.SUCCESS:
            self._has_in_force(forward.request.subject)
        payload = b"" if told is None else wire.encode(told)[1]
        response = Response(int(code), payload, "" if code is ControlResponse.SUCCESS else "no", forward.request.id)
        return self.step(TranslatorReply(forward.number, response))

    def publish(self, thing: Any, time_s: float | None = None) -> list[Effect]:
        """Let the translator publish."""
        self.now_s += 1e-3
        self._has_in_force(thing)
        name, payload = wire.encode(thing)
        time_ns = self.now_ns if time_s is None else round(time_s * NS)
        return self.step(PacketIn(Packet(name, payload, time_ns), wire.header(name, payload)))

    def scope_is(self, state: ScopeState) -> list[Effect]:
        return self.publish(ScopeStatus(state))

    def in_force(self, region: Region = HERE, probe: tuple[float, float] = (0.0, 0.0)) -> None:
        """Publish the messages of a translator's start."""
        self.publish(ScanParameters(region, SHAPE))
        self.publish(ProbePosition(probe))
        self.scope_is(ScopeState.FREE)
        self.effects.clear()

    def scan(
        self, region: Region = HERE, *, duration_s: float = 256.0, channels: tuple[str, ...] = ("Height",)
    ) -> None:
        """Publish a whole scan."""
        self.scope_is(ScopeState.SCANNING)
        self.now_s += duration_s
        end_ns = self.now_ns
        for channel in channels:
            unit = "m" if channel.startswith("Height") else "V"
            self.publish(Scan(region, channel, unit, np.ones(SHAPE), end_ns, f"{end_ns}.nc"))
        self.scope_is(ScopeState.FREE)

    # --- what came of it ---

    def published(self, prefix: str = "") -> list[Any]:
        """Return the packets published since the effects were cleared, decoded."""
        packets = [e.packet for e in self.effects if isinstance(e, Publish) and e.packet.envelope.startswith(prefix)]
        return [wire.decode(wire.message_of(packet.envelope), packet.payload) for packet in packets]

    def envelopes(self) -> list[str]:
        return [effect.packet.envelope for effect in self.effects if isinstance(effect, Publish)]

    def replies(self) -> list[Response]:
        return [effect.response for effect in self.effects if isinstance(effect, Reply)]

    def saved(self) -> SavedState:
        """Return the last saved state."""
        return [effect.state for effect in self.effects if isinstance(effect, SaveState)][-1]
