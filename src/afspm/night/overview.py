"""`Overview`: the state and history of an experiment, reduced from its packets. Terminal, page and report show it."""

from __future__ import annotations

import math
import sys
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from afspm import wire
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import WireError
from afspm.model import (
    ActByHand,
    Approvals,
    ChannelRoles,
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    Feedback,
    InstrumentReadings,
    JournalEntries,
    JournalEntry,
    LogLine,
    MeasurementConditions,
    Note,
    ProbePosition,
    Problem,
    ProblemNames,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    Proposal,
    RescanKind,
    Scan,
    ScanHistory,
    ScanLines,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    TipStatus,
    registration_summary,
)
from afspm.model.events import PERSON, LogLines
from afspm.model.grants import with_proposal
from afspm.model.parameter_names import START_SCAN
from afspm.model.problems import CONDITIONS
from afspm.model.requests import LoanInForce, LoansInForce, Overruling
from afspm.night.expected_end import Plans, expected_end_ns
from afspm.night.measurement_history import (
    SOON_NS,
    DriftPoint,
    FoundPlace,
    MeasurementHistory,
    ScanSummary,
    SpectrumSummary,
)
from afspm.night.reading_curves import ReadingCurve
from afspm.night.running_scan import RunningScan
from afspm.night.timeline import Span, Timeline, Timelines
from afspm.record import AllowedBands

if TYPE_CHECKING:
    from afspm.wire.messages import DriftMapping, DriftRescan, SpatialPointWithScoreList

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
MOST_PROPOSALS = 200
MOST_ALARMS = 200
MOST_ENTRIES = 5_000
OLD_S = 6.0  # real time; a supervisor reports its processes every 2 s
OVER = (ProcessCondition.ENDED, ProcessCondition.GIVEN_UP)
"""Conditions after which a process reports nothing more."""
FREE = None
ROUTINE = "normal at the start: the first scan is taken in both directions, which gives the velocity of the drift"
"""The explanation of a routine problem."""


@dataclass(frozen=True, slots=True)
class ProcessRestart:
    """A restart of a process: its `starts`-th start, after an exit described by `last_exit`."""

    time_ns: int
    name: str
    starts: int
    last_exit: str


@dataclass(frozen=True, slots=True)
class NewestMessage:
    """The newest message of a component's own type: its fields as text, and the number of such messages so far."""

    time_ns: int
    who: str
    name: str
    text: str
    count: int


@dataclass(slots=True)
class Readings:
    """The newest settings and position of the microscope; None before the first packet of each."""

    scan_parameters: ScanParameters | None = None
    feedback: Feedback | None = None
    probe_position: ProbePosition | None = None


class ProcessHistory:
    """The past conditions and restarts of the processes.

    Attributes:
        timelines: the timeline of each process's conditions, by name; a busy process counts as alive.
        reported_ns: the time of the last report on each process, by name.
        restarts: newest last, bounded.
    """

    def __init__(self, most_restarts: int) -> None:
        self.timelines: defaultdict[str, Timeline] = defaultdict(Timeline)
        self.reported_ns: dict[str, int] = {}
        self.restarts: deque[ProcessRestart] = deque(maxlen=most_restarts)

    def add(self, state: ProcessState, starts_before: int, time_ns: int) -> None:
        self.reported_ns[state.name] = time_ns
        condition = ProcessCondition.ALIVE if state.condition is ProcessCondition.BUSY else state.condition
        lane = self.timelines[state.name]
        lane.change(condition.name.lower().replace("_", " "), max(state.since_ns, lane.changed_ns or 0))
        if state.starts > starts_before:
            self.restarts.append(ProcessRestart(state.since_ns, state.name, state.starts, state.last_exit))


@dataclass(slots=True)
class CriticalMessage:
    """A CRITICAL line of the log, and the time of the line that ended it; None while it is not known to be over."""

    line: LogLine
    ended_ns: int | None = None


