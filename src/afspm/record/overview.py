"""`Overview`: what an experiment has come to, from all that is published. Terminal, dashboard and report show it."""

from __future__ import annotations

import sys
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any, TypeVar

import numpy as np

from afspm import wire
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import WireError
from afspm.basics.units import convert, same_kind
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlState,
    Feedback,
    Frame,
    JournalEntries,
    JournalEntry,
    LogLine,
    LogLines,
    Note,
    ProbePosition,
    Problem,
    ProblemNames,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    Region,
    RegistrationOutcome,
    RescanKind,
    Scan,
    ScanLines,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    registration_summary,
)
from afspm.model.drift_mapping import drift_at, drift_knowledge
from afspm.model.events import PERSON
from afspm.model.geometry import XY
from afspm.record.running_scan import DoneScan, RunningScan
from afspm.record.timeline import Span, Timeline

__all__ = [
    "ROUTINE",
    "DriftPoint",
    "FoundPlace",
    "Overview",
    "ProcessRestart",
    "RunningScan",
    "ScanSummary",
    "Span",
    "SpectrumSummary",
    "Timeline",
]

MOST_LINES = 2_000
MOST_ENTRIES = 5_000
MOST_MEASURED = 100_000
MOST_TARGETS = 1_000
SOON_NS = 1_000_000_000
OLD_S = 6.0  # real; a supervisor says how its processes are every 2 s
OVER = (ProcessCondition.ENDED, ProcessCondition.GIVEN_UP)
"""Of a process of which nothing more is to be heard."""
COMPARED = 5  # scans before, by which it is told how long one takes
NOBODY = None
ROUTINE = "normal at the start: the first scan is taken in both directions, which gives the velocity of the drift"
"""Why a problem that is flagged in the normal course of a run is none."""
K = TypeVar("K")
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class ScanSummary:
    """One channel of a scan, without its values.

    Attributes:
        time_ns: when it was finished, or interrupted.
        began_ns: None if that was not seen.
        shape: (rows, columns).
        holder: who was in control; None if nobody was, or it is not known.
        interrupted: only a part of it was taken.
        setpoint: of the feedback when it began, in the unit of the operating mode; None if it was not published.
        number: of the scan in the run, from 1; its channels have the same.
    """

    time_ns: int
    began_ns: int | None
    channel: str
    unit: str
    region: Region
    shape: tuple[int, int]
    filename: str = ""
    holder: str | None = None
    interrupted: bool = False
    setpoint: float | None = None
    number: int = 0

    def is_of_scan(self, other: ScanSummary) -> bool:
        """Return whether both are channels of one scan."""
        if self.channel == other.channel or self.region != other.region:
            return False
        if self.began_ns is not None and other.began_ns is not None:
            return self.began_ns == other.began_ns
        return abs(self.time_ns - other.time_ns) <= SOON_NS


@dataclass(frozen=True, slots=True)
class SpectrumSummary:
    """A spectrum, without its values. `position_m` is (x, y) in `frame`; None if it is not known."""

    time_ns: int
    kind: str
    position_m: XY | None
    frame: Frame
    names: tuple[str, ...]
    units: tuple[str, ...]
    filename: str = ""
    holder: str | None = None


@dataclass(frozen=True, slots=True)
class FoundPlace:
    """A place that a component has found, with its score if it gave one."""

    xy_m: XY
    score: float | None = None


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """The drift after one scan.

    Attributes:
        translation_m: (x, y) displacement of the sample under the tip since the start, in tip coordinates.
        rate_m_s: (x, y) velocity of the sample then.
        matched: whether the scan was registered; else this is a prediction.
        lost: it is not known any more where the sample is.
        correcting: whether components were given sample coordinates.
        reason: why it was not registered, or only coarsely.
        outcome: how the position of the scan is known.
        sd_m: standard deviation of the position along the axis where it is largest; None: not known.
        failures: the number of errors of the estimator over the scan.
        filename: of the scan.
    """

    time_ns: int
    translation_m: XY
    rate_m_s: XY
    matched: bool = True
    lost: bool = False
    correcting: bool = False
    reason: str = ""
    outcome: RegistrationOutcome = RegistrationOutcome.REGISTERED
    sd_m: float | None = None
    failures: int = 0
    filename: str = ""


