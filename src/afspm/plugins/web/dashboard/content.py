"""The content of the page, as HTML that is generated once for all viewers."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from html import escape

from afspm.basics import NS_PER_S, day_and_time, duration_text, time_of_day, typeset_area
from afspm.drawing import TimelineRow, timeline_html, tint_class
from afspm.model import (
    PERSON,
    ControlMode,
    Feedback,
    JournalEntry,
    LogLine,
    Note,
    ProcessCondition,
    ProcessState,
    Region,
    TipStatus,
)
from afspm.night import OVER, Overview, ScanSummary, Span, Timeline, instrument_curves
from afspm.plugins.web.dashboard.charts import Chart, drift_chart
from afspm.plugins.web.dashboard.flags import Flag, flags
from afspm.plugins.web.dashboard.sample_map import MapContent, map_html, picture_url
from afspm.plugins.web.watch import Watch
from afspm.record import AllowedBands

LEAST_AGE_S = 0.4  # age of the content before it is made again, at any rate of messages
SLOWLY_S = 2.0  # the same for slow content
OLD_AFTER_S = 8.0  # a supervisor publishes its processes every 2 s
NO_REPORT = "no report"
_STARTING = "starting"
_DAY_NS, _MINUTE_NS = 86_400 * NS_PER_S, 60 * NS_PER_S
_AS_USUAL = {_STARTING, "alive", "ended"}


@dataclass(frozen=True)
class SlowContent:
    """The parts of the page that take longer to generate.

    Attributes:
        sample_map_near: map of only the area of measurements and the present scan region.
        time_line_unfolded: time line with a row for each process.
        messages: the newest message of each component's own type; empty without any.
    """

    sample_map: str = ""
    sample_map_near: str = ""
    time_line: str = ""
    time_line_unfolded: str = ""
    messages: str = ""
    drift: Chart = field(default_factory=lambda: Chart(""))


@dataclass(frozen=True)
class NotAsPlanned:
    """A value in the place of a plan's, as text; or one left in MANUAL, which the plan would set again."""

    parameter: str
    text: str
    is_asked: bool


@dataclass(frozen=True)
class Content:
    """The content of the page at one time.

    Attributes:
        trouble: the reason why the page may be out of date; empty: the page is current.
        unheard: time without a report in ns, by process, while other processes report.
        set_ns: the time at which each parameter was set last.
        feedback: the last published state of the feedback.
    """

    status: str = ""
    trouble: str = ""
    slow: SlowContent = field(default_factory=SlowContent)
    refusals: str = ""
    notes: str = ""
    channels: tuple[str, ...] = ()
    problems: tuple[Flag, ...] = ()
    alarms: tuple[LogLine, ...] = ()
    processes: tuple[ProcessState, ...] = ()
    unheard: Mapping[str, int] = field(default_factory=dict)
    log: tuple[LogLine, ...] = ()
    is_manual: bool = False
    by_hand: str = ""
    not_as_planned: tuple[NotAsPlanned, ...] = ()
    tip: TipStatus | None = None
    adjustable: tuple[str, ...] = ()
    set_ns: Mapping[str, int] = field(default_factory=dict)
    feedback: Feedback | None = None
    agents: tuple[str, ...] = ()
    ended: bool = False


