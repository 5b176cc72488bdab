"""What the page shows, as HTML made once for all who look at it."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from afspm.clock import NS_PER_S
from afspm.dashboard.curves import drift_html
from afspm.dashboard.sample_map import MapContent, map_html
from afspm.dashboard.time_line import NOT_HEARD_OF, time_line_html
from afspm.dashboard.watch import OLD_AFTER_S, Watch
from afspm.dashboard.words import colour_class, date_and_clock, escape, position
from afspm.formatting import duration_text, time_of_day
from afspm.model import ControlMode, JournalEntry, LogLine, ProcessState, Region
from afspm.record.overview import OVER, Overview

ANEW_S = 0.4  # at most that often, however much is published
SLOWLY_S = 2.0  # what takes longer to make
MOST_LINES = 300
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")


@dataclass(frozen=True)
class Content:
    """The page at one moment.

    Attributes:
        trouble: why it should not be trusted; empty: it may be.
        problems: the flagged ones, (number, name, who flagged it).
        unheard: for how long, in ns, nobody has told of a process while others are told of.
    """

    status: str = ""
    trouble: str = ""
    sample_map: str = ""
    sample_map_near: str = ""
    time_line: str = ""
    drift: str = ""
    refusals: str = ""
    channels: tuple[str, ...] = ()
    problems: tuple[tuple[int, str, str], ...] = ()
    processes: tuple[ProcessState, ...] = ()
    unheard: Mapping[str, int] = field(default_factory=dict)
    log: tuple[LogLine, ...] = ()
    spectra: int = 0
    is_manual: bool = False
    ended: bool = False


@dataclass(frozen=True)
class _Slow:
    """What takes longer to make."""

    sample_map: str = ""
    sample_map_near: str = ""
    time_line: str = ""
    drift: str = ""


class Contents:
    """Makes the content; from the page's thread.

    Args:
        limits: where scans may lie at all, in tip coordinates; None if it is not known.
    """

    def __init__(self, watch: Watch, limits: Region | None) -> None:
        self._watch = watch
        self._limits = limits
        self._lock = threading.Lock()
        self._content = Content()
        self._made_s = self._drawn_s = -1e9
        self._slow = _Slow()

    def get(self) -> Content:
        """How it is now, or was a moment ago."""
        with self._lock:
            now_s = self._watch.clock.monotonic_s()
            if now_s - self._made_s >= ANEW_S or self._watch.ended != self._content.ended:
                self._made_s = now_s
                self._content = self._make(now_s)
            return self._content

    def _make(self, now_s: float) -> Content:
        watch = self._watch
        with watch.reading() as overview:
            if now_s - self._drawn_s >= SLOWLY_S:
                self._drawn_s = now_s
                self._slow = self._draw(overview)
            control = overview.control
            return Content(
                status=status_html(watch, overview),
                trouble=trouble(watch),
                sample_map=self._slow.sample_map,
                sample_map_near=self._slow.sample_map_near,
                time_line=self._slow.time_line,
                drift=self._slow.drift,
                refusals=refusals_html(overview.refusals),
                channels=watch.frames.channels,
                problems=_problems(overview),
                processes=tuple(overview.processes.values()),
                unheard=unheard(watch, overview),
                log=tuple(overview.log),
                spectra=len(overview.spectra),
                is_manual=control is not None and control.mode is ControlMode.MANUAL,
                ended=watch.ended,
            )

    def _draw(self, overview: Overview) -> _Slow:
        parameters, watch = overview.scan_parameters, self._watch
        current = parameters.region if parameters and isinstance(parameters.region, Region) else None
        newest = overview.scans[-1] if overview.scans else None
        content = MapContent(
            overview.scans,
            overview.spectra,
            current,
            self._limits,
            watch.tip_to_sample,
            overview.probe_position.xy_m if overview.probe_position else None,
            (newest.time_ns, newest.channel) if newest else None,
        )
        return _Slow(
            map_html(content),
            map_html(content, whole=False),
            time_line_html(overview, self._now_ns(), unheard(watch, overview)),
            drift_html(overview.drift),
        )

    def _now_ns(self) -> int:
        return self._watch.overview.newest_ns if self._watch.ended else self._watch.clock.now_ns()


def unheard(watch: Watch, overview: Overview) -> dict[str, int]:
    """For how long nobody has told of a process, in ns, where others are told of: its computer is gone."""
    if watch.ended:
        return {}
    speed = 1.0 / watch.clock.real_s(1.0)
    running = [state.name for state in overview.processes.values() if state.condition not in OVER]
    return {name: ns for name in running if (ns := overview.unheard_ns(name, speed)) is not None}


def trouble(watch: Watch) -> str:
    """Why what is shown may not be how it is; empty if it is."""
    if watch.ended:
        return "The experiment has ended. What is shown is how it ended."
    if not watch.connected:
        return "Nothing has been heard of the experiment yet."
    silent_s = watch.silent_s()
    if silent_s > OLD_AFTER_S:
        why = f" {said[0].upper()}{said[1:]}." if (said := watch.cut_off()) else ""
        return f"No word from the experiment for {duration_text(silent_s)}: what is shown is that old.{why}"
    return ""


def status_html(watch: Watch, overview: Overview) -> str:
    """Mode, who is in control, what the microscope does, problems, and what time it is in the experiment."""
    control = overview.control
    if control is None:
        return '<span class="chip">waiting for the scheduler</span>'
    since_ns = overview.control_since_ns
    now_ns = overview.newest_ns if watch.ended else watch.clock.now_ns()
    since = (
        "" if since_ns is None else f" since {time_of_day(since_ns)} ({duration_text((now_ns - since_ns) / NS_PER_S)})"
    )
    mode = control.mode.name
    parts = [f'<span class="chip mode-{mode.lower()}" data-part="mode">{mode}</span>']
    if control.holder:
        who = f'<b class="{colour_class(control.holder)}">{escape(control.holder)}</b>'
        parts.append(f'<span class="chip" data-part="holder">{who} is in control<small>{since}</small></span>')
    else:
        parts.append(f'<span class="chip" data-part="holder">nobody is in control<small>{since}</small></span>')
    parts += _microscope(overview, now_ns)
    for _, name, who in _problems(overview):
        by = f" (flagged by {escape(who)})" if who else ""
        parts.append(f'<span class="chip problem" data-part="problem">{escape(name)}{by}</span>')
    for name, (done, of) in overview.progress.items():
        parts.append(f'<span class="chip"><b>{escape(name)}</b> {done} of {of}</span>')
    parts.append(f'<span class="chip time" data-part="clock">{date_and_clock(now_ns)}</span>')
    return "".join(parts)


def _microscope(overview: Overview, now_ns: int) -> list[str]:
    """Its state, how far the scan is, where the probe stands, and its feedback."""
    status = overview.status
    state = status.state.name.lower().replace("_", " ") if status else "not heard of"
    paused = " (paused)" if status and status.paused else ""
    done = overview.scan_progress(now_ns)
    far = "" if done is None else f" {100 * done[0]:.0f} %, {duration_text(done[1] / NS_PER_S)} left"
    found = [
        f'<span class="chip state-{state.replace(" ", "-")}" data-part="state">microscope {state}{paused}{far}</span>'
    ]
    if overview.probe_position is not None:
        found.append(f'<span class="chip quiet">probe {position(overview.probe_position.xy_m)}</span>')
    feedback = overview.feedback
    if feedback is not None and feedback.on is not None:
        word = "feedback on" if feedback.on else "FEEDBACK OFF"
        at = "" if feedback.setpoint is None else f", setpoint {feedback.setpoint:.4g}"
        found.append(f'<span class="chip quiet">{word}{at}</span>')
    return found


def _problems(overview: Overview) -> tuple[tuple[int, str, str], ...]:
    flagged = overview.control.problems if overview.control else ()
    found = []
    for number in flagged:
        now = overview.problem_timelines[number].now if number in overview.problem_timelines else None
        found.append((number, overview.problems.name(number), now.by if now else ""))
    return tuple(found)


def refusals_html(refusals: Iterable[JournalEntry], most: int = 40) -> str:
    """The last refusals, newest first."""
    newest = list(refusals)[-most:][::-1]
    if not newest:
        return '<p class="nothing">Nothing has been refused.</p>'
    rows = "".join(
        f'<li><time>{time_of_day(one.time_ns)}</time> <b class="{colour_class(one.who)}">{escape(one.who)}</b> '
        f"{escape(one.what)}<q>{escape(one.reason) or 'no reason was given'}</q></li>"
        for one in newest
    )
    return f'<ul class="refusals">{rows}</ul>'


def log_html(lines: Iterable[LogLine], names: frozenset[str], level: str, text: str = "") -> str:
    """Log lines, newest first.

    Args:
        names: of components; empty: all.
        level: the least that is shown.
        text: that a line has to contain, in lower or upper case.
    """
    least = LEVELS.index(level) if level in LEVELS else 0
    wanted = [
        line
        for line in lines
        if (not names or line.name in names)
        and (LEVELS.index(line.level) if line.level in LEVELS else 1) >= least
        and text.lower() in line.text.lower()
    ]
    if not wanted:
        return '<p class="nothing">No such line.</p>'
    rows = "".join(
        f'<li class="level-{escape(line.level.lower())}"><time>{time_of_day(line.time_ns)}</time>'
        f'<b class="{colour_class(line.name)}">{escape(line.name)}</b><i>{escape(line.level)}</i>'
        f"<span>{escape(line.text)}</span></li>"
        for line in wanted[: -MOST_LINES - 1 : -1]
    )
    return f'<ul class="log">{rows}</ul>'


def process_words(state: ProcessState, unheard_ns: int | None = None) -> tuple[str, str, str]:
    """(condition, since when or busy for how long, restarts) of a process, in words.

    Args:
        unheard_ns: for how long nobody has told of it, if others are told of.
    """
    condition = state.condition.name.lower().replace("_", " ")
    since = f"since {time_of_day(state.since_ns)}"
    if unheard_ns is not None:
        gone = f"for {duration_text(unheard_ns / NS_PER_S)}: whoever started it is gone, or can't be reached"
        condition, since = NOT_HEARD_OF, gone
    elif state.step_age_s >= 1.0:
        since = f"on its step for {duration_text(state.step_age_s)}"
    restarts = "" if state.starts <= 1 else f"restarted {state.starts - 1} time{'s' if state.starts > 2 else ''}"
    if state.last_exit and state.starts > 1:
        restarts += f" (last: {state.last_exit})"
    return condition, since, restarts
