"""State of drift compensation: a tree of frozen parts, the draft of its next state, and its saved form."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from afspm.basics import Plain, replace, same_kind
from afspm.model import TOPOGRAPHY, XY, ChannelRoles, Scan
from afspm.plugins.drift.frame.messages import DriftCodec, Matrix, Registered, ScanJob
from afspm.plugins.drift.frame.place_mapper import Places, SavedPlaces
from afspm.plugins.drift.frame.scan_timing import ScanStartTracker
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.plugins.drift.frame.tally import RegistrationTally
from afspm.plugins.drift.track import forecast_from_dict
from afspm.plugins.drift.track.mapping import Mapping as DriftMapping
from afspm.plugins.drift.track.tracking import Forecast, Prediction
from afspm.scheduler import ArbitrationState, FrameOutput, Log, PacketIn, TranslatorCaughtUp

Waits = PacketIn | TranslatorCaughtUp

_SETTLED = 32


@dataclass(frozen=True)
class CurrentForecast:
    """The newest forecast.

    Attributes:
        start_s: experiment time at which the experiment began; None before the start.
        lost: whether the position of the sample was unknown after the newest scan that the worker has processed.
        text: the forecast as JSON in its tracker's own form; None before the first forecast.

    Raises:
        InvalidValue: the text is not a forecast.
    """

    start_s: float | None = None
    lost: bool = False
    text: str | None = None
    forecast: Forecast | None = field(init=False, default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.text is not None:
            object.__setattr__(self, "forecast", forecast_from_dict(json.loads(self.text)))

    def learn(self, forecast: Plain | None) -> CurrentForecast:
        """Return a copy with the worker's new forecast; None: unchanged. Raises InvalidValue for anything else."""
        return self if forecast is None else CurrentForecast(self.start_s, self.lost, json.dumps(forecast))

    def predicted(self, time_s: float) -> Prediction | None:
        """Return the prediction for a time; None before the first forecast."""
        return None if self.forecast is None else self.forecast.at(time_s)

    def corrects(self, settings: DriftCompensationSettings, time_s: float) -> bool:
        """Return whether components use sample coordinates at a given time."""
        since_s = 0.0 if self.start_s is None else time_s - self.start_s
        return settings.correct and since_s >= settings.correct_after

    def mapping_at(self, settings: DriftCompensationSettings, time_s: float) -> DriftMapping | None:
        """Return the mapping from tip to sample coordinates; None if components use tip coordinates.

        Before the first forecast the mapping is the identity.
        """
        if not self.corrects(settings, time_s):
            return None
        predicted = self.predicted(time_s)
        return DriftMapping.identity() if predicted is None else predicted.mapping


@dataclass(frozen=True)
class HeldScan:
    """A scan held back until its position is known.

    Attributes:
        middle_s: middle of the scan in experiment time, for which its position holds.
        until_s: end of the wait, real monotonic time.
        filename, center_m: file and centre (tip coordinates) of its first channel.
        asked: whether the worker has a job for this scan.
        tries: number of jobs for this scan so far.
    """

    key: str
    middle_s: float
    until_s: float
    filename: str
    center_m: XY
    asked: bool = False
    tries: int = 0


@dataclass(frozen=True)
class ScanGate:
    """Gate that holds a scan, and all later packets of the microscope, until the scan's position is known.

    All channels of a scan thus get the same, best known mapping, and the order of packets is kept.

    Attributes:
        waiting: held inputs, oldest first.
        settled: mappings of the latest published scans, by key; None for a scan published unchanged.
        wanted: name or role of the channel for registration; None: the topography, or where the microscope declares
            no roles, the first channel in a unit of length.
        channel: name of the channel used for registration; None: not chosen yet.
        roles: the microscope's channels by their roles.
    """

    wanted: str | None = None
    channel: str | None = None
    roles: ChannelRoles = field(default_factory=ChannelRoles)
    held: HeldScan | None = None
    waiting: tuple[Waits, ...] = ()
    settled: Mapping[str, Matrix | None] = field(default_factory=dict)

    def keep(self, event: Waits) -> ScanGate:
        return replace(self, waiting=(*self.waiting, event))

    def next_ns(self) -> int | None:
        """Return the translator's time of the first held packet; None without a held packet."""
        return next((event.packet.time_ns for event in self.waiting if isinstance(event, PacketIn)), None)

    def settle(self, key: str, matrix: Matrix | None) -> ScanGate:
        """Return the gate with a fixed mapping for a scan, which also holds for repeated packets of the scan."""
        others = [(other, one) for other, one in self.settled.items() if other != key]
        return replace(self, settled=dict([*others, (key, matrix)][-_SETTLED:]))

    def opened(self) -> ScanGate:
        """Return the gate without held inputs; the caller must process the inputs in `waiting` again."""
        return replace(self, held=None, waiting=())

    def with_channel_of(self, scan: Scan) -> ScanGate:
        """Return the gate with this scan's channel chosen, if none is chosen yet and it is the wanted one.

        The choice is final: at constant height, a scan of the current can't be compared with earlier ones of heights.
        """
        if self.channel is not None:
            return self
        wanted = self.wanted or (TOPOGRAPHY if self.roles.names else None)
        fits = same_kind(scan.unit, "m") if wanted is None else self.roles.shown(scan).is_of(wanted)
        return replace(self, channel=scan.channel) if fits else self

    def lacking(self) -> str:
        """Return which channel the held scan lacks, and which channels it has."""
        wanted = self.channel or self.wanted or (TOPOGRAPHY if self.roles.names else "in a unit of length")
        channels = (one.header.channel for one in self.waiting if isinstance(one, PacketIn))
        there = ", ".join(dict.fromkeys(channel for channel in channels if channel))
        return f"without the channel {wanted} among {there}"