class Contents:
    """The generator of the page's content, in the page's thread.

    Args:
        limits: the allowed region of scans, in tip coordinates; None if unknown.
        adjustable: parameters that a person may set in AUTOMATED, too.
        pictures: the address of small pictures of scans.
        bands: required value ranges of other instruments.
        agents: names under which agents may act.
    """

    def __init__(
        self,
        watch: Watch,
        limits: Region | None,
        adjustable: tuple[str, ...] = (),
        pictures: str = "",
        bands: AllowedBands | None = None,
        agents: tuple[str, ...] = (),
    ) -> None:
        self._watch = watch
        self._adjustable = adjustable
        self._limits = limits
        self._pictures = pictures
        self._bands = bands or {}
        self._agents = agents
        self._lock = threading.Lock()
        self._content = Content()
        self._made_s = self._drawn_s = -math.inf
        self._revision = 0

    def get(self) -> Content:
        """Return the present content, or cached content at most `LEAST_AGE_S` old (slow content: `SLOWLY_S`)."""
        with self._lock:
            now_s, revision = self._watch.clock.monotonic_s(), self._watch.revision
            if revision != self._revision:
                self._revision, self._made_s, self._drawn_s = revision, -math.inf, -math.inf
            if now_s - self._made_s >= LEAST_AGE_S or self._watch.ended != self._content.ended:
                self._made_s = now_s
                self._content = self._make(now_s)
            return self._content

    def _make(self, now_s: float) -> Content:
        watch, slow = self._watch, self._content.slow
        with watch.reading() as overview:
            silent = unheard(watch, overview)
            if now_s - self._drawn_s >= SLOWLY_S:
                self._drawn_s = now_s
                slow = self._draw(overview, silent)
            control = overview.control
            return Content(
                status=status_html(watch, overview),
                trouble=trouble(watch),
                slow=slow,
                refusals=refusals_html(overview.refusals),
                notes=notes_html(overview),
                channels=watch.frames.channels,
                problems=tuple(flags(overview)),
                alarms=overview.open_alarms,
                processes=tuple(processes_of(watch, overview)),
                unheard=silent,
                log=tuple(overview.log),
                is_manual=control is not None and control.mode is ControlMode.MANUAL,
                by_hand=overview.by_hand,
                not_as_planned=tuple(
                    NotAsPlanned(one.planned.name, one.text, one.is_asked) for one in overview.overruled
                ),
                tip=overview.tip,
                adjustable=self._adjustable,
                set_ns=dict(overview.set_ns),
                feedback=overview.readings.feedback,
                agents=tuple(dict.fromkeys((*(one.who for one in overview.proposals.values()), *self._agents))),
                ended=watch.ended,
            )

    def _draw(self, overview: Overview, silent: Mapping[str, int]) -> SlowContent:
        parameters = overview.readings.scan_parameters
        newest = overview.scans[-1] if overview.scans else None
        content = MapContent(
            overview.scans,
            overview.spectra,
            parameters.region if parameters and isinstance(parameters.region, Region) else None,
            self._limits,
            self._watch.tip_to_sample,
            overview.readings.probe_position.xy_m if overview.readings.probe_position else None,
            newest.time_ns if newest else None,
            overview.targets,
            self._pictures,
        )
        now_ns = _now_ns(self._watch, overview)
        folded, unfolded = (
            timeline_html(
                rows_of(overview, silent, unfolded=unfolded),
                None,
                now_ns,
                pictures=self._strip(overview),
                curves=instrument_curves(overview.instruments, self._bands),
            )
            for unfolded in (False, True)
        )
        return SlowContent(
            map_html(content),
            map_html(content, whole=False),
            folded,
            unfolded,
            messages_html(overview),
            drift_chart(overview.drift),
        )

    def _strip(self, overview: Overview) -> Iterator[tuple[int, str]]:
        # a picture of each scan for the time line
        number = 0
        for one in overview.scans:
            if one.number != number and self._pictures and not one.interrupted:
                number = one.number
                outside = f", outside: {', '.join(one.outside)}" if one.outside else ""
                title = escape(
                    f"no. {number}: {typeset_area(one.region.size_m)} at {time_of_day(one.time_ns)}{outside}"
                )
                mark = ' class="outside"' if one.outside else ""
                yield (
                    one.time_ns,
                    (
                        f'<img{mark} src="{picture_url(self._pictures, one)}" alt="{title}" title="{title}" '
                        f'data-time="{one.time_ns}" data-channel="{escape(one.channel)}">'
                    ),
                )


def _now_ns(watch: Watch, overview: Overview) -> int:
    return overview.newest_ns if watch.ended else watch.clock.now_ns()


def unheard(watch: Watch, overview: Overview) -> dict[str, int]:
    """Return the silence in ns of each process that is silent while other processes report."""
    if watch.ended:
        return {}
    speed = 1.0 / watch.clock.real_s(1.0)
    running = [state.name for state in overview.processes.values() if state.condition not in OVER]
    return {name: ns for name in running if (ns := overview.silent_ns(name, speed)) is not None}


