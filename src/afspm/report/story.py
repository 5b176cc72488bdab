"""The contents of a run's report, independent of its layout."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import counted
from afspm.drawing import TimelineRow
from afspm.model import (
    ControlEvent,
    ControlRequest,
    Frame,
    JournalEntry,
    ProcessCondition,
    RegistrationOutcome,
    ScopeState,
    names,
)
from afspm.model.planned_work import PlannedWork, path_length_m
from afspm.night import Overview, Span, Timeline, plans_of
from afspm.night.overview import ProcessRestart
from afspm.night.run import Run
from afspm.night.tables import NoteRow, ScanRow, SpectrumRow
from afspm.night.treatment_ledger import TreatmentLedger, treatments_once
from afspm.record import AllowedBands, describe_state
from afspm.record import bands_allowed as allowed_bands
from afspm.record.run_json import REAL_S, UNFINISHED
from afspm.report import agents, parameters, proofs, shadow
from afspm.report.proofs import ResultProofs
from afspm.wire.messages import WatchCounts

COLOURS = 5  # of holders, repeated in turn: the CSS classes c0 to c4
MOST_ROWS = 200
_PROCESS_TROUBLE = frozenset({ProcessCondition.SILENT, ProcessCondition.RESTARTING, ProcessCondition.GIVEN_UP})


@dataclass(frozen=True, slots=True)
class Refusals:
    """Equal requests refused for one reason: their number, the first and the last time."""

    who: str
    what: str
    reason: str
    count: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True)
class WorkComparison:
    """The planned and the measured work of a component.

    The measured duration extends from the start of the first to the end of the last scan or spectrum, with pauses.
    """

    name: str
    planned: PlannedWork
    measured: PlannedWork


@dataclass(frozen=True)
class RunStory:
    """The summary of a run. Times in ns of experiment time since the Unix epoch.

    Attributes:
        start_ns: the first known time of the run.
        real_s: the duration in real time; None if unknown, or if the clock ran at real speed.
        ended: the state of the run as text: its end, running, or cut off.
        frame: the coordinate frame of all positions.
        problems: spans of all non-routine problems, in the order of time.
        actions: successful treatments of the tip, e.g. pulses.
        seen_late: the first request to flag each problem that was only noticed after the end.
        ledger: totals of the treatments of tip and sample.
        comparisons: planned and measured work of each component with a plan.
        agents: the work of each agent.
        changes: the changed parameters, except the place of scans and spectra.
        bands: the values of other instruments that the conditions allowed.
        shadow: decisions of a run in shadow mode beside the person's acts.
        unfinished: how each unfinished component was stopped, as text by name.
        beside_instruments: the scans and spectra with values of other instruments.
        watched: the counts of each watch on running scans, by the name of the component.
        proofs: the conditions of each result.
        measured: the scans and spectra, in this order.
    """

    name: str
    folder: str
    metadata: Mapping[str, str]
    simulated: bool
    start_ns: int
    real_s: float | None
    ended: str
    frame: Frame
    overview: Overview
    scans: Sequence[ScanRow]
    spectra: int
    refusals: Sequence[Refusals]
    actions: Sequence[JournalEntry]
    notes: Sequence[NoteRow]
    seen_late: Sequence[JournalEntry]
    ledger: TreatmentLedger
    comparisons: Sequence[WorkComparison] = ()
    agents: Sequence[agents.AgentWork] = ()
    changes: Sequence[parameters.ChangedParameter] = ()
    bands: AllowedBands = field(default_factory=dict)
    shadow: shadow.ShadowNight = field(default_factory=shadow.ShadowNight)
    unfinished: Mapping[str, str] = field(default_factory=dict)
    beside_instruments: Sequence[ScanRow | SpectrumRow] = ()
    watched: Mapping[str, WatchCounts] = field(default_factory=dict)
    proofs: ResultProofs = field(default_factory=ResultProofs)
    measured: Sequence[ScanRow | SpectrumRow] = ()

    @property
    def end_ns(self) -> int:
        """The end of the experiment, or the last known time; figures drawn at the end don't count."""
        return max(self.overview.ended_ns or self.overview.newest_ns, self.start_ns)

    @property
    def lasted_ns(self) -> int:
        return max(0, self.end_ns - self.start_ns)

    @property
    def end(self) -> JournalEntry | None:
        """The journal entry of the end, with its author and reason; None if the run was not ended by request."""
        entries = reversed(self.overview.entries)
        return next((one for one in entries if one.event is ControlEvent.EXPERIMENT_ENDED), None)

    @property
    def restarts(self) -> list[ProcessRestart]:
        return list(self.overview.process_history.restarts)

    @property
    def given_up(self) -> list[str]:
        states = self.overview.processes.items()
        return [name for name, state in states if state.condition is ProcessCondition.GIVEN_UP]

    def problem_name(self, entry: JournalEntry) -> str:
        return self.overview.problems.name(entry.problem or 0)

    @property
    def interrupted(self) -> int:
        return sum(scan.interrupted for scan in self.scans)

    @property
    def problems(self) -> list[Span]:
        return self.overview.problem_spans

    @property
    def unregistered(self) -> list[ScanRow]:
        """The scans with uncertain position: dead reckoning, or a coarse estimate."""
        well = (None, RegistrationOutcome.REGISTERED)
        return [scan for scan in self.scans if scan.registration not in well]

    def why_unregistered(self, scan: ScanRow) -> str:
        """Return the reason why the position of a scan is uncertain; empty if unknown."""
        began_ns = scan.time_ns if scan.began_ns is None else scan.began_ns
        points = (point for point in self.overview.drift if began_ns <= point.time_ns <= scan.time_ns)
        return next((point.reason for point in points), "")

    def shares(self, lane: Timeline) -> list[tuple[str, int]]:
        """Return (label, total time in ns) of a timeline, the longest first."""
        return sorted(lane.lasted_ns(self.end_ns).items(), key=lambda share: -share[1])

    def done_meanwhile(self, problem: Span) -> list[str]:
        """Return the actions while a problem was flagged, with their numbers: "4 × pulse", "1 × retract"."""
        end_ns = self.end_ns if problem.end_ns is None else problem.end_ns
        done = [entry.what for entry in self.actions if problem.start_ns <= entry.time_ns <= end_ns]
        return [f"{count} × {what.removeprefix('x-')}" for what, count in Counter(done).items()]

    def repairs(self, problem: Span) -> list[str]:
        """Return the holders while a problem was flagged, in the order of their first control."""
        end_ns = self.end_ns if problem.end_ns is None else problem.end_ns
        during = [
            span.label
            for span in self.overview.timelines.control.spans
            if span.start_ns < end_ns and (span.end_ns is None or span.end_ns > problem.start_ns)
        ]
        return list(dict.fromkeys(during))


