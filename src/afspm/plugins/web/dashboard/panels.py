"""Parts of the page with state for one viewer: the log's filter, rows of processes, spectra, and notes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from html import escape

from nicegui import context, events, ui

from afspm.basics import NS_PER_S, duration_text, time_of_day
from afspm.drawing import tint_class
from afspm.model import LogLine, ProcessCondition, ProcessState
from afspm.plugins.web.dashboard.access import Visitor
from afspm.plugins.web.dashboard.actions import ActionResult, Steering
from afspm.plugins.web.dashboard.charts import Chart, spectrum_chart
from afspm.plugins.web.dashboard.content import NO_REPORT
from afspm.plugins.web.dashboard.scan_facts import summary_of, tip_facts
from afspm.plugins.web.dashboard.steering_panel import ask_restart
from afspm.plugins.web.dashboard.steering_session import SteeringSession, button
from afspm.plugins.web.watch import Watch

MOST_LINES = 300
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")
MOMENT, SCAN = "this moment", "the scan shown"
_SHOWN = "return window.afspm?.scansToNote?.() ?? ['', '']"
_EVERYTHING = "all"
_BAD = {ProcessCondition.SILENT, ProcessCondition.RESTARTING, ProcessCondition.GIVEN_UP}


class ChartPanel:
    """A line of text and a chart below it; the browser receives the chart only after a change."""

    def __init__(self) -> None:
        self._words = ui.html("", sanitize=False)
        self._chart = ui.echart({}, renderer="svg").classes("chart")
        self._shown = Chart("")
        self._chart.set_visibility(False)

    def show(self, chart: Chart) -> None:
        if chart == self._shown:
            return
        self._shown = chart
        self._words.set_content(chart.words)
        self._chart.set_visibility(chart.options is not None)
        if chart.options is not None:
            self._chart.options.clear()
            self._chart.options.update(chart.options)
            self._chart.update()


class SpectraPanel:
    """The newest spectrum with earlier spectra behind it, or the spectrum selected in the map."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._picked_ns: int | None = None
        self._shown: tuple[object, ...] = ()
        self._variable = ui.select({}, label="variable", on_change=self.show).props("dense outlined")
        self._chart = ChartPanel()
        ui.on("spectrum_picked", self._pick)

    def show(self) -> bool:
        """Update the chart; return whether there is a spectrum."""
        with self._watch.reading() as overview:
            store = self._watch.spectra
            picked = None if self._picked_ns is None else store.at(self._picked_ns)
            spectra = store.newest(8) if picked is None or self._picked_ns is None else [(self._picked_ns, picked)]
            conditions = overview.conditions(spectra[-1][0]) if spectra else None
        labels = {name: spectra[-1][1].label(name) for name in spectra[-1][1].names[1:]} if spectra else {}
        if self._variable.options != labels:
            self._variable.set_options(labels, value=next(iter(labels), None))
        self._variable.set_visibility(bool(spectra))
        wanted = (*(time_ns for time_ns, _ in spectra), self._variable.value)
        if wanted != self._shown:
            self._shown = wanted
            facts = [] if conditions is None else tip_facts((conditions.begin, conditions.end), conditions.acts)
            if conditions is not None and (settings := conditions.caption()):
                facts = [("Settings", settings), *facts]
            self._chart.show(spectrum_chart(spectra, str(self._variable.value or ""), facts))
        return bool(spectra)

    def _pick(self, event: events.GenericEventArguments) -> None:
        self._picked_ns = int(event.args["time"])
        self.show()