@dataclass(frozen=True)
class Duties:
    """Earlier responses that later responses depend on.

    Attributes:
        started: whether the scan in the other direction at the start was requested, or is not needed.
        unregistered: number of scans in a row without a result of the worker (error or time limit), while drift is
            corrected and no person is in control.
        given_m_s: drift velocity that the controller compensates.
    """

    started: bool = False
    unregistered: int = 0
    given_m_s: XY = (0.0, 0.0)


@dataclass(frozen=True)
class WorkerLife:
    """State of the worker process, as known to the scheduler.

    Attributes:
        job: the scan being registered.
        ends: number of ends of the worker since its last report about a scan.
        waits_for_person: whether the worker stays ended until a person clears device-malfunction.
        slow_logged: whether a slow registration was logged.
    """

    job: ScanJob | None = None
    ends: int = 0
    waits_for_person: bool = False
    slow_logged: bool = False


# --- responses that are still to be given, each in a step of its own --------------------------------------------------


@dataclass(frozen=True)
class RespondToScan:
    registered: Registered
    job: ScanJob


@dataclass(frozen=True)
class RespondToFailure:
    why: str


@dataclass(frozen=True)
class CallPerson:
    """Deferred response that calls a person, because no more scans will be registered."""


FollowUp = RespondToScan | RespondToFailure | CallPerson


@dataclass(frozen=True)
class DriftState:
    """Complete state of drift compensation.

    Attributes:
        following: deferred responses, each with the real time at which it is due.
    """

    places: Places = field(default_factory=Places)
    forecast: CurrentForecast = field(default_factory=CurrentForecast)
    gate: ScanGate = field(default_factory=ScanGate)
    timing: ScanStartTracker = field(default_factory=ScanStartTracker)
    tally: RegistrationTally = field(default_factory=RegistrationTally)
    duties: Duties = field(default_factory=Duties)
    worker: WorkerLife = field(default_factory=WorkerLife)
    following: tuple[tuple[float, FollowUp], ...] = ()

    @classmethod
    def initial(cls, settings: DriftCompensationSettings) -> DriftState:
        return cls(gate=ScanGate(wanted=settings.channel), duties=Duties(started=settings.at_start == "nothing"))


@dataclass(frozen=True)
class SavedDrift:
    """Part of a `DriftState` that survives a kill."""

    places: SavedPlaces
    forecast: CurrentForecast
    channel: str | None
    settled: Mapping[str, Matrix | None]
    tally: RegistrationTally
    duties: Duties

    @classmethod
    def of(cls, state: DriftState) -> SavedDrift:
        gate = state.gate
        places = SavedPlaces.of(state.places)
        return cls(places, state.forecast, gate.channel, gate.settled, state.tally, state.duties)

    def restored(self, settings: DriftCompensationSettings, codec: DriftCodec) -> DriftState:
        """Return the restored `DriftState`. Raises ValueError for an unreadable place."""
        return DriftState(
            places=self.places.restored(codec),
            forecast=self.forecast,
            gate=ScanGate(settings.channel, None if settings.channel else self.channel, settled=self.settled),
            tally=self.tally,
            duties=self.duties,
        )


@dataclass(frozen=True)
class DriftEnvironment:
    """Constants of all steps: settings, codec and name.

    Attributes:
        name: name of the scheduler, under which problems are flagged.
    """

    settings: DriftCompensationSettings
    codec: DriftCodec
    name: str


_PARTS = tuple(one.name for one in fields(DriftState))


class DriftDraft:
    """Mutable copy of the state during one step, with the outputs so far and the time.

    Attributes:
        control: control state of the scheduler before the input of this step.
        now_s: real monotonic time, for timeouts.
        now_ns: experiment time.
    """

    places: Places
    forecast: CurrentForecast
    gate: ScanGate
    timing: ScanStartTracker
    tally: RegistrationTally
    duties: Duties
    worker: WorkerLife
    following: tuple[tuple[float, FollowUp], ...]

    def __init__(
        self, state: DriftState, env: DriftEnvironment, control: ArbitrationState, now_s: float, now_ns: int
    ) -> None:
        self.__dict__.update(state.__dict__)
        self.env = env
        self.control = control
        self.now_s = now_s
        self.now_ns = now_ns
        self.outputs: list[FrameOutput] = []

    @property
    def corrects(self) -> bool:
        return self.forecast.corrects(self.env.settings, self.now_ns * 1e-9)

    def log(self, level: str, text: str) -> None:
        self.outputs.append(Log(level, text))

    def finish(self) -> DriftState:
        return DriftState(**{name: self.__dict__[name] for name in _PARTS})