def read(run: Run) -> RunStory:
    """Return a run as the numbers and events of its report."""
    overview, scans, spectra, late = run.overview(), run.scans, run.spectra, _late_flags(run.journal)
    clock = run.facts.get("clock") or {}
    # a resumed run has recorded only the clock of its last part
    starts_ns = [*_first_ns(overview, scans), *([round(float(clock["start_s"]) * 1e9)] if clock else [])]
    start_ns = min(starts_ns, default=0)
    return RunStory(
        name=run.name,
        folder=run.folder.name,
        metadata=run.metadata,
        simulated=run.simulated,
        start_ns=start_ns,
        real_s=None if float(clock.get("speed", 1.0)) == 1.0 else run.facts.get(REAL_S),
        ended=describe_state(run.folder),
        frame=run.frame,
        overview=overview,
        scans=[_without_routine(scan, overview) for scan in scans],
        spectra=len(spectra),
        # late flags are listed with the problems instead
        refusals=gathered([entry for entry in run.refusals if entry not in late]),
        ledger=run.ledger(),
        actions=[
            entry
            for entry in treatments_once(run.journal)
            if entry.what in names.EXTENSION_ACTIONS and entry.response == 0
        ],
        notes=list(run.notes),
        seen_late=list({entry.problem: entry for entry in reversed(late)}.values()),
        comparisons=_compared(plans_of(run.facts), scans, spectra),
        agents=agents.read(run),
        changes=parameters.read(run),
        bands=allowed_bands(run.folder),
        shadow=shadow.read(run),
        unfinished=run.facts.get(UNFINISHED) or {},
        beside_instruments=[row for row in (*scans, *spectra) if row.instruments],
        watched=run.watch_counts(),
        proofs=proofs.read(run),
        measured=[*scans, *spectra],
    )


def _without_routine(scan: ScanRow, overview: Overview) -> ScanRow:
    began_ns = scan.time_ns if scan.began_ns is None else scan.began_ns
    routine = {s.label for s in overview.routine_spans if s.start_ns <= began_ns <= (s.end_ns or began_ns)}
    return replace(scan, problems=tuple(name for name in scan.problems if name not in routine))


def _late_flags(journal: Iterable[JournalEntry]) -> list[JournalEntry]:
    after_the_end = itertools.dropwhile(lambda entry: entry.event is not ControlEvent.EXPERIMENT_ENDED, journal)
    return [entry for entry in after_the_end if entry.request == ControlRequest.ADD_EXP_PRBLM and entry.refused]


def gathered(refusals: Sequence[JournalEntry]) -> list[Refusals]:
    """Group equal refusals, in the order of their first occurrence."""
    groups: dict[tuple[str, str, str], list[int]] = {}
    for entry in refusals:
        groups.setdefault((entry.who, entry.what, entry.reason), []).append(entry.time_ns)
    return [Refusals(*key, len(times), min(times), max(times)) for key, times in groups.items()]