class LogPanel:
    """The log, newest lines first, with a filter for one viewer."""

    def __init__(self) -> None:
        self._shown: tuple[object, ...] = ()
        self._lines: Sequence[LogLine] = ()
        with ui.element("div").classes("tools"):
            self._name = ui.select([_EVERYTHING], value=_EVERYTHING, label="component", on_change=self._draw)
            self._level = ui.select(list(LEVELS), value="INFO", label="at least", on_change=self._draw)
            self._text = ui.input("contains", on_change=self._draw)
        for element in (self._name, self._level, self._text):
            element.props("dense outlined").classes("field")
        self._html = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0" role="log" aria-live="off"')

    def show(self, lines: Sequence[LogLine], names: Iterable[str]) -> None:
        every = [_EVERYTHING, *sorted({*names, *(line.name for line in lines)})]
        if every != self._name.options:
            self._name.set_options(every, value=self._name.value)
        self._lines = lines
        self._draw()

    def _draw(self) -> None:
        newest = self._lines[-1] if self._lines else None
        wanted = (newest, len(self._lines), self._name.value, self._level.value, self._text.value)
        if wanted == self._shown:
            return
        self._shown = wanted
        names = frozenset() if self._name.value == _EVERYTHING else frozenset({str(self._name.value)})
        self._html.set_content(log_html(self._lines, names, str(self._level.value), str(self._text.value or "")))


def log_html(lines: Iterable[LogLine], names: frozenset[str], level: str, text: str = "") -> str:
    """Return at most `MOST_LINES` log lines as HTML, newest first.

    Args:
        names: names of components; empty: all.
        level: the lowest level shown.
        text: text that a line must contain; case is ignored.
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
        f'<b class="{tint_class(line.name)}">{escape(line.name)}</b>'
        f"<div>{_level_html(line.level)}<span>{escape(line.text)}</span></div></li>"
        for line in wanted[: -MOST_LINES - 1 : -1]
    )
    return f'<ul class="log">{rows}</ul>'


def _level_html(level: str) -> str:
    # INFO is the usual level, and not shown
    return "" if level == "INFO" else f"<i>{escape(level)}</i> "


class AlarmBar:
    """A line for each CRITICAL message that is not over, with a button that hides it from this viewer."""

    def __init__(self) -> None:
        self._alarms: tuple[LogLine, ...] = ()
        self._shown: tuple[LogLine, ...] = ()
        self._seen: set[LogLine] = set()
        self._box = ui.element("div").classes("problems alarms").props('role="alert"')
        self._box.set_visibility(False)

    def show(self, alarms: tuple[LogLine, ...]) -> None:
        self._alarms = alarms
        shown = tuple(alarm for alarm in alarms if alarm not in self._seen)
        if shown == self._shown:
            return
        self._shown = shown
        self._box.set_visibility(bool(shown))
        self._box.clear()
        with self._box:
            for alarm in shown:
                with ui.element("div").classes("flag"):
                    ui.html(alarm_html(alarm), sanitize=False)
                    button("Seen", partial(self._hide, alarm)).props["aria-label"] = f"Hide the message of {alarm.name}"

    def _hide(self, alarm: LogLine) -> None:
        self._seen.add(alarm)
        self.show(self._alarms)


def alarm_html(alarm: LogLine) -> str:
    """Return a CRITICAL line as HTML, with its process and time."""
    return (
        f'<b data-part="alarm">{escape(alarm.name)}</b> <small>at {time_of_day(alarm.time_ns)}</small>'
        f'<span class="advice">{escape(alarm.text)}</span>'
    )


class HealthPanel:
    """A row for each process. Rows keep their place when their text changes, so that buttons do not move."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._rows: dict[str, HealthRow] = {}
        self._nothing = ui.html("No process has reported yet.", sanitize=False).classes("nothing")
        self._list = ui.element("div").classes("processes").props('role="table" aria-label="Processes"')

    def show(self, processes: Sequence[ProcessState], unheard: Mapping[str, int]) -> None:
        """Update the rows; `unheard` as in `Content`."""
        self._nothing.set_visibility(not processes)
        for state in processes:
            row = self._rows.get(state.name)
            if row is None:
                with self._list:
                    row = self._rows[state.name] = HealthRow(state.name, self._session)
            row.show(state, unheard.get(state.name))


