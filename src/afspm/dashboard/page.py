"""The one page: its sections, and what keeps them up to date for one viewer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from nicegui import events, ui

from afspm.dashboard.access import Access, Visitor
from afspm.dashboard.audience import Audience
from afspm.dashboard.content import Content, Contents
from afspm.dashboard.curves import spectrum_html
from afspm.dashboard.guard import ENTRANCE
from afspm.dashboard.health_panel import HealthPanel
from afspm.dashboard.log_panel import LogPanel
from afspm.dashboard.palettes import PALETTES
from afspm.dashboard.steering import Steering
from afspm.dashboard.steering_panel import SteeringPanel
from afspm.dashboard.watch import Watch
from afspm.dashboard.words import escape

REFRESH_S = 0.5
ANSWER_S = 5.0  # a browser that has not drawn the last for so long gets nothing more until it has
THEMES = {"": None, "light": False, "dark": True}
_HEAD = """<link rel="stylesheet" href="/assets/dashboard.css">
<script type="module" src="/assets/page.js"></script>"""
SIMULATED = "SIMULATED: this is no real microscope"


@dataclass(frozen=True)
class Services:
    """What the page is made from.

    Attributes:
        title: the name of the experiment.
        simulated: whether the microscope is none.
    """

    watch: Watch
    contents: Contents
    steering: Steering
    audience: Audience
    access: Access
    title: str
    simulated: bool


class Page:
    """The page of one viewer."""

    def __init__(self, services: Services, visitor: Visitor) -> None:
        self._services = services
        self._visitor = visitor
        services.audience.join(self)
        ui.context.client.on_delete(lambda: services.audience.leave(self))
        self._content = Content()
        self._spectrum_ns: int | None = None
        self._spectra_shown: tuple[object, ...] = ()
        ui.page_title(services.title)
        ui.add_head_html(_HEAD)
        ui.colors(primary="#0b6e72", negative="#b3261e", positive="#2f7d46")
        self._dark = ui.dark_mode(None)
        self._theme = ""
        self._header()
        with ui.element("main").classes("grid"):
            self._sections()
        ui.on("spectrum_picked", self._pick_spectrum)
        self._timer = ui.timer(REFRESH_S, self._refresh)

    # --- what is on it ---

    def _header(self) -> None:
        services = self._services
        if services.simulated:
            ui.html(SIMULATED, sanitize=False).classes("simulated").props('role="note"')
        with ui.element("header").classes("bar"):
            ui.html(f"<h1>{escape(services.title)}</h1>", sanitize=False)
            self._status = ui.html("", sanitize=False).classes("chips").props('role="status" aria-live="off"')
            with ui.element("nav").classes("who"):
                ui.button(icon="contrast", on_click=self._next_theme).props(
                    'flat round dense aria-label="Light or dark"'
                )
                self._sign_in_or_out()
        ui.html('<div id="trouble" role="alert" hidden></div>', sanitize=False)

    def _sign_in_or_out(self) -> None:
        if not self._visitor.may_steer:
            ui.html('<a class="sign" href="/login">Sign in to steer</a>', sanitize=False)
            return
        name = escape(self._visitor.person)
        ui.html(
            f'<form method="post" action="/logout"><span class="person">{name}</span> '
            '<button type="submit" class="sign">Sign out</button> '
            '<button type="submit" class="sign" name="everywhere" value="yes">everywhere</button></form>',
            sanitize=False,
        )

    def _sections(self) -> None:
        services = self._services
        with _section("Scan", "scan"):
            ui.html(_image_html(), sanitize=False)
        with _section("Steering", "steer"):
            self._steering = SteeringPanel(services.watch, services.steering, self._visitor)
        with _section("Sample", "sample"):
            self._whole_map = ui.switch("with all of the limits", on_change=self._draw_map).props("dense")
            self._map = ui.html("", sanitize=False)
        with _section("Time line", "time"):
            self._time_line = ui.html("", sanitize=False)
        with _section("Processes", "health"):
            self._health = HealthPanel(self._steering)
        with _section("Spectra", "spectra"):
            self._variable = ui.select([], label="variable", on_change=self._draw_spectrum).props("dense outlined")
            self._spectrum = ui.html("", sanitize=False)
        with _section("Drift", "drift"):
            self._drift = ui.html("", sanitize=False)
        with _section("Last refusals", "refused"):
            self._refusals = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0"')
        with _section("Log", "log"):
            self._log = LogPanel()

    # --- what changes ---

    async def _refresh(self) -> None:
        """Bring the page up to date, and wait until the browser has drawn that: nothing is queued for a slow one."""
        if not self._services.access.is_signed_in(self._visitor):
            self._timer.deactivate()
            self._services.audience.leave(self)
            ui.navigate.to(ENTRANCE)
            return
        content = self._services.contents.get()
        self._status.set_content(content.status)
        self._content = content
        self._draw_map()
        self._time_line.set_content(content.time_line)
        self._drift.set_content(content.drift)
        self._refusals.set_content(content.refusals)
        self._health.show(content.processes, content.unheard)
        self._log.show(content.log, tuple(process.name for process in content.processes))
        self._steering.show(content)
        self._draw_spectrum()
        await self._tell_browser(content)

    async def _tell_browser(self, content: Content) -> None:
        state = {
            "channels": content.channels,
            "trouble": content.trouble,
            "ended": content.ended,
            "may_measure": self._steering.may_measure,
        }
        try:
            theme = await ui.run_javascript(f"return window.afspm?.update({json.dumps(state)})", timeout=ANSWER_S)
        except TimeoutError:
            return
        if isinstance(theme, str) and theme != self._theme and theme in THEMES:
            self._set_theme(theme)
        if content.ended:
            self._timer.deactivate()
            self._services.audience.leave(self)

    def _draw_map(self) -> None:
        content = self._content
        self._map.set_content(content.sample_map if self._whole_map.value else content.sample_map_near)

    def _draw_spectrum(self) -> None:
        with self._services.watch.reading():
            store = self._services.watch.spectra
            spectra = store.newest(8)
            if self._spectrum_ns is not None and (one := store.at(self._spectrum_ns)) is not None:
                spectra = [(self._spectrum_ns, one)]
        shown = (tuple(time_ns for time_ns, _ in spectra), self._variable.value)
        if spectra:
            names = list(spectra[-1][1].names[1:])
            if self._variable.options != names:
                self._variable.set_options(names, value=names[0] if names else None)
                shown = (shown[0], self._variable.value)
        self._variable.set_visibility(bool(spectra))
        if shown != self._spectra_shown or not spectra:
            self._spectra_shown = shown
            self._spectrum.set_content(spectrum_html(spectra, str(self._variable.value or "")))

    def _pick_spectrum(self, event: events.GenericEventArguments) -> None:
        self._spectrum_ns = int(event.args["time"])
        self._draw_spectrum()

    def _next_theme(self) -> None:
        names = list(THEMES)
        self._set_theme(names[(names.index(self._theme) + 1) % len(names)])
        ui.run_javascript(f"window.afspm?.keepTheme({json.dumps(self._theme)})")

    def _set_theme(self, theme: str) -> None:
        self._theme = theme
        self._dark.set_value(THEMES[theme])


@contextmanager
def _section(title: str, name: str) -> Iterator[None]:
    with ui.element("section").classes(f"panel {name}").props(f'aria-labelledby="heading-{name}"'):
        ui.html(f'<h2 id="heading-{name}">{title}</h2>', sanitize=False)
        yield


def _image_html() -> str:
    """What assets/image.js brings to life."""

    def choice(part: str, label: str, options: dict[str, str]) -> str:
        inner = "".join(f'<option value="{value}">{text}</option>' for value, text in options.items())
        return f'<label>{label}<select data-part="{part}">{inner}</select></label>'

    levelling = {"plane": "plane", "lines": "line by line", "none": "none"}
    contrast = {"robust": "99 %", "full": "all values"}
    tools = {"look": "Look", "profile": "Profile", "scan": "Scan here", "spectrum": "Spectrum here"}
    buttons = "".join(
        f'<button type="button" data-tool="{tool}" aria-pressed="{str(tool == "look").lower()}"'
        f"{' class=measure' if tool in ('scan', 'spectrum') else ''}>{text}</button>"
        for tool, text in tools.items()
    )
    zoom = {"1.5": ("+", "Zoom in"), "0.667": ("−", "Zoom out"), "0": ("all", "Show all of it")}
    zooms = "".join(
        f'<button type="button" data-zoom="{by}" aria-label="{label}">{text}</button>'
        for by, (text, label) in zoom.items()
    )
    return (
        '<div id="image" class="image"><div class="tools">'
        f"{choice('channel', 'Channel', {})}{choice('levelling', 'Level', levelling)}"
        f"{choice('contrast', 'Colours for', contrast)}{choice('palette', 'Map', {p: p for p in PALETTES})}</div>"
        f'<div class="tools"><div class="group" role="group" aria-label="What the pointer does">{buttons}</div>'
        f'<div class="group" role="group" aria-label="Zoom">{zooms}</div>'
        '<button type="button" class="live" data-part="live">Back to the newest scan</button></div>'
        '<canvas data-part="canvas" class="picture" tabindex="0" role="img" '
        'aria-label="The scan. Arrow keys move the cross, plus and minus zoom, 0 shows all of it."></canvas>'
        '<output class="readout" data-part="readout" aria-live="polite">Point at the scan to read its values.</output>'
        '<canvas data-part="profile" class="profile" hidden role="img" aria-label="Profile along the line"></canvas>'
        '<p class="caption"><span data-part="caption">No scan yet.</span> <small data-part="hint"></small></p></div>'
    )
