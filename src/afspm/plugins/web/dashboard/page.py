"""The page: its sections, and their updates for one viewer."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import ClassVar

from nicegui import ui

from afspm.components import Levelling
from afspm.drawing import PALETTES, TIMELINE_CSS
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.dashboard.actions import Steering
from afspm.plugins.web.dashboard.conditions import Conditions
from afspm.plugins.web.dashboard.content import Content, Contents
from afspm.plugins.web.dashboard.page_parts import page_part
from afspm.plugins.web.dashboard.panels import AlarmBar, ChartPanel, HealthPanel, LogPanel, NotesPanel, SpectraPanel
from afspm.plugins.web.dashboard.sign_in import SIGN_IN
from afspm.plugins.web.dashboard.steering_panel import ModeButtons, ProblemBar, SettingsBar, SteeringPanel
from afspm.plugins.web.dashboard.steering_session import SteeringSession
from afspm.plugins.web.watch import Audience, Watch

ASSETS = Path(__file__).with_name("assets")
REFRESH_S = 0.5
ANSWER_S = 5.0  # a browser that has not drawn the last update within this time gets no more until it has
THEMES = {"": None, "light": False, "dark": True}
# relative addresses: behind a proxy the page may lie on a path of its own
_HEAD = f"""<style>{TIMELINE_CSS}</style><link rel="stylesheet" href="assets/dashboard.css">
<script type="module" src="assets/page.js"></script>"""
LEVELLINGS = {Levelling.LINES: "line by line"}
"""Labels of levellings whose value is no word."""
SIMULATED = "SIMULATED: this is not a real microscope"


@dataclass(frozen=True)
class Services:
    """The parts of the dashboard that every page uses.

    Attributes:
        title: the name of the experiment.
        simulated: True if the microscope is simulated.
        conditions: parameters at the start of each scan.
    """

    watch: Watch
    contents: Contents
    steering: Steering
    audience: Audience
    access: Access
    title: str
    simulated: bool
    conditions: Conditions
    run_dir: Path


TABS = {"scan": "Scan", "sample": "Sample", "steer": "Steer", "time": "Night", "log": "Log"}
"""Tabs on a phone; the style sheet assigns each section to a tab."""


class Page:
    """The page of one viewer."""

    tabs: ClassVar[Mapping[str, str]] = TABS

    def __init__(self, services: Services, visitor: Visitor) -> None:
        self._services = services
        self._visitor = visitor
        services.audience.join(self)
        ui.context.client.on_delete(lambda: services.audience.leave(self))
        ui.page_title(services.title)
        ui.add_head_html(_HEAD)
        ui.colors(primary="#0b6e72", negative="#b3261e", positive="#2f7d46")
        self._theme = Theme()
        self._session = SteeringSession(services.watch, services.steering, visitor, services.run_dir)
        with ui.element("div").classes("top"):
            self._header()
        with ui.element("main").classes(f"page{' may-steer' if visitor.may_steer else ''}"):
            self._sections = Sections(services, self._session, visitor)
            self._add_more()
        ui.html(_tabs_html(self.tabs, steering=visitor.may_steer), sanitize=False)
        self._timer = ui.timer(REFRESH_S, self._refresh)

    def _add_more(self) -> None:
        # for sections of a subclass
        ...

    def _header(self) -> None:
        services = self._services
        if services.simulated:
            ui.html(SIMULATED, sanitize=False).classes("simulated").props('role="note"')
        with ui.element("header").classes("bar"):
            ui.html(f"<h1>{escape(services.title)}</h1>", sanitize=False)
            self._status = ui.html("", sanitize=False).classes("chips").props('role="status" aria-live="off"')
            self._mode = ModeButtons(self._session)
            with ui.element("nav").classes("who"):
                button = ui.button(icon="contrast", on_click=self._theme.next)
                button.props('flat round dense aria-label="Light or dark"')
                self._sign_in_or_out()
        self._problems = ProblemBar(self._session)
        self._settings = SettingsBar(self._session)
        self._alarms = AlarmBar()
        approvals = page_part("approvals")
        self._approvals = approvals and approvals(self._session)
        ui.html('<div id="trouble" role="alert" hidden></div>', sanitize=False)

    def _sign_in_or_out(self) -> None:
        if not self._visitor.person:
            ui.html('<a class="sign" href="login">Sign in</a>', sanitize=False)
            return
        ui.html(
            f'<form method="post" action="logout"><span class="person">{escape(self._visitor.person)}</span> '
            '<button type="submit" class="sign">Sign out</button> '
            '<button type="submit" class="sign" name="everywhere" value="yes">everywhere</button></form>',
            sanitize=False,
        )

    async def _refresh(self) -> None:
        # waits until the browser has drawn the update, so that nothing is queued for a slow one
        if not self._services.access.is_signed_in(self._visitor):
            self._stop()
            ui.navigate.to(SIGN_IN)
            return
        content = self._services.contents.get()
        self._session.content = content
        self._status.set_content(content.status)
        self._mode.show()
        self._problems.show()
        self._settings.show()
        self._alarms.show(content.alarms)
        if self._approvals:
            self._approvals.show()
        self._sections.show(content)
        state = self._state(content)
        try:
            theme = await ui.run_javascript(f"return window.afspm?.update({json.dumps(state)})", timeout=ANSWER_S)
        except TimeoutError:
            # a slow or sleeping browser: the next refresh tries again
            return
        self._theme.remember(theme)
        if content.ended:
            self._stop()

    def _state(self, content: Content) -> dict[str, object]:
        with self._services.watch.reading():
            newest = self._services.watch.frames.last_number
        return {
            "channels": content.channels,
            "newest": newest,
            "trouble": content.trouble,
            "ended": content.ended,
            "may_measure": self._session.may_measure,
            "may_grant": self._session.may_steer and bool(content.agents) and page_part("grant") is not None,
        }

    def _stop(self) -> None:
        self._timer.deactivate()
        self._services.audience.leave(self)


class Theme:
    """The light or dark theme, or the viewer's system theme; the browser stores the choice."""

    def __init__(self) -> None:
        self._dark = ui.dark_mode(None)
        self._name = ""

    def next(self) -> None:
        names = list(THEMES)
        self._set(names[(names.index(self._name) + 1) % len(names)])
        ui.run_javascript(f"window.afspm?.keepTheme({json.dumps(self._name)})")

    def remember(self, name: object) -> None:
        """Apply the choice stored in the browser."""
        if isinstance(name, str) and name != self._name and name in THEMES:
            self._set(name)

    def _set(self, name: str) -> None:
        self._name = name
        self._dark.set_value(THEMES[name])