class HealthRow:
    """The condition of a process, and a button for its restart."""

    def __init__(self, name: str, session: SteeringSession) -> None:
        with ui.element("div").classes("process").props('role="row"'):
            self._dot = ui.element("span").classes("dot")
            ui.label(name).classes("name").props('role="rowheader"')
            self._cells = [ui.label().props('role="cell"') for _ in range(3)]
            for cell in self._cells[1:]:
                cell.classes("quiet")
            self._button = ui.button("Restart", on_click=lambda: ask_restart(session, name))
            self._button.props("flat dense no-caps")
            self._button.props["aria-label"] = f"Restart {name}"  # as text of properties a name could set others
        self._session = session
        self._style = ""

    def show(self, state: ProcessState, unheard_ns: int | None) -> None:
        words = process_words(state, unheard_ns)
        for cell, text in zip(self._cells, words, strict=True):
            cell.set_text(text)
        style = "bad" if state.condition in _BAD or words[0] == NO_REPORT else words[0].replace(" ", "-")
        if style != self._style:
            self._dot.classes(remove=f"is-{self._style}", add=f"is-{style}")
            self._style = style
        self._button.set_visibility(self._session.may_steer)


def process_words(state: ProcessState, unheard_ns: int | None = None) -> tuple[str, str, str]:
    """Return (condition, since when or busy for how long, restarts) of a process, in words.

    Args:
        unheard_ns: time without a report, while other processes report.
    """
    condition = state.condition.name.lower().replace("_", " ")
    since = f"since {time_of_day(state.since_ns)}"
    if unheard_ns is not None:
        gone = f"for {duration_text(unheard_ns / NS_PER_S)}: its supervisor has ended or can't be reached"
        condition, since = NO_REPORT, gone
    elif state.step_age_s >= 1.0:
        since = f"in the same step for {duration_text(state.step_age_s)}"
    restarts = "" if state.starts <= 1 else f"restarted {state.starts - 1} time{'s' if state.starts > 2 else ''}"
    if state.last_exit and state.starts > 1:
        restarts += f" (last: {state.last_exit})"
    return condition, since, restarts


class NotesPanel:
    """The list of notes, with a field to write a note for viewers who have signed in."""

    def __init__(self, watch: Watch, steering: Steering, visitor: Visitor) -> None:
        self._watch = watch
        self._steering = steering
        self._visitor = visitor
        self._client = context.client
        if visitor.person:
            with ui.element("div").classes("acts"):
                self._text = ui.input("note").props("dense outlined").classes("text").on("keydown.enter", self._write)
                self._on = ui.select([SCAN, MOMENT], value=SCAN, label="on").props("dense outlined")
                ui.button("Note", on_click=self._write, color=None).props("no-caps outline")
        else:
            ui.html('<p class="quiet"><a href="login">Sign in</a> to write a note.</p>', sanitize=False)
        self._list = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0"')

    def show(self, notes: str) -> None:
        self._list.set_content(notes)

    async def _write(self) -> None:
        text, time_ns, scan_ns = str(self._text.value or "").strip(), self._watch.moment_ns, None
        if self._on.value == SCAN:
            shown, begun = await ui.run_javascript(_SHOWN)
            shown = shown if time_ns is not None else begun
            if not shown:
                self._say(ActionResult("The scan shown is not finished: write the note on this moment.", ok=False))
                return
            scan_ns, time_ns = int(shown), None
        doing = self._steering.do(self._visitor, lambda actions: actions.note(text, scan_ns, time_ns))
        result = await asyncio.wrap_future(doing)
        if result.ok and scan_ns is not None:
            result = replace(result, text=self._noted_on(scan_ns) or result.text)
        if not self._client.is_deleted:
            self._say(result)

    def _noted_on(self, scan_ns: int) -> str:
        with self._watch.reading() as overview:
            summary = summary_of(scan_ns, overview)
        return "" if summary is None else f"Noted on scan {summary.number}."

    def _say(self, result: ActionResult) -> None:
        with self._client:
            ui.notify(result.text, type="positive" if result.ok else "negative", position="bottom-right")
            if result.ok:
                self._text.set_value("")