def sentence(story: RunStory) -> str:
    """Summarise the run in one sentence."""
    parts = [counted(len(story.scans) - story.interrupted, "scan")]
    if story.interrupted:
        parts.append(f"{story.interrupted} interrupted")
    if story.spectra:
        parts.append(counted(story.spectra, "spectrum", "spectra"))
    if story.overview.registration:
        parts.append(story.overview.registration)
    flagged = Counter(span.label for span in story.problems)
    parts += [f"{name} flagged {_times(count)}" for name, count in flagged.items()]
    parts += [f"{story.problem_name(entry)} seen after the end" for entry in story.seen_late]
    if story.overview.alarms:
        parts.append(counted(len(story.overview.alarms), "critical message"))
    if story.restarts:
        parts.append(counted(len(story.restarts), "restart"))
    parts += [f"{name} given up" for name in story.given_up]
    parts += [f"{name} not finished" for name in story.unfinished]
    return ", ".join(parts)


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def _first_ns(overview: Overview, scans: Sequence[ScanRow]) -> list[int]:
    lanes = (overview.timelines.control, overview.timelines.mode, overview.timelines.scope_state)
    times = [lane.spans[0].start_ns for lane in lanes if lane.spans]
    return times + [scan.began_ns or scan.time_ns for scan in scans[:1]]


def states_in_words(label: str) -> str:
    """Return a scope state's label in everyday words."""
    known = {ScopeState.SPEC.name.lower(): "spectrum", ScopeState.BUSY_PARAM.name.lower(): "setting parameters"}
    return known.get(label, label.replace("_", " "))


def in_trouble(lane: Timeline) -> list[Span]:
    """Return the spans in which a process was silent, restarting or given up."""
    labels = {condition.name.lower().replace("_", " ") for condition in _PROCESS_TROUBLE}
    return [span for span in lane.spans if span.label in labels]


def colours(story: RunStory) -> dict[str, str]:
    """Return the CSS class of each holder."""
    holders = dict.fromkeys(span.label for span in story.overview.timelines.control.spans)
    return {holder: f"c{number % COLOURS}" for number, holder in enumerate(holders)}


def timeline_rows(story: RunStory) -> Iterator[TimelineRow]:
    """Yield the rows: holders, MANUAL, problems, states of the microscope, processes in trouble, restarts, notes.

    Rows without spans, and the states free and undefined, are left out.
    """
    seen = story.overview
    for holder, style in colours(story).items():
        yield _row(holder, style, (span for span in seen.timelines.control.spans if span.label == holder))
    manual = [span for span in seen.timelines.mode.spans if span.label == "manual"]
    if manual:
        yield _row("MANUAL", "manual", manual)
    for name, spans in itertools.groupby(sorted(story.problems, key=lambda s: s.label), lambda span: span.label):
        yield _row(name, "problem", spans)
    if seen.routine_spans:
        yield _row("first scan both ways", "marked", seen.routine_spans)
    for label in dict.fromkeys(span.label for span in seen.timelines.scope_state.spans):
        if label not in ("free", "undefined"):
            style = "problem" if label == "interrupted" else "state"
            yield _row(
                states_in_words(label),
                style,
                (span for span in seen.timelines.scope_state.spans if span.label == label),
            )
    for name, lane in seen.process_history.timelines.items():
        if trouble := in_trouble(lane):
            yield _row(f"{name} not well", "problem", trouble)
    again = [Span(f"{one.name} started again: {one.last_exit}", one.time_ns, one.time_ns) for one in story.restarts]
    if again:
        yield _row("restarts", "problem", again)
    if seen.notes:
        yield _row("notes", "marked", seen.note_spans)


def _row(name: str, style: str, spans: Iterable[Span]) -> TimelineRow:
    return TimelineRow(name, spans, lambda _: style)


def _compared(
    planned: Mapping[str, PlannedWork | None], scans: Sequence[ScanRow], spectra: Sequence[SpectrumRow]
) -> list[WorkComparison]:
    # a scan or spectrum counts for the component in control at its start; interrupted scans do not count
    return [
        WorkComparison(
            name,
            plan,
            _measured_work(
                [scan for scan in scans if scan.holder == name and not scan.interrupted],
                [spectrum for spectrum in spectra if spectrum.holder == name],
            ),
        )
        for name, plan in planned.items()
        if plan is not None
    ]


def _measured_work(scans: list[ScanRow], spectra: list[SpectrumRow]) -> PlannedWork:
    rows: list[ScanRow | SpectrumRow] = [*scans, *spectra]
    began_ns = min((row.time_ns if row.began_ns is None else row.began_ns for row in rows), default=0)
    lasted_ns = max((row.time_ns for row in rows), default=0) - began_ns
    seen = [(scan.region, scan.shape) for scan in scans if scan.region is not None and scan.shape is not None]
    return PlannedWork(
        scans=len(scans),
        spectra=len(spectra),
        path_m=sum(path_length_m(region, shape[0]) for region, shape in seen),
        pixels=sum(shape[0] * shape[1] for _, shape in seen),
        duration_s=lasted_ns / NS_PER_S,
    )