def processes_of(watch: Watch, overview: Overview) -> Iterator[ProcessState]:
    """Yield the processes; after the run, all are shown as ended, regardless of their last report."""
    for state in overview.processes.values():
        if not watch.is_over or state.condition in OVER:
            yield state
        else:
            since_ns = max(state.since_ns, overview.ended_ns or overview.newest_ns)
            yield replace(state, condition=ProcessCondition.ENDED, since_ns=since_ns, step_age_s=0.0)


def trouble(watch: Watch) -> str:
    """Return the reason why the page may be out of date; empty if the page is current."""
    if watch.ended:
        return "The experiment has ended. This page shows its final state."
    if not watch.connected:
        return "Waiting for the first message of the experiment."
    silent_s = watch.silent_s()
    if silent_s > OLD_AFTER_S:
        why = f" {said[0].upper()}{said[1:]}." if (said := watch.cut_off()) else ""
        return f"The experiment has been silent for {duration_text(silent_s)}: this page is that old.{why}"
    return ""


def rows_of(overview: Overview, silent: Mapping[str, int], *, unfolded: bool = True) -> Iterator[TimelineRow]:
    """Yield the rows of the time line: control, notes, mode, scope state, each problem, processes.

    Args:
        unfolded: True: a row for each process; False: one common row for all processes without a failure.
    """
    yield TimelineRow("control", overview.timelines.control.spans, tint_class)
    if overview.notes:
        yield TimelineRow("notes", overview.note_spans, lambda _: "marked")
    yield TimelineRow("mode", overview.timelines.mode.spans, lambda label: f"mode-{label}")
    yield TimelineRow(
        "microscope", overview.timelines.scope_state.spans, lambda label: f"state-{label.replace('_', '-')}"
    )
    for number, lane in sorted(overview.timelines.problems.items()):
        if lane.spans:
            is_routine = all(map(overview.is_routine, lane.spans))
            style = (lambda _: "marked") if is_routine else (lambda _: "problem")
            yield TimelineRow(overview.problems.name(number), lane.spans, style)
    rows = {
        name: tuple(_until_told(lane, overview.process_history.reported_ns[name]) if name in silent else lane.spans)
        for name, lane in overview.process_history.timelines.items()
    }
    fine = [] if unfolded else [name for name, spans in rows.items() if not _has_failed(spans)]
    for name, spans in rows.items():
        if name not in fine:
            yield TimelineRow(name, spans, lambda label: f"process-{label.replace(' ', '-')}")
    if fine:
        start_ns = min(span.start_ns for name in fine for span in rows[name])
        span = Span(f"{len(fine)} without failures", start_ns)
        yield TimelineRow("processes", (span,), lambda _: "process-alive")


def _has_failed(spans: Sequence[Span]) -> bool:
    # a process without failure is started once, then alive, then done
    return any(span.label not in _AS_USUAL for span in spans) or any(span.label == _STARTING for span in spans[1:])


def _until_told(lane: Timeline, told_ns: int) -> Iterator[Span]:
    for span in lane.spans:
        yield replace(span, end_ns=max(told_ns, span.start_ns)) if span.end_ns is None else span
    if lane.now is not None:
        yield Span(NO_REPORT, told_ns)


def status_html(watch: Watch, overview: Overview) -> str:
    """Return mode, holder, the microscope's state, progress, expected end and experiment time, as HTML."""
    control = overview.control
    if control is None:
        return '<span class="chip">waiting for the scheduler</span>'
    since_ns, now_ns = overview.control_since_ns, _now_ns(watch, overview)
    since = "" if since_ns is None else f"for {duration_text((now_ns - since_ns) / NS_PER_S)}"
    mode = control.mode.name
    holder = overview.in_control
    who = f'<b class="{tint_class(holder)}">{escape(holder)}</b>' if holder else "nobody"
    parts = [
        _chip(mode, "mode", f"mode-{mode.lower()}"),
        _chip(f"{who} is in control <small>{since}</small>", "holder"),
        *_microscope(overview, now_ns),
    ]
    end_ns = watch.expected_end_ns(overview, now_ns)
    for entry in overview.waits_at(now_ns):
        until = _end_text(entry.again_ns or now_ns, now_ns)
        parts.append(
            _chip(f"<b>{escape(entry.who)}</b> waits until {until} <small>{escape(entry.reason)}</small>", "wait")
        )
    for name, report in overview.progress_at(now_ns).items():
        left_ns = report.remaining_ns(now_ns) if report.done < report.of else None
        # the component that decides the end needs no end of its own
        has_end = left_ns and (end_ns is None or abs(now_ns + left_ns - end_ns) > _MINUTE_NS)
        end = f" <small>ends {_end_text(now_ns + left_ns, now_ns)}</small>" if left_ns and has_end else ""
        parts.append(_chip(f"<b>{escape(name)}</b> {report.done} of {report.of}{end}", "progress"))
    if end_ns is not None and end_ns > now_ns:
        left = duration_text((end_ns - now_ns) / NS_PER_S)
        parts.append(_chip(f"ends about {_end_text(end_ns, now_ns)} <small>{left} left</small>", "end"))
    zone = datetime.fromtimestamp(now_ns / NS_PER_S).astimezone().tzname()
    parts.append(_chip(f"{time_of_day(now_ns, seconds=False)} {zone}", "clock", "time"))
    return "".join(parts)


