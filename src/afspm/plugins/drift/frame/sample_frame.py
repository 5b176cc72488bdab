"""`SampleFrame`: the coordinate frame of a drifting sample.

Theory of operation
-------------------

The frame is a part of the scheduler's state behind `scheduler.coordinate_frame`. Its decisions are in three modules:

| decision | module |
| --- | --- |
| map requests and packets by the forecast of drift | `place_mapper` |
| hold scans until they are registered, then settle their mapping | `scan_intake` |
| flag problems, request rescans, hand over rates after a scan was published | `response` |

The worker is a process of its own, since a registration takes as long as the publication of many scans. Its start and
its jobs are effects (`Delegate`), its reports inputs (`FrameReported`). A report may come late, twice, or never; in
each case the scan is published once, with one mapping. Requests never wait for a scan.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, get_args

from afspm.basics import AfspmError, replace
from afspm.components import from_plain
from afspm.model import (
    ControlRequest,
    LoggedPacket,
    Packet,
    PacketHeader,
    Parameter,
    ProbePosition,
    Region,
    Request,
    Response,
    names,
)
from afspm.plugins.drift.frame import response, scan_intake
from afspm.plugins.drift.frame.messages import DriftCodec, StartWorker, WorkerReport
from afspm.plugins.drift.frame.place_mapper import PlaceMapper
from afspm.plugins.drift.frame.response import RateGiven
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.plugins.drift.frame.state import DriftDraft, DriftEnvironment, DriftState, SavedDrift
from afspm.scheduler import (
    ArbitrationState,
    AskMicroscope,
    ControlChanged,
    Delegate,
    FrameAnswered,
    FrameOutput,
    FrameReported,
    Input,
    MappedRequest,
    PacketIn,
    RequestIn,
    SaveNow,
    Started,
    Tick,
    TranslatorCaughtUp,
    TranslatorUp,
)


@dataclass(frozen=True)
class SampleFrame:
    """Implementation of `scheduler.coordinate_frame.CoordinateFrame` for a drifting sample."""

    env: DriftEnvironment
    state: DriftState

    is_moving: ClassVar[bool] = True
    reports: ClassVar[tuple[type, ...]] = get_args(WorkerReport)

    @classmethod
    def initial(cls, settings: DriftCompensationSettings, codec: DriftCodec, name: str) -> SampleFrame:
        """Return the frame at the start of an experiment.

        Args:
            name: name of the scheduler, under which problems are flagged.
        """
        return cls(DriftEnvironment(settings, codec, name), DriftState.initial(settings))

    # --- inputs ---

    def step(
        self, event: Input, control: ArbitrationState, now_s: float, now_ns: int
    ) -> tuple[SampleFrame, Sequence[FrameOutput]]:
        draft = DriftDraft(self.state, self.env, control, now_s, now_ns)
        match event:
            case PacketIn():
                scan_intake.take_packet(draft, event)
            case TranslatorCaughtUp() if draft.gate.held is not None:
                draft.gate = draft.gate.keep(event)  # the waiting packets were published before it
            case RequestIn() if event.request.kind == ControlRequest.END_EXPERIMENT and draft.gate.held is not None:
                why = "the experiment ended before"
                scan_intake.publish_as_predicted(draft, draft.gate.held, why, "WARNING")
                draft.outputs.append(event)
            case FrameReported():
                report: WorkerReport = event.report  # type: ignore[assignment]  # of this frame's worker
                scan_intake.take_report(draft, report)
            case FrameAnswered():
                if isinstance(event.purpose, RateGiven):
                    response.rate_answered(draft, event.purpose, event.response)
            case Tick() if draft.following:
                _respond(draft)  # one per step, since a response may change which client is in control
            case Tick():
                draft.outputs.append(event)
                scan_intake.expire(draft)
            case Started():
                _start(draft)
            case ControlChanged():
                _follow_control(draft, event)
            case TranslatorUp():
                draft.outputs.append(event)
                _ask_direction(draft)
                response.restore_compensation(draft)
            case _:
                return self, (event,)
        return self._with(draft.finish()), draft.outputs

    def deadline_s(self) -> float | None:
        held, following = self.state.gate.held, self.state.following
        if following:
            return following[0][0]
        return None if held is None else held.until_s

    def _with(self, state: DriftState) -> SampleFrame:
        return SampleFrame(self.env, state)

    # --- coordinates ---

    def maps(self, now_ns: int) -> bool:
        return self.state.forecast.corrects(self.env.settings, now_ns * 1e-9)

    def in_force(self, place: Region | ProbePosition, now_ns: int) -> SampleFrame:
        mapper = self._mapper()
        mapper.in_force(place, now_ns)
        return self._mapped(mapper)

    def outgoing(self, who: str, request: Request, now_ns: int) -> tuple[SampleFrame, MappedRequest | Response | None]:
        mapper = self._mapper()
        outgoing = mapper.outgoing(who, request, now_ns)
        return self._mapped(mapper), outgoing

    def move_before(self, action: str, now_ns: int) -> tuple[SampleFrame, MappedRequest | None]:
        mapper = self._mapper()
        move = mapper.move_before(action, now_ns)
        return self._mapped(mapper), move

    def carried_out(self, sent: Request, reported: Parameter | None, now_ns: int) -> SampleFrame:
        mapper = self._mapper()
        mapper.carried_out(sent, reported, now_ns)
        return self._mapped(mapper)

    def answer(self, asked: Request, reported: Parameter | None, now_ns: int) -> Parameter | None:
        return self._mapper().answer(asked, reported, now_ns)

    def incoming(self, packet: Packet, header: PacketHeader, now_ns: int) -> tuple[SampleFrame, Packet]:
        mapper = self._mapper()
        packet = mapper.incoming(packet, header, now_ns)
        return self._mapped(mapper), packet

    def _mapper(self) -> PlaceMapper:
        forecast, settings = self.state.forecast, self.env.settings
        return PlaceMapper(self.state.places, self.env.codec, lambda time_s: forecast.mapping_at(settings, time_s))

    def _mapped(self, mapper: PlaceMapper) -> SampleFrame:
        return self._with(replace(self.state, places=mapper.finish()))

    # --- over a kill ---

    def saved(self) -> SavedDrift:
        return SavedDrift.of(self.state)

    def restored(self, plain: object) -> SampleFrame:
        if plain is None:
            return self
        try:
            saved: SavedDrift = from_plain(SavedDrift, plain)
            return self._with(saved.restored(self.env.settings, self.env.codec))
        except (AfspmError, AttributeError) as error:  # saved by another tracker or frame
            raise ValueError(f"the saved drift can't be used: {error}") from error

    def recalled(self, packets: Iterable[LoggedPacket]) -> SampleFrame:
        draft = DriftDraft(self.state, self.env, ArbitrationState(), 0.0, 0)
        for packet, source_ns, _ in packets:
            time_ns = packet.time_ns if source_ns is None else source_ns
            scan_intake.note_timing(draft, packet.envelope, packet.payload, time_ns)
        return self._with(draft.finish())


def _start(draft: DriftDraft) -> None:
    if draft.forecast.start_s is None:
        draft.forecast = replace(draft.forecast, start_s=draft.now_ns * 1e-9)
    draft.outputs.append(Delegate(StartWorker()))


def _respond(draft: DriftDraft) -> None:
    (_, what), *rest = draft.following
    draft.following = tuple(rest)
    if not draft.control.ended:
        response.respond(draft, what)
        draft.outputs.append(SaveNow())


def _follow_control(draft: DriftDraft, change: ControlChanged) -> None:
    if change.after.ended and not change.before.ended and draft.tally.scans:
        draft.log("INFO", f"drift: {draft.tally.summary()}")
    scan_intake.restart_if_cleared(draft)


@dataclass(frozen=True)
class _DirectionAsked:
    """Marker of a request for the scan direction; the answer is processed like any parameter value."""


def _ask_direction(draft: DriftDraft) -> None:
    parameter = Parameter(names.SCAN_DIRECTION)
    request = Request(int(ControlRequest.PARAM), parameter, draft.env.codec.encode(parameter))
    draft.outputs.append(AskMicroscope(request, _DirectionAsked()))