class Overview:
    """The present state and the history of an experiment, reduced from packets. Pure: no clock, socket or file.

    A packet that is not newer than the last packet of its envelope is ignored, so replayed packets do no harm.

    A new figure belongs to the part that reduces its message (`MeasurementHistory`, `ProcessHistory`, `Timelines`,
    `Readings`); only a new kind of state is an attribute here. A registry of reducers would be longer than its
    handlers.

    Args:
        problems: the names of the experiment's problems.
        bands: the bands of [conditions], by parameter; scans outside are marked.

    Attributes:
        newest_ns: the time of the newest packet; 0 before the first.
        status, control, tip: the newest state of the microscope, of control and of the tip; None before the first.
        processes, progress_reports: the newest state and progress of each process, by name.
        instruments: the curve of each instrument parameter, by its name.
        announced, announced_count: time and newest message of each envelope that the scheduler relays for a component,
            and the number of its messages.
        unread: sentences about messages of the record that can't be read.
        proposals: the proposals of agents by id, newest last, bounded.
        approvals: the approvals in force.
        loans: the settings that are in force for one component's measurements.
        overruled: the values that take the place of stated ones, and what a person has left in MANUAL.
        of_conditions: the numbers of the problems flagged by conditions.
        set_ns: the time of the last accepted request that set each parameter.
        log, alarms, notes, entries, refusals, acts: newest last, bounded; acts are those at the microscope itself.
    """

    def __init__(
        self,
        problems: ProblemNames | None = None,
        *,
        most_entries: int = MOST_ENTRIES,
        bands: AllowedBands | None = None,
    ) -> None:
        self.problems = problems or ProblemNames()
        self._bands = bands or {}
        self._outside: dict[str, tuple[str, ...]] = {}
        self.newest_ns = 0
        self.status: ScopeStatus | None = None
        self.control: ControlState | None = None
        self.readings = Readings()
        self.tip: TipStatus | None = None
        self.channels = ChannelRoles()
        self.processes: dict[str, ProcessState] = {}
        self.instruments: dict[str, ReadingCurve] = {}
        self.progress_reports: dict[str, Progress] = {}
        self.announced: dict[str, tuple[int, Any]] = {}
        self.announced_count: Counter[str] = Counter()
        self.unread: tuple[str, ...] = ()
        self.proposals: dict[str, Proposal] = {}
        self.approvals = Approvals()
        self.loans: tuple[LoanInForce, ...] = ()
        self.overruled: tuple[Overruling, ...] = ()
        self._approved_ns: dict[str, int] = {}
        self.of_conditions: set[int] = set()
        self.set_ns: dict[str, int] = {}
        self._limited: dict[str, JournalEntry] = {}
        self.log: deque[LogLine] = deque(maxlen=MOST_LINES)
        self.alarms: deque[CriticalMessage] = deque(maxlen=MOST_ALARMS)
        self.notes: deque[Note] = deque(maxlen=most_entries)
        self.entries: deque[JournalEntry] = deque(maxlen=most_entries)
        self.refusals: deque[JournalEntry] = deque(maxlen=most_entries)
        self.acts: deque[ActByHand] = deque(maxlen=most_entries)
        self.timelines = Timelines()
        self.process_history = ProcessHistory(most_entries)
        self._measured = MeasurementHistory()
        self._story = ScanHistory()
        self._newest_of: dict[str, int] = {}

    @property
    def scans(self) -> Sequence[ScanSummary]:
        """A summary for each channel of each scan, in the order of arrival."""
        return self._measured.scans

    @property
    def scan_count(self) -> int:
        """The number of scans so far, interrupted scans included: the number of the newest in the record."""
        return self._measured.count

    @property
    def spectra(self) -> Sequence[SpectrumSummary]:
        return self._measured.spectra

    @property
    def drift(self) -> Sequence[DriftPoint]:
        return self._measured.drift

    @property
    def targets(self) -> Sequence[FoundPlace]:
        return self._measured.places

    @property
    def running(self) -> RunningScan | None:
        return self._measured.running

    def conditions(self, time_ns: int) -> MeasurementConditions | None:
        """Return the tip at both ends of the scan or spectrum of this time; None if not published."""
        return self._measured.conditions(time_ns)

    @property
    def waiting(self) -> list[Proposal]:
        """The proposals with a preflight that were not approved since; a plan that was carried out waits no more."""
        return [
            one for one in self.proposals.values() if one.preflight and one.time_ns > self._approved_ns.get(one.id, -1)
        ]

    @property
    def registration(self) -> str:
        """The number of registered scans, as text; empty without drift correction."""
        return registration_summary(point.outcome for point in self.drift) if self.drift else ""

    def is_routine(self, span: Span | None) -> bool:
        """Return whether a problem is flagged in the normal course of a run.

        Routine is a flag of thermal-drift within a second of a request for a scan in the opposite direction: the first
        scan of a run with drift correction is taken in both directions.
        """
        if span is None or span.label != self.problems.name(Problem.THERMAL_DRIFT):
            return False
        return any(abs(span.start_ns - asked_ns) <= SOON_NS for asked_ns in self._measured.opposite_ns)

    @property
    def problem_spans(self) -> list[Span]:
        """The spans of all non-routine problems, in the order of time."""
        spans = (span for lane in self.timelines.problems.values() for span in lane.spans)
        return sorted((span for span in spans if not self.is_routine(span)), key=lambda span: span.start_ns)

    @property
    def routine_spans(self) -> list[Span]:
        """The spans of problems that are routine; see `is_routine`."""
        return [s for lane in self.timelines.problems.values() for s in lane.spans if self.is_routine(s)]

    def progress_at(self, now_ns: int) -> dict[str, Progress]:
        """Return the newest progress of each component, moved by the time in MANUAL since."""
        return {
            name: replace(report, time_ns=report.time_ns + self.manual_ns(report.time_ns, now_ns))
            for name, report in self.progress_reports.items()
        }

    def waits_at(self, now_ns: int) -> list[JournalEntry]:
        """Return for each component that a limit on time lets wait the refusal with the time of its end."""
        return [entry for entry in self._limited.values() if (entry.again_ns or 0) > now_ns]

    def manual_ns(self, since_ns: int, now_ns: int) -> int:
        """Return the time in MANUAL since `since_ns`: no task goes on then."""
        manual = [span for span in self.timelines.mode.spans if span.label == ControlMode.MANUAL.name.lower()]
        spans = (replace(span, start_ns=max(span.start_ns, since_ns)) for span in manual)
        return sum(span.lasted_ns(now_ns) for span in spans)

    def expected_end_ns(self, plans: Plans, began_ns: int | None, now_ns: int) -> int | None:
        """Return the experiment time of the end from plans and progress; time in MANUAL puts it off.

        Arguments and result are those of `expected_end.expected_end_ns`.
        """
        if began_ns is not None:
            began_ns += self.manual_ns(began_ns, now_ns)
        return expected_end_ns(plans, self.progress_at(now_ns), began_ns, now_ns)

    @property
    def in_control(self) -> str:
        """The holder of control; in MANUAL the person who set that mode, or "a person"; empty without a holder."""
        if self.control is None:
            return ""
        if self.control.mode is not ControlMode.MANUAL:
            return self.control.holder or ""
        if self.by_hand:
            return "a person at the microscope"
        entry = self._manual_entry
        who = "" if entry is None else entry.who
        return who.partition(PERSON)[2] or who or "a person"

    @property
    def by_hand(self) -> str:
        """The act at the microscope for which the mode is MANUAL; empty without one."""
        if self.control is None or self.control.mode is not ControlMode.MANUAL:
            return ""
        entry = self._manual_entry
        return "" if entry is None else entry.reason

    @property
    def _manual_entry(self) -> JournalEntry | None:
        # of the change to the present MANUAL; it may come a moment after the mode
        changes = (one for one in reversed(self.entries) if one.event is ControlEvent.MODE_CHANGED)
        newest = next(changes, None)
        return newest if newest is not None and newest.mode is ControlMode.MANUAL else None

    @property
    def ended_ns(self) -> int | None:
        """The end of the experiment; None if the run continues, was stopped, or was cut off."""
        entries = reversed(self.entries)
        return next((one.time_ns for one in entries if one.event is ControlEvent.EXPERIMENT_ENDED), None)

    @property
    def open_alarms(self) -> tuple[LogLine, ...]:
        """The CRITICAL lines that are not known to be over, oldest first."""
        return tuple(alarm.line for alarm in self.alarms if alarm.ended_ns is None)

    @property
    def note_spans(self) -> list[Span]:
        """The notes as spans of zero length, for timelines."""
        spans = [Span(note.text, note.time_ns, note.time_ns, note.who) for note in self.notes]
        return sorted(spans, key=lambda span: span.start_ns)

    @property
    def control_since_ns(self) -> int | None:
        """The time of the last change of control; in MANUAL, of the mode. None if no change is known."""
        is_manual = self.control is not None and self.control.mode is ControlMode.MANUAL
        return self.timelines.mode.changed_ns if is_manual else self.timelines.control.changed_ns

    def scan_progress(self, now_ns: int) -> tuple[float, int] | None:
        """Return (fraction done, ns remaining) of the running scan; None without an estimate."""
        return self._measured.scan_progress(now_ns)

    def silent_ns(self, name: str, speed: float) -> int | None:
        """Return the experiment time in ns from the last report on a process to the newest packet.

        None up to 6 s of real time. Since other packets arrive meanwhile, a longer silence means that the computer of
        the process is unreachable.

        Args:
            speed: experiment seconds in a real second.
        """
        silent_ns = self.newest_ns - self.process_history.reported_ns.get(name, self.newest_ns)
        return silent_ns if silent_ns > OLD_S * speed * NS_PER_S else None

    def take(self, message: str, thing: object, time_ns: int, envelope: str = "") -> None:
        """Process a published packet. Of a message without a handler the newest is kept, if the scheduler relays it.

        Args:
            message: the name of the message, e.g. "Scan2d".
            thing: the decoded message from `wire.decode`.
            time_ns: the time of the packet.
            envelope: the envelope of the packet; by default the name of the message.
        """
        key = envelope or message
        # a scheduler gives each packet a new time: within one envelope, a packet that is not newer is a repetition
        if time_ns <= self._newest_of.get(key, -1):
            return
        self._newest_of[key] = time_ns
        self.newest_ns = max(self.newest_ns, time_ns)
        self._story = self._story.step(thing, time_ns)
        handler: Callable[[object, int], None] | None = getattr(self, f"_{_handler(message)}", None)
        if handler is not None:
            handler(thing, time_ns)
        elif wire.is_relayed(message) or message not in wire.known_messages():  # as a record describes its type
            self.announced[key] = time_ns, thing
            self.announced_count[key] += 1

    def announcements(self) -> Iterator[NewestMessage]:
        """Yield the newest message of each envelope that the scheduler relays for a component."""
        for envelope, (time_ns, message) in self.announced.items():
            name = message.DESCRIPTOR.name
            who = envelope.removeprefix(name).removeprefix("_")
            yield NewestMessage(time_ns, who, name, wire.as_text(message), self.announced_count[envelope])

    @property
    def _holder(self) -> str | None:
        return self.control.holder if self.control else None

    def _on_state(self, status: ScopeStatus, time_ns: int) -> None:
        self.status = status
        self.timelines.scope_state.change(sys.intern(status.state.name.lower()), time_ns)
        if status.state is ScopeState.SCANNING:
            self._measured.begin_scan(self._story.running, self.readings.scan_parameters, time_ns)
        elif status.state in (ScopeState.FREE, ScopeState.INTERRUPTED):
            self._measured.end_scan(time_ns, interrupted=status.state is ScopeState.INTERRUPTED)

    def _on_tip_status(self, status: TipStatus, time_ns: int) -> None:
        self.tip = status

    def _on_measurement_conditions(self, conditions: MeasurementConditions, time_ns: int) -> None:
        self._measured.add_conditions(conditions)

    def _on_act_by_hand(self, act: ActByHand, time_ns: int) -> None:
        self.acts.append(act)

    def _on_channel_roles(self, roles: ChannelRoles, time_ns: int) -> None:
        self.channels = roles

    def _on_scan_lines(self, lines: ScanLines, time_ns: int) -> None:
        story = self._story.running
        if story is not None and story.is_presumed:  # the state stays SCANNING, and the next scan shows its lines
            self._measured.begin_scan(story, self.readings.scan_parameters, time_ns)
        if self.running is not None:
            self.running.take(lines)

    def _on_scan(self, scan: Scan, time_ns: int) -> None:
        # readings are published when they change: the last ones are true until the next
        outside = (name for names in self._outside.values() for name in names)
        self._measured.add_scan(scan, time_ns, self._story.of(scan, time_ns), self._holder, outside)

    def _on_spectrum(self, spectrum: Spectrum, time_ns: int) -> None:
        begun, shown = self._story.of(spectrum, time_ns), self.channels.shown(spectrum)
        self._measured.add_spectrum(shown, time_ns, begun.holder if begun.number or begun.asked_by else self._holder)

    def _on_instrument_readings(self, report: InstrumentReadings, time_ns: int) -> None:
        for one in report.readings:
            curve = self.instruments.setdefault(one.name, ReadingCurve())
            curve.unit = one.unit or curve.unit
            value = one.value if one.is_number else None
            curve.add(time_ns, math.nan if value is None else value)
            self._outside[one.name] = tuple(
                band.condition
                for band in self._bands.get(one.name, ())
                if START_SCAN in band.actions and not band.contains(value, one.target, one.unit)
            )
            if self.running is not None:
                self.running.outside.update(self._outside[one.name])

    def _on_proposal(self, proposal: Proposal, time_ns: int) -> None:
        self.proposals = with_proposal(self.proposals, proposal, MOST_PROPOSALS)

    def _on_approvals(self, approvals: Approvals, time_ns: int) -> None:
        self.approvals = approvals
        self._approved_ns |= {one.plan: time_ns for one in approvals.approvals if one.plan}

    def _on_loans(self, loans: LoansInForce, time_ns: int) -> None:
        self.loans, self.overruled = loans.loans, loans.overruled

    def _on_control(self, control: ControlState, time_ns: int) -> None:
        self.control = control
        self.timelines.control.change(control.holder or FREE, time_ns)
        self.timelines.mode.change(
            control.mode.name.lower() if control.mode is not ControlMode.UNDEFINED else None, time_ns
        )
        for number in {*control.problems, *self.timelines.problems}:
            lane = self.timelines.problems[number]
            if number in control.problems and lane.now is None:
                lane.change(self.problems.name(number), time_ns, by=self._flagger(number, time_ns))
            elif number not in control.problems:
                lane.change(None, time_ns)

    def _flagger(self, number: int, time_ns: int) -> str:
        for entry in reversed(self.entries):
            if entry.time_ns < time_ns - SOON_NS:
                break
            if not entry.refused and _flags(entry, number):
                return entry.who
        return ""

    def _on_journal_entries(self, entries: JournalEntries, time_ns: int) -> None:
        for entry in entries.entries:
            # thousands of entries are kept, and most have equal texts
            who, what, kind = map(sys.intern, (entry.who, entry.what, entry.kind))
            entry = replace(entry, who=who, what=what, kind=kind)
            self.entries.append(entry)
            if entry.again_ns is not None:
                self._limited[who] = entry
            elif entry.subject and entry.response == ControlResponse.SUCCESS:
                self._limited.pop(who, None)
            if entry.refused:
                self.refusals.append(entry)
                continue
            if entry.request == ControlRequest.PARAM and entry.value:
                self.set_ns[entry.subject] = entry.time_ns
            if entry.kind == "control":
                self._take_change(entry)
            for number, lane in self.timelines.problems.items():
                # the batch comes a moment after the control state that it explains
                is_near = bool(lane.spans) and abs(lane.spans[-1].start_ns - entry.time_ns) <= SOON_NS
                if is_near and _flags(entry, number):
                    lane.name_last(entry.who)

    def _take_change(self, entry: JournalEntry) -> None:
        # a late joiner has received the journal, but not the control states of that time
        lanes = self.timelines
        match entry.event:
            case ControlEvent.CONTROL_GAINED:
                lanes.control.change(entry.who, entry.time_ns)
            case ControlEvent.CONTROL_LOST:
                lanes.control.change(FREE, entry.time_ns)
            case ControlEvent.MODE_CHANGED if entry.mode is not None:
                lanes.mode.change(entry.mode.name.lower(), entry.time_ns)
            case ControlEvent.PROBLEM_FLAGGED | ControlEvent.PROBLEM_CLEARED if entry.problem is not None:
                is_flagged = entry.event is ControlEvent.PROBLEM_FLAGGED
                if is_flagged and entry.who == CONDITIONS:
                    self.of_conditions.add(entry.problem)
                label = self.problems.name(entry.problem) if is_flagged else None
                lanes.problems[entry.problem].change(label, entry.time_ns, by=entry.who)

    def _on_process_states(self, states: ProcessStates, time_ns: int) -> None:
        for state in states.processes:
            before = self.processes.get(state.name)
            self.processes[state.name] = state
            self.process_history.add(state, before.starts if before else 1, time_ns)

    def _on_progress(self, progress: Progress, time_ns: int) -> None:
        self.progress_reports[progress.name] = progress

    def _on_log_lines(self, lines: LogLines, time_ns: int) -> None:
        self.log.extend(lines.lines)
        for line in lines.lines:
            if line.is_alarm:
                if not any((one.name, one.text) == (line.name, line.text) for one in self.open_alarms):
                    self.alarms.append(CriticalMessage(line))
                continue
            for alarm in self.alarms:
                if alarm.ended_ns is None and line.ends(alarm.line):
                    alarm.ended_ns = line.time_ns

    def _on_note(self, note: Note, time_ns: int) -> None:
        self.notes.append(note)

    def _on_drift_mapping(self, message: DriftMapping, time_ns: int) -> None:
        self._measured.add_drift(message)

    def _on_drift_rescan(self, message: DriftRescan, time_ns: int) -> None:
        if int(message.kind) == RescanKind.OPPOSITE:
            self._measured.opposite_ns.append(message.timestamp.ToNanoseconds())

    def _on_spatial_point_with_score_list(self, message: SpatialPointWithScoreList, time_ns: int) -> None:
        self._measured.set_places(message)

    def _on_scan_parameters(self, parameters: ScanParameters, time_ns: int) -> None:
        self.readings.scan_parameters = parameters

    def _on_feedback(self, feedback: Feedback, time_ns: int) -> None:
        self.readings.feedback = feedback

    def _on_probe_position(self, position: ProbePosition, time_ns: int) -> None:
        self.readings.probe_position = position


def _handler(message: str) -> str:
    try:
        return wire.declaration(message).handler
    except WireError:  # a message of a package that is not installed here
        return ""


def _flags(entry: JournalEntry, number: int) -> bool:
    is_flag = entry.event is ControlEvent.PROBLEM_FLAGGED or entry.request == ControlRequest.ADD_EXP_PRBLM
    return is_flag and entry.problem == number