def _end_text(end_ns: int, now_ns: int) -> str:
    if end_ns - now_ns < _DAY_NS:
        return time_of_day(end_ns, seconds=False)
    return day_and_time(end_ns, seconds=False)


def _chip(html: str, part: str, style: str = "") -> str:
    return f'<span class="{f"chip {style}".strip()}" data-part="{part}">{html}</span>'


def _microscope(overview: Overview, now_ns: int) -> Iterator[str]:
    status = overview.status
    state = status.state.name.lower().replace("_", " ") if status else NO_REPORT
    paused = " (paused)" if status and status.paused else ""
    done = overview.scan_progress(now_ns)
    far = "" if done is None else f" {100 * done[0]:.0f} % <small>ends {time_of_day(now_ns + done[1])}</small>"
    yield _chip(f"microscope {state}{paused}{far}", "state", f"state-{state.replace(' ', '-')}")
    if overview.readings.feedback is not None and overview.readings.feedback.on is False:
        yield _chip("FEEDBACK OFF", "feedback", "problem")


def refusals_html(refusals: Iterable[JournalEntry], most: int = 40) -> str:
    """Return the last refusals as HTML, newest first."""
    newest = list(refusals)[-most:][::-1]
    if not newest:
        return '<p class="nothing">Nothing has been refused.</p>'
    rows = "".join(
        f'<li><time>{time_of_day(one.time_ns)}</time> <b class="{tint_class(one.who)}">{escape(one.who)}</b> '
        f"{escape(one.what)}<q>{escape(one.reason) or 'no reason given'}</q></li>"
        for one in newest
    )
    return f'<ul class="refusals">{rows}</ul>'


def notes_html(overview: Overview) -> str:
    """Return the notes as HTML, latest moment first."""
    scans = {scan.time_ns: scan for scan in reversed(overview.scans)} if overview.notes else {}
    notes = sorted(overview.notes, key=lambda note: -note.time_ns)
    rows = "".join(_note(note, scans.get(note.scan_ns or 0)) for note in notes)
    return f'<ul class="notes">{rows}</ul>' if rows else '<p class="nothing">No notes yet.</p>'


def messages_html(overview: Overview) -> str:
    """Return the newest message of each component's own type as HTML; empty without any."""
    rows = "".join(
        f'<li><time>{time_of_day(one.time_ns)}</time> <b class="{tint_class(one.who)}">{escape(one.who)}</b> '
        f"{escape(one.name)} <span>{escape(one.text)}</span></li>"
        for one in overview.announcements()
    )
    unread = "".join(f"<li>{escape(one)}</li>" for one in overview.unread)
    return f'<ul class="notes">{rows}{unread}</ul>' if rows or unread else ""


def _note(note: Note, scan: ScanSummary | None) -> str:
    who = note.who.partition(PERSON)[2] or note.who
    on = ""
    if scan is not None:
        data = f'data-time="{scan.time_ns}" data-channel="{escape(scan.channel)}"'
        on = f'<button type="button" {data}>scan {scan.number}</button>'
    return (
        f'<li><time>{time_of_day(note.time_ns)}</time> <b class="{tint_class(note.who)}">{escape(who)}</b> {on} '
        f"<span>{escape(note.text)}</span></li>"
    )
