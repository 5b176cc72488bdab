"""`DriftCore`: a `SchedulerCore` in whose coordinates the sample stands still."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace

from afspm.drift.mapping import Mapping
from afspm.errors import AfspmError
from afspm.formatting import lengths_text
from afspm.logic.events import (
    Announced,
    Effect,
    Input,
    Log,
    PacketIn,
    RequestIn,
    SaveState,
    Tick,
    TranslatorCaughtUp,
    TranslatorUp,
)
from afspm.logic.scheduler_core import SchedulerCore
from afspm.logic.settings import SchedulerSettings
from afspm.logic.state import SavedState
from afspm.model import (
    ControlRequest,
    Frame,
    LoggedPacket,
    Packet,
    PacketHeader,
    Parameter,
    Region,
    RegistrationOutcome,
    Request,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.model.geometry import XY
from afspm.plain_data import Plain
from afspm.scheduler.drift.forecast import CurrentForecast
from afspm.scheduler.drift.frame import DriftFrame
from afspm.scheduler.drift.messages import (
    DriftCodec,
    NotRegistered,
    Registered,
    ScanJob,
    Worker,
    WorkerGone,
    WorkerSaid,
)
from afspm.scheduler.drift.positions import is_same
from afspm.scheduler.drift.response import DriftResponse, Step
from afspm.scheduler.drift.scan_gate import DriftChannel, HeldScan, Matrix, ScanGate
from afspm.scheduler.drift.scan_timing import ScanStartTracker
from afspm.scheduler.drift.settings import DriftCompensationSettings
from afspm.scheduler.drift.tally import RegistrationTally

MAPPING = "DriftMapping"
Following = Callable[[Step, int], list[Effect]]
_HOW = {
    RegistrationOutcome.COARSE: "is registered coarsely",
    RegistrationOutcome.REFUSED: "is not recognised, and published at the predicted position",
    RegistrationOutcome.FAILED: "could not be registered, and is published at the predicted position",
    RegistrationOutcome.NEW: "shows a new place, and is published at the predicted position",
}
_LEVELS = {
    RegistrationOutcome.COARSE: "WARNING",
    RegistrationOutcome.REFUSED: "WARNING",
    RegistrationOutcome.FAILED: "ERROR",
    RegistrationOutcome.NEW: "INFO",
}
_MOST_TRIES = 2
"""So often a scan is registered, if the worker ends over it."""
_MOST_ENDS = 4
"""After so many ends in a row, without a scan registered between them, it is not started again."""


class DriftCore(SchedulerCore):
    """A `SchedulerCore` that follows drift.

    Scans are held back until the worker has registered them; then everything that came after them follows. What the
    worker says is an input, too: `said`.

    Args:
        name: of the scheduler.
    """

    def __init__(
        self,
        settings: SchedulerSettings,
        drift: DriftCompensationSettings,
        codec: DriftCodec,
        worker: Worker,
        name: str,
    ) -> None:
        self.knowledge = CurrentForecast(drift)
        self.frame = DriftFrame(codec, self.knowledge.mapping_at)
        self.frame.beside = self._kept
        super().__init__(settings, codec, self.frame)
        self._settings = drift
        self._codec = codec
        self._worker = worker
        self._tally = RegistrationTally()
        self._consequences = DriftResponse(drift, self, codec, self.frame, self.knowledge, self._tally, worker, name)
        self._gate = ScanGate()
        self._jobs: dict[str, ScanJob] = {}
        self._beginning = ScanStartTracker()
        self._channel = DriftChannel(drift.channel)
        self._following: deque[tuple[float, Following]] = deque()
        self._ends = 0
        self._waits_for_a_person = False
        self._told_slow = False

    # --- life ---

    def start(self, now_s: float, now_ns: int) -> list[Effect]:
        if self.knowledge.start_s is None:
            self.knowledge.start_s = now_ns * 1e-9
        self._worker.start()
        return super().start(now_s, now_ns)

    def step(self, event: Input, now_s: float, now_ns: int) -> list[Effect]:
        had_ended = self.control.ended
        effects = self._stepped(event, now_s, now_ns)
        if self.control.ended and not had_ended and self._tally.scans:
            effects.insert(0, Log("INFO", f"drift: {self._tally.summary()}"))
        return effects

    def _stepped(self, event: Input, now_s: float, now_ns: int) -> list[Effect]:
        if isinstance(event, PacketIn):
            return self._on_packet(event, now_s, now_ns)
        if isinstance(event, Tick) and self._following:
            return self._follow(now_s, now_ns)
        held, effects = self._gate.held, list[Effect]()
        if held is not None and isinstance(event, TranslatorCaughtUp):
            self._gate.keep(event)  # there is more to come, which waits as well
            return []
        if held is not None and isinstance(event, RequestIn) and event.request.kind == ControlRequest.END_EXPERIMENT:
            # what was measured, before the end
            effects = self._publish_as_predicted(held, "the experiment ended before", now_s, now_ns, "WARNING")
        effects += super().step(event, now_s, now_ns)
        if self._waits_for_a_person and not self._consequences.is_given_up:
            self._waits_for_a_person, self._ends = False, 0
            self._worker.start()
        if isinstance(event, Tick):
            effects += self._late(now_s, now_ns)
        elif isinstance(event, TranslatorUp):
            effects += self._ask_direction(now_s) + self._consequences.begin_compensation(now_s)
        return effects

    def said(self, event: WorkerSaid, now_s: float, now_ns: int) -> list[Effect]:
        """The worker said something."""
        if isinstance(event, Registered):
            return self._registered(event, now_s, now_ns)
        if isinstance(event, NotRegistered):
            self._ends = 0
            return self._give_up(event.key, event.reason, now_s, now_ns)
        if isinstance(event, WorkerGone):
            return self._gone(event, now_s, now_ns)
        return self._learn(event.forecast)

    def deadline_s(self) -> float | None:
        held = self._gate.held
        due_s = (
            super().deadline_s(),
            None if held is None else held.until_s,
            self._following[0][0] if self._following else None,
        )
        return min((one_s for one_s in due_s if one_s is not None), default=None)

    def restore(self, saved: SavedState) -> None:
        super().restore(saved)
        kept = self.frame.restored
        if kept:
            self.knowledge.restore(kept["knowledge"])
            self._consequences.restore(kept["consequences"])
            self._gate.restore(kept["scans"])
            self._tally.restore(kept["tally"])
            self._channel.name = self._settings.channel or kept["channel"]

    def restore_cache(self, packets: Iterable[LoggedPacket]) -> None:
        entries = list(packets)
        super().restore_cache(entries)
        for packet, source_ns, _ in entries:
            if packet.envelope == "ScopeStateMsg":
                self._note_state(packet.payload, packet.time_ns if source_ns is None else source_ns)

    def _kept(self) -> Plain:
        return {
            "knowledge": self.knowledge.to_dict(),
            "consequences": self._consequences.to_dict(),
            "scans": self._gate.to_list(),
            "tally": self._tally.to_dict(),
            "channel": self._channel.name,
        }

    # --- packets ---

    def _on_packet(self, event: PacketIn, now_s: float, now_ns: int) -> list[Effect]:
        if self._gate.held is not None:
            self._gate.keep(event)
            return self._look_at(event, now_s, now_ns)
        message = event.header.message
        if message == "ScopeStateMsg":
            self._note_state(event.packet.payload, event.packet.time_ns)
        if message != "Scan2d":
            return super().step(event, now_s, now_ns)
        scan = self._codec.decode_packet(message, event.packet.payload)
        if not isinstance(scan, Scan) or not scan.values.size:
            return super().step(event, now_s, now_ns)
        key = scan_key(scan, event.packet)
        if self._gate.is_settled(key):
            return super().step(_relocated(event, scan, self._gate.mapping_of(key), self._codec), now_s, now_ns)
        self._beginning.scan_came()
        until_s = now_s + self._settings.longest_registration
        middle_s = self._middle_s(scan, event, now_ns)
        self._gate.hold(HeldScan(key, middle_s, until_s, scan.filename, scan.region.center_m))
        self.put_off(until_s)
        self._gate.keep(event)
        return self._look_at(event, now_s, now_ns)

    def _look_at(self, event: PacketIn, now_s: float, now_ns: int) -> list[Effect]:
        """A packet that waits: is it the channel to register, or the end of a scan that has none?"""
        held = self._gate.held
        assert held is not None
        if held.asked:
            return []
        if self._ends >= _MOST_ENDS:
            # a person was called, or decided that it goes on
            return self._publish_as_predicted(held, "drift is no longer followed", now_s, now_ns, "WARNING")
        message = event.header.message
        if message == "ScopeStateMsg":
            status = self._codec.decode_packet(message, event.packet.payload)
            if isinstance(status, ScopeStatus) and status.state is not ScopeState.SCANNING:
                return self._without_channel(held.key, now_s, now_ns)
        elif message == "Scan2d":
            scan = self._codec.decode_packet(message, event.packet.payload)
            if not isinstance(scan, Scan) or not scan.values.size:
                return []
            if scan_key(scan, event.packet) == held.key and self._channel.is_of(scan):
                self._register(held, scan, event, now_ns)
        return []

    def _without_channel(self, key: str, now_s: float, now_ns: int) -> list[Effect]:
        return self._give_up(key, self._channel.missing(), now_s, now_ns, "WARNING")

    def _register(self, held: HeldScan, scan: Scan, event: PacketIn, now_ns: int) -> None:
        end_s = _end_s(scan, event, now_ns)
        start_s, upwards = 2 * held.middle_s - end_s, None
        begun = self._beginning.of_scan(end_s)
        if begun is not None and not begun.was_paused:
            upwards = begun.upwards
            self.frame.durations.learn(scan.shape, scan.region.size_m, end_s - start_s)
        job = ScanJob(held.key, scan, start_s, end_s, upwards, self._asked(scan))
        self._jobs = {held.key: job}
        held.asked, held.tries = True, held.tries + 1
        self._worker.register(job)

    def _asked(self, scan: Scan) -> Region | None:
        """The region that a scan was meant to show, if it was taken where we had it set."""
        place = self.frame.region.current
        if place is None or not is_same(place.tip, scan.region):
            return None
        return replace(place.sample, frame=Frame.SAMPLE)

    def _middle_s(self, scan: Scan, event: PacketIn, now_ns: int) -> float:
        """Between when it began and its own end, so that a file that comes late biases nothing."""
        expected_s = self.frame.durations.expected_s(scan.shape, scan.region.size_m)
        return self._beginning.middle_s(_end_s(scan, event, now_ns), expected_s)

    def _note_state(self, payload: bytes | memoryview, time_ns: int | None) -> None:
        status = self._codec.decode_packet("ScopeStateMsg", payload)
        if isinstance(status, ScopeStatus) and time_ns is not None:
            self._beginning.state(status, time_ns * 1e-9, self.frame.upwards)

    # --- what comes of a scan ---

    def _registered(self, said: Registered, now_s: float, now_ns: int) -> list[Effect]:
        self._ends = 0
        effects = self._learn(said.forecast)
        job = self._jobs.pop(said.key, None)
        held = self._gate.held
        is_awaited = held is not None and held.key == said.key
        if held is not None and is_awaited:
            correcting = self.knowledge.corrects(said.time_s)
            self._gate.settle(said.key, said.matrix if correcting else None)
            effects += self._slow(held, now_s)
        if job is None:
            return effects  # long told: a worker that was restarted says it again
        self.knowledge.lost = said.lost
        before_ns = self._gate.next_ns() if is_awaited else None
        effects += self._announce(said, job.scan.filename, job.scan.region.center_m, before_ns, now_s, now_ns)
        effects += self._told(said, job.scan.filename)
        if is_awaited:
            effects += self._release(now_s, now_ns)
        self._following.append((now_s, lambda step, now_ns: self._consequences.of(said, job, step, now_ns)))
        return effects + self._consequences.hand_over(now_s, now_ns)

    def _announce(
        self, said: Registered, filename: str, center_m: XY, before_ns: int | None, now_s: float, now_ns: int
    ) -> list[Effect]:
        """Count a scan, and publish how its position is known."""
        self._tally.add(said.outcome)
        payload = self._codec.encode_mapping(
            said, filename, center_m, correcting=self.knowledge.corrects(now_ns * 1e-9)
        )
        return super().step(Announced(MAPPING, payload, before_ns), now_s, now_ns)

    def _told(self, said: Registered, filename: str, level: str = "") -> list[Effect]:
        """Log the errors of an estimator, and a scan that is not registered well."""
        effects: list[Effect] = [Log("ERROR", failure) for failure in said.failures]
        if said.outcome is not RegistrationOutcome.REGISTERED:
            how = _HOW[said.outcome]
            sd = "unknown" if math.isnan(said.sd_m) else f"± {lengths_text([float(f'{said.sd_m:.2g}')])}"
            name = filename.replace("\\", "/").rpartition("/")[2] or said.key
            why = "" if said.failures else f": {said.reason}"  # an error is logged already
            text = f"scan {name} {how} ({sd}){why}; {self._tally.summary()}"
            effects.append(Log(level or _LEVELS[said.outcome], text))
        return effects

    def _follow(self, now_s: float, now_ns: int) -> list[Effect]:
        """Do what follows from a published scan: a step of its own, since it may change who is in control."""
        _, following = self._following.popleft()
        if self.control.ended:
            return []
        effects = following(lambda event: SchedulerCore.step(self, event, now_s, now_ns), now_ns)
        return [*effects, SaveState(self.snapshot())]

    def _learn(self, forecast: Plain | None) -> list[Effect]:
        try:
            self.knowledge.learn(forecast)
        except AfspmError as error:
            return [Log("ERROR", f"the drift forecast can't be read: {error}")]
        return []

    def _slow(self, held: HeldScan, now_s: float) -> list[Effect]:
        """Told once, before it takes too long: with more references it takes several times as long."""
        limit_s = self._settings.longest_registration
        took_s = now_s - (held.until_s - limit_s)
        if self._told_slow or took_s < limit_s / 3:
            return []
        self._told_slow = True
        text = f"registering a scan took {took_s:.1f} s, and is given up after longest_registration = {limit_s:g} s"
        return [Log("WARNING", f"{text}: use fewer pixels, or raise it")]

    def _give_up(self, key: str, why: str, now_s: float, now_ns: int, level: str = "") -> list[Effect]:
        """A scan goes out with the prediction; too many of them, and the prediction is not to be relied on."""
        held = self._gate.held
        if held is None or held.key != key:
            return []
        self._following.append((now_s, lambda step, now_ns: self._consequences.unregistered(why, step, now_ns)))
        return self._publish_as_predicted(held, why, now_s, now_ns, level)

    def _publish_as_predicted(
        self, held: HeldScan, why: str, now_s: float, now_ns: int, level: str = ""
    ) -> list[Effect]:
        self._gate.settle(held.key, self.knowledge.matrix_at(held.middle_s))
        said = self._predicted(held, why)
        effects = self._announce(said, held.filename, held.center_m, self._gate.next_ns(), now_s, now_ns)
        effects += self._told(said, held.filename, level)
        return [*effects, SaveState(self.snapshot()), *self._release(now_s, now_ns)]

    def _predicted(self, held: HeldScan, why: str) -> Registered:
        """Return what is known of a scan that could not be registered."""
        there = self.knowledge.predicted(held.middle_s)
        known = None if there is None else (there.covariance_m2, there.rate_m_s, there.rate_covariance)
        covariance_m2, rate_m_s, rate_covariance = ([], [], []) if known is None else (one.tolist() for one in known)
        return Registered(
            key=held.key,
            time_s=held.middle_s,
            matrix=(Mapping.identity() if there is None else there.mapping).matrix.tolist(),
            covariance_m2=covariance_m2,
            rate_m_s=rate_m_s,
            rate_covariance=rate_covariance,
            outcome=RegistrationOutcome.FAILED,
            lost=self.knowledge.lost,
            reason=why,
            residual_m=[],
            references=[],
            rescan="",
            forecast=None,
            failures=[],
        )

    def _release(self, now_s: float, now_ns: int) -> list[Effect]:
        effects: list[Effect] = []
        for event in self._gate.open():
            effects += self.step(event, now_s, now_ns)
        return effects

    def _late(self, now_s: float, now_ns: int) -> list[Effect]:
        held = self._gate.held
        if held is None or now_s < held.until_s:
            return []
        limit_s = self._settings.longest_registration
        why = f"it was not registered within {limit_s:g} s"
        if held.asked:
            self._jobs.clear()
            self._worker.start()
        return self._give_up(held.key, why, now_s, now_ns)

    def _gone(self, event: WorkerGone, now_s: float, now_ns: int) -> list[Effect]:
        self._ends += 1
        held = self._gate.held
        if self._ends >= _MOST_ENDS:
            effects: list[Effect] = [Log("CRITICAL", f"drift is no longer followed: {event.reason}")]
            self._following.append((now_s, self._wait_for_a_person))
            return effects if held is None else effects + self._publish_as_predicted(held, event.reason, now_s, now_ns)
        effects = [Log("ERROR", f"the process that registers scans ended and is restarted: {event.reason}")]
        self._worker.start()
        if held is None or not held.asked:
            return effects
        job = self._jobs.get(held.key)
        if job is None or held.tries >= _MOST_TRIES:
            return effects + self._give_up(held.key, event.reason, now_s, now_ns)
        held.tries += 1
        self._worker.register(job)
        return effects

    def _wait_for_a_person(self, step: Step, now_ns: int) -> list[Effect]:
        """Nothing will be registered any more, until somebody has looked why; where drift is never corrected, that
        holds up nobody."""
        self._waits_for_a_person = self._settings.correct
        return self._consequences.give_up(step) if self._waits_for_a_person else []

    def _ask_direction(self, now_s: float) -> list[Effect]:
        parameter = Parameter(names.SCAN_DIRECTION)
        request = Request(int(ControlRequest.PARAM), parameter, self._codec.encode(parameter))
        return self.ask_own(request, now_s, lambda response, now_s, now_ns: ())


def scan_key(scan: Scan, packet: Packet) -> str:
    """Return a key that all channels of a scan share, and no other scan has."""
    if scan.time_ns is None and scan.filename:
        return scan.filename
    return f"at {packet.time_ns if scan.time_ns is None else scan.time_ns} ns"


def _end_s(scan: Scan, event: PacketIn, now_ns: int) -> float:
    time_ns = scan.time_ns if scan.time_ns is not None else event.packet.time_ns
    return (now_ns if time_ns is None else time_ns) * 1e-9


def _relocated(event: PacketIn, scan: Scan, matrix: Matrix | None, codec: DriftCodec) -> PacketIn:
    if matrix is None:
        return event
    region = Mapping(matrix).to_sample(scan.region)  # type: ignore[arg-type]
    packet, header = event.packet, event.header
    payload = codec.relocated("Scan2d", packet.payload, codec.encode(ScanParameters(region)))
    size_m = region.size_m if header.size_m is not None else None
    moved = PacketHeader(header.message, header.channel, size_m, header.kind, header.time_ns)
    return PacketIn(Packet(packet.envelope, payload, packet.time_ns), moved)