@dataclass(frozen=True, slots=True)
class ProcessRestart:
    """A process was started anew: the `starts`-th time, after it had ended as `last_exit` says."""

    time_ns: int
    name: str
    starts: int
    last_exit: str


class Overview:
    """Reduces packets to what is so and what has happened. Nothing of it depends on clocks, sockets or files.

    A packet that was taken already changes nothing, so that replays can be given to it as they come; of each
    envelope the packets are to come in the order of their times.

    Args:
        problems: their names, by which it is found in the journal who flagged them.

    Attributes:
        newest_ns: the time of the newest packet; 0 before the first.
        status, control, scan_parameters, feedback, probe_position: the newest of each; None before the first.
        processes, told_progress: by name; `processes_told_ns`: when each process was told of last.
        log, notes, entries, refusals: newest last, bounded.
        targets: the places that components have found, as each told last.
        controls: lane of who was in control; `modes`, `states`: lanes of mode and scope state, in lower case.
        problem_timelines: by number; `process_timelines`: by name. A process that is busy counts as alive.
        running: the scan that is being taken; None if none is.
    """

    def __init__(self, problems: ProblemNames | None = None, *, most_entries: int = MOST_ENTRIES) -> None:
        self.problems = problems or ProblemNames()
        self.newest_ns = 0
        self.status: ScopeStatus | None = None
        self.control: ControlState | None = None
        self.scan_parameters: ScanParameters | None = None
        self.feedback: Feedback | None = None
        self.probe_position: ProbePosition | None = None
        self.processes: dict[str, ProcessState] = {}
        self.processes_told_ns: dict[str, int] = {}
        self.told_progress: dict[str, Progress] = {}
        self.log: deque[LogLine] = deque(maxlen=MOST_LINES)
        self.notes: deque[Note] = deque(maxlen=most_entries)
        self.entries: deque[JournalEntry] = deque(maxlen=most_entries)
        self.refusals: deque[JournalEntry] = deque(maxlen=most_entries)
        self.controls, self.modes, self.states = Timeline(), Timeline(), Timeline()
        self.problem_timelines: defaultdict[int, Timeline] = defaultdict(Timeline)
        self.process_timelines: defaultdict[str, Timeline] = defaultdict(Timeline)
        self.restarts: deque[ProcessRestart] = deque(maxlen=most_entries)
        self.running: RunningScan | None = None
        self._targets: dict[str, tuple[FoundPlace, ...]] = {}
        self._done: deque[DoneScan] = deque(maxlen=20)
        self._scans: dict[tuple[object, ...], ScanSummary] = {}
        self._spectra: dict[tuple[object, ...], SpectrumSummary] = {}
        self._drift: dict[int, DriftPoint] = {}
        self._opposite_ns: deque[int] = deque(maxlen=20)
        self._taken_ns: dict[str, int] = {}

    @property
    def scans(self) -> Sequence[ScanSummary]:
        """One for each channel of each scan, in the order in which they came."""
        return tuple(self._scans.values())

    @property
    def spectra(self) -> Sequence[SpectrumSummary]:
        """In the order in which they came."""
        return tuple(self._spectra.values())

    @property
    def drift(self) -> Sequence[DriftPoint]:
        """In the order in which they came."""
        return tuple(self._drift.values())

    @property
    def registration(self) -> str:
        """Return how many scans were registered, for people; empty where drift is not followed."""
        return registration_summary(point.outcome for point in self._drift.values()) if self._drift else ""

    def is_routine(self, span: Span | None) -> bool:
        """Return whether a problem is flagged in the normal course of a run.

        That is thermal-drift until the first scan of a run with drift correction was taken in both directions.
        """
        if span is None or span.label != self.problems.name(Problem.THERMAL_DRIFT):
            return False
        return any(abs(span.start_ns - asked_ns) <= SOON_NS for asked_ns in self._opposite_ns)

    @property
    def problem_spans(self) -> list[Span]:
        """The spans of all problems in the order of time, without those that are routine."""
        spans = (span for lane in self.problem_timelines.values() for span in lane.spans)
        return sorted((span for span in spans if not self.is_routine(span)), key=lambda span: span.start_ns)

    @property
    def routine_spans(self) -> list[Span]:
        """The spans of problems that are routine; see `is_routine`."""
        return [s for lane in self.problem_timelines.values() for s in lane.spans if self.is_routine(s)]

    @property
    def in_control(self) -> str:
        """The holder of control; in MANUAL the person who set that mode, or "a person"; empty: it is free."""
        if self.control is None:
            return ""
        if self.control.mode is not ControlMode.MANUAL:
            return self.control.holder or ""
        changes = (one for one in reversed(self.entries) if one.event is ControlEvent.MODE_CHANGED)
        newest = next(changes, None)
        who = newest.who if newest is not None and newest.mode is ControlMode.MANUAL else ""
        return who.partition(PERSON)[2] or who or "a person"

    @property
    def ended_ns(self) -> int | None:
        """When the experiment ended; None: it goes on, was stopped, or was cut off."""
        entries = reversed(self.entries)
        return next((one.time_ns for one in entries if one.event is ControlEvent.EXPERIMENT_ENDED), None)

    @property
    def note_spans(self) -> list[Span]:
        """The notes as spans without length, for time lines."""
        spans = [Span(note.text, note.time_ns, note.time_ns, note.who) for note in self.notes]
        return sorted(spans, key=lambda span: span.start_ns)

    @property
    def targets(self) -> Sequence[FoundPlace]:
        """Of each channel, those of the newest list."""
        return tuple(target for found in self._targets.values() for target in found)

    @property
    def progress(self) -> dict[str, tuple[int, int]]:
        """(done, of) of each component that says how far it is."""
        return {name: (told.done, told.of) for name, told in self.told_progress.items()}

    @property
    def control_since_ns(self) -> int | None:
        """Since when whoever is in control is, or nobody is; None if nothing is known."""
        is_manual = self.control is not None and self.control.mode is ControlMode.MANUAL
        return self.modes.changed_ns if is_manual else self.controls.changed_ns

    def scan_progress(self, now_ns: int) -> tuple[float, int] | None:
        """Of the running scan: (the part that is done, 0 to 1, and how many ns remain); None if that is not known."""
        if self.running is None:
            return None
        took_ns = [scan.took_ns for scan in reversed(self._done) if scan.resembles(self.running)][:COMPARED]
        return self.running.progress(now_ns, round(median(took_ns)) if took_ns else None)

    def unheard_ns(self, name: str, speed: float) -> int | None:
        """For how long nobody has said how a process is, while others are told of: its computer is gone. None: not so.

        Args:
            speed: experiment seconds in a real second.
        """
        silent_ns = self.newest_ns - self.processes_told_ns.get(name, self.newest_ns)
        return silent_ns if silent_ns > OLD_S * speed * NS_PER_S else None

    def take(self, message: str, thing: object, time_ns: int, envelope: str = "") -> None:
        """Take in what was published.

        Args:
            message: its name, e.g. "Scan2d".
            thing: as `wire.decode` gives it. What is not known is passed over.
            time_ns: of the packet.
            envelope: of the packet; without it, the name of the message.
        """
        key = envelope or message
        # a scheduler stamps each packet anew: of one envelope, what is not newer came before
        if time_ns <= self._taken_ns.get(key, -1):
            return
        self._taken_ns[key] = time_ns
        self.newest_ns = max(self.newest_ns, time_ns)
        handler: Callable[[object, int], None] | None = getattr(self, f"_{_handler(message)}", None)
        if handler is not None:
            handler(thing, time_ns)

    def _on_state(self, status: ScopeStatus, time_ns: int) -> None:
        before, self.status = self.status, status
        self.states.change(sys.intern(status.state.name.lower()), time_ns)
        if status.state is ScopeState.SCANNING:
            if before is None or before.state is not ScopeState.SCANNING or self.running is None:
                holder = self.control.holder if self.control else None
                setpoint = self.feedback.setpoint if self.feedback else None
                self.running = RunningScan(time_ns if before else None, holder, self.scan_parameters, setpoint)
            return
        if status.state is ScopeState.FREE and self.running is not None and self.running.began_ns is not None:
            self._done.append(DoneScan(self.running.parameters, time_ns - self.running.began_ns))
        if status.state is ScopeState.INTERRUPTED and self.running is not None:
            self._take_interrupted(self.running, time_ns)
        if status.state in (ScopeState.FREE, ScopeState.INTERRUPTED):
            self.running = None

    def _take_interrupted(self, running: RunningScan, time_ns: int) -> None:
        for channel, lines in running.channels.items():
            self._add_scan(
                ScanSummary(
                    time_ns, running.began_ns, channel, lines.unit, lines.region, lines.shape,
                    holder=running.holder, interrupted=True,
                )
            )  # fmt: skip

    def _on_scan_lines(self, lines: ScanLines, time_ns: int) -> None:
        if self.running is not None:
            self.running.take(lines)

    def _on_scan(self, scan: Scan, time_ns: int) -> None:
        began_ns, holder = None, self.control.holder if self.control else None
        if self.running is not None:
            began_ns, holder = self.running.began_ns, self.running.holder
        self._add_scan(
            ScanSummary(
                scan.time_ns or time_ns, began_ns, scan.channel, scan.unit, scan.region, scan.shape, scan.filename,
                holder,
            )
        )  # fmt: skip

    def _add_scan(self, taken: ScanSummary) -> None:
        last = next(reversed(self._scans.values()), None)
        taken = _sharing(taken, last)
        key = (taken.time_ns, taken.channel, taken.region, taken.interrupted)
        if key in self._scans:
            return
        before = 0 if last is None else last.number
        number = before if last is not None and taken.is_of_scan(last) else before + 1
        setpoint = self.running.setpoint if self.running else None
        _keep(self._scans, key, replace(taken, number=number, setpoint=setpoint))

    def _on_spectrum(self, spectrum: Spectrum, time_ns: int) -> None:
        taken_ns, holder = spectrum.time_ns or time_ns, self.control.holder if self.control else None
        taken = SpectrumSummary(
            taken_ns, spectrum.kind, spectrum.position_m, spectrum.frame, spectrum.names, spectrum.units,
            spectrum.filename, holder,
        )  # fmt: skip
        _keep(self._spectra, (taken_ns, spectrum.kind, spectrum.position_m), taken)

    def _on_control(self, control: ControlState, time_ns: int) -> None:
        self.control = control
        self.controls.change(control.holder or NOBODY, time_ns)
        self.modes.change(control.mode.name.lower() if control.mode is not ControlMode.UNDEFINED else None, time_ns)
        for number in {*control.problems, *self.problem_timelines}:
            lane = self.problem_timelines[number]
            if number in control.problems and lane.now is None:
                lane.change(self.problems.name(number), time_ns, by=self._flagger(number, time_ns))
            elif number not in control.problems:
                lane.change(None, time_ns)

    def _flagger(self, number: int, time_ns: int) -> str:
        """Return the component that asked for a problem to be flagged just before."""
        for entry in reversed(self.entries):
            if entry.time_ns < time_ns - SOON_NS:
                break
            if not entry.refused and _flags(entry, number):
                return entry.who
        return ""

    def _on_journal_entries(self, entries: JournalEntries, time_ns: int) -> None:
        for entry in entries.entries:
            # thousands of entries are kept, and most have the same words
            who, what, kind = map(sys.intern, (entry.who, entry.what, entry.kind))
            entry = replace(entry, who=who, what=what, kind=kind)
            self.entries.append(entry)
            if entry.refused:
                self.refusals.append(entry)
                continue
            if entry.kind == "control":
                self._take_change(entry)
            for number, lane in self.problem_timelines.items():
                # the batch comes a moment after the control state that it explains
                is_near = bool(lane.spans) and abs(lane.spans[-1].start_ns - entry.time_ns) <= SOON_NS
                if is_near and _flags(entry, number):
                    lane.name_last(entry.who)

    def _take_change(self, entry: JournalEntry) -> None:
        """Take a change from the journal, which a late joiner has not seen as a state."""
        match entry.event:
            case ControlEvent.CONTROL_GAINED:
                self.controls.change(entry.who, entry.time_ns)
            case ControlEvent.CONTROL_LOST:
                self.controls.change(None, entry.time_ns)
            case ControlEvent.MODE_CHANGED if entry.mode is not None:
                self.modes.change(entry.mode.name.lower(), entry.time_ns)
            case ControlEvent.PROBLEM_FLAGGED | ControlEvent.PROBLEM_CLEARED if entry.problem is not None:
                is_flagged = entry.event is ControlEvent.PROBLEM_FLAGGED
                label = self.problems.name(entry.problem) if is_flagged else None
                self.problem_timelines[entry.problem].change(label, entry.time_ns, by=entry.who)

    def _on_process_states(self, states: ProcessStates, time_ns: int) -> None:
        for state in states.processes:
            self.processes_told_ns[state.name] = time_ns
            before, self.processes[state.name] = self.processes.get(state.name), state
            condition = state.condition
            if condition is ProcessCondition.BUSY:
                condition = ProcessCondition.ALIVE
            lane = self.process_timelines[state.name]
            lane.change(condition.name.lower().replace("_", " "), max(state.since_ns, lane.changed_ns or 0))
            if state.starts > (before.starts if before else 1):
                self.restarts.append(ProcessRestart(state.since_ns, state.name, state.starts, state.last_exit))

    def _on_progress(self, progress: Progress, time_ns: int) -> None:
        self.told_progress[progress.name] = progress

    def _on_log_lines(self, lines: LogLines, time_ns: int) -> None:
        self.log.extend(lines.lines)

    def _on_note(self, note: Note, time_ns: int) -> None:
        self.notes.append(note)

    def _on_drift_mapping(self, message: Any, time_ns: int) -> None:
        if len(message.matrix) != 6 or len(message.center) != 2:
            return
        drift_x, drift_y = drift_at(np.array(message.matrix).reshape(2, 3), message.center)
        rate = tuple(message.rate) if len(message.rate) == 2 else (0.0, 0.0)
        at_ns = message.timestamp.ToNanoseconds()
        point = DriftPoint(
            at_ns, (float(drift_x), float(drift_y)), rate, message.matched, message.lost, message.correcting,
            message.reason, *drift_knowledge(message), message.failures, message.filename,
        )  # fmt: skip
        _keep(self._drift, at_ns, point)

    def _on_drift_rescan(self, message: Any, time_ns: int) -> None:
        if message.kind == RescanKind.OPPOSITE:
            self._opposite_ns.append(message.timestamp.ToNanoseconds())

    def _on_spatial_point_with_score_list(self, message: Any, time_ns: int) -> None:
        found = ((one.spatial.point, one.spatial.units or "m", one) for one in message.spatials[-MOST_TARGETS:])
        self._targets[message.channel] = tuple(
            FoundPlace(
                (convert(point.x, unit, "m"), convert(point.y, unit, "m")),
                one.score if one.HasField("score") else None,
            )
            for point, unit, one in found
            if same_kind(unit, "m")
        )

    def _on_scan_parameters(self, parameters: ScanParameters, time_ns: int) -> None:
        self.scan_parameters = parameters

    def _on_feedback(self, feedback: Feedback, time_ns: int) -> None:
        self.feedback = feedback

    def _on_probe_position(self, position: ProbePosition, time_ns: int) -> None:
        self.probe_position = position