class Sections:
    """The sections below the header: the first rows fill a screen, and further rows follow. A phone has tabs."""

    def __init__(self, services: Services, session: SteeringSession, visitor: Visitor) -> None:
        self._content = Content()
        self._steering = None
        with ui.element("div").classes("screen"):
            with section("Scan", "scan"):
                ui.html(_image_html(), sanitize=False)
            with section("Sample", "sample"):
                self._whole_map = ui.switch("all of the limits", on_change=self._draw).props("dense")
                self._map = ui.html("", sanitize=False).classes("fills")
            if session.signed_in:
                with section("Steering", "steer"):
                    self._steering = SteeringPanel(session)
            with section("Time line", "time"):
                self._unfolded = ui.switch("all processes", on_change=self._draw).props("dense")
                self._time_line = ui.html("", sanitize=False).classes("fills")
            with section("Log", "log"):
                self._log = LogPanel()
        with ui.element("div").classes("further"):
            with section("Notes", "noted"):
                self._notes = NotesPanel(services.watch, services.steering, visitor)
            with section("Messages of components", "messages") as self._messages_section:
                self._messages = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0"')
            with section("Processes", "health"):
                self._health = HealthPanel(session)
            with section("Spectra", "spectra") as self._spectra_section:
                self._spectra = SpectraPanel(services.watch)
            with section("Drift", "drift") as self._drift_section:
                self._drift = ChartPanel()
            with section("Last refusals", "refused"):
                self._refusals = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0"')

    def show(self, content: Content) -> None:
        """Update all sections."""
        self._content = content
        self._draw()
        self._drift.show(content.slow.drift)
        self._drift_section.set_visibility(content.slow.drift.options is not None)
        self._refusals.set_content(content.refusals)
        self._health.show(content.processes, content.unheard)
        self._log.show(content.log, (process.name for process in content.processes))
        self._notes.show(content.notes)
        self._messages.set_content(content.slow.messages)
        self._messages_section.set_visibility(bool(content.slow.messages))
        self._spectra_section.set_visibility(self._spectra.show())
        if self._steering is not None:
            self._steering.show(content)

    def _draw(self) -> None:
        slow = self._content.slow
        self._map.set_content(slow.sample_map if self._whole_map.value else slow.sample_map_near)
        self._time_line.set_content(slow.time_line_unfolded if self._unfolded.value else slow.time_line)


def _tabs_html(tabs: Mapping[str, str], *, steering: bool) -> str:
    buttons = "".join(
        f'<button type="button" role="tab" data-tab="{name}">{text}</button>'
        for name, text in tabs.items()
        if steering or name != "steer"
    )
    return f'<div class="tabs" role="tablist" aria-label="Parts of the page">{buttons}</div>'


@contextmanager
def section(title: str, name: str) -> Iterator[ui.element]:
    with ui.element("section").classes(f"panel {name}").props(f'aria-labelledby="heading-{name}"') as section:
        ui.html(f'<h2 id="heading-{name}">{title}</h2>', sanitize=False)
        yield section


def _image_html() -> str:
    # assets/image.js finds these elements by their names
    offered = {
        "palettes": {name: name for name in PALETTES},
        "levellings": {how.value: LEVELLINGS.get(how, how.value) for how in sorted(Levelling, key=_plane_first)},
    }
    html = (ASSETS / "image.html").read_text(encoding="utf-8")
    for name, options in offered.items():
        every = "".join(f'<option value="{value}">{text}</option>' for value, text in options.items())
        html = html.replace(f"{{{name}}}", every)
    return html


def _plane_first(how: Levelling) -> bool:
    return how is not Levelling.PLANE
