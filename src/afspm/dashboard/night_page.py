"""The page of a recorded night: that of a running experiment at one moment, with a slider through all of them."""

from __future__ import annotations

from dataclasses import replace
from html import escape
from typing import ClassVar

from nicegui import events, ui

from afspm.dashboard.access import Visitor
from afspm.dashboard.content import Content
from afspm.dashboard.night import Night, NightContents, NightWatch
from afspm.dashboard.page import ASSETS, TABS, Page, Services, section
from afspm.record.run_lock import describe_state
from afspm.web.archive import allowed_region

_HEAD = """<link rel="stylesheet" href="/assets/night.css"><script type="module" src="/assets/night.js"></script>"""


class NightPage(Page):
    """The page of one viewer, who has a moment of the own."""

    tabs: ClassVar = {**TABS, "two": "Compare"}

    def __init__(self, night: Night, pictures: str, services: Services, visitor: Visitor) -> None:
        self._night = night
        self._watch = NightWatch(night)
        contents = NightContents(self._watch, allowed_region(night.folder), pictures)
        ui.add_head_html(_HEAD)
        super().__init__(replace(services, watch=self._watch, contents=contents), replace(visitor, recorded=True))
        ui.on("moment", self._go)

    def _header(self) -> None:
        super()._header()
        ended = escape(describe_state(self._night.folder))
        report = '<a href="/night/report" target="_blank">Report of the night</a>'
        ui.html(f'<p class="how-ended">Recorded: {ended}. {report}</p>{_asset("scrubber")}', sanitize=False)

    def _add_more(self) -> None:
        with ui.element("div").classes("further more"):
            with section("Two scans", "two"):
                ui.html(_asset("compare"), sanitize=False)
            if self._night.drifted():
                with section("Before and after drift correction", "flip"):
                    ui.html(_asset("flipbook"), sanitize=False)

    def _state(self, content: Content) -> dict[str, object]:
        return super()._state(content) | {"moment": str(self._watch.moment_ns)}

    async def _go(self, event: events.GenericEventArguments) -> None:
        """Show another moment."""
        self._watch.go(int(event.args["time"]))
        await self._refresh()


def _asset(name: str) -> str:
    return (ASSETS / f"{name}.html").read_text(encoding="utf-8")