def _sharing(taken: ScanSummary, last: ScanSummary | None) -> ScanSummary:
    # a page keeps up to a hundred thousand: equal parts of channels and scans are kept once
    channel, unit = sys.intern(taken.channel), sys.intern(taken.unit)
    if last is None:
        return replace(taken, channel=channel, unit=unit)
    return replace(
        taken,
        channel=channel,
        unit=unit,
        time_ns=_one(last.time_ns, taken.time_ns),
        region=_one(last.region, taken.region),
        shape=_one(last.shape, taken.shape),
        filename=_one(last.filename, taken.filename),
    )


def _handler(message: str) -> str:
    try:
        return wire.declaration(message).handler
    except WireError:  # a message of a package that is not installed here
        return ""


def _one(before: V, now: V) -> V:
    return before if before == now else now


def _flags(entry: JournalEntry, number: int) -> bool:
    is_flag = entry.event is ControlEvent.PROBLEM_FLAGGED or entry.request == ControlRequest.ADD_EXP_PRBLM
    return is_flag and entry.problem == number


def _keep(kept: dict[K, V], key: K, thing: V) -> None:
    """Add what is not there yet; the oldest goes where there are too many."""
    kept.setdefault(key, thing)
    if len(kept) > MOST_MEASURED:
        del kept[next(iter(kept))]
