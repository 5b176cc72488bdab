"""The page of a recorded night: a running experiment's page at one time, with a slider through the night.

The module also answers the page's scripts (scans, difference of two scans, report), and adds notes to the record.
"""

from __future__ import annotations

import asyncio
import json
import logging
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from html import escape
from typing import ClassVar

import numpy as np
from fastapi import FastAPI, Response
from fastapi.responses import FileResponse, PlainTextResponse
from nicegui import events, ui

from afspm.basics import AfspmError, ExperimentClock, InvalidValue, Plain, time_of_day, typeset_area, zone_offsets_s
from afspm.components import Levelling, append_note, levelled
from afspm.drawing import DIVERGING, ValueRange, indices, png, value_range
from afspm.model import PERSON
from afspm.night import ScanRow
from afspm.plugins.drift.report.scan_pair import onto_first
from afspm.plugins.web.archive import Archive, allowed_region
from afspm.plugins.web.dashboard import shadow_marks
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.dashboard.actions import Action, ActionResult, Actions, Steering, not_signed_in
from afspm.plugins.web.dashboard.content import Content, Contents
from afspm.plugins.web.dashboard.night import Night, NightWatch
from afspm.plugins.web.dashboard.page import ASSETS, TABS, Page, Services, section
from afspm.plugins.web.dashboard.pictures import Look, RenderedFrame
from afspm.plugins.web.frames import ChannelFrame
from afspm.record import bands_allowed, describe_state
from afspm.report import REPORT_FILE, write_report

_HEAD = """<link rel="stylesheet" href="assets/night.css"><script type="module" src="assets/night.js"></script>"""


class NightPage(Page):
    """The page of one viewer, at a time that the viewer selects."""

    tabs: ClassVar = {**TABS, "two": "Compare"}

    def __init__(self, night: Night, pictures: str, services: Services, visitor: Visitor) -> None:
        self._night = night
        self._watch = NightWatch(night)
        limits, bands = allowed_region(night.folder), bands_allowed(night.folder)
        contents = Contents(self._watch, limits, pictures=pictures, bands=bands)
        ui.add_head_html(_HEAD)
        super().__init__(replace(services, watch=self._watch, contents=contents), replace(visitor, recorded=True))
        ui.on("moment", self._go)

    def _header(self) -> None:
        super()._header()
        ended = escape(describe_state(self._night.folder))
        report = '<a href="night/report" target="_blank">Report of the night</a>'
        ui.html(f'<p class="how-ended">Recorded: {ended}. {report}</p>{_asset("scrubber")}', sanitize=False)

    def _add_more(self) -> None:
        with ui.element("div").classes("further more"):
            if (watched := shadow_marks.read(self._night.folder)).agreement:
                with section("What afspm would have done", "shadow"):
                    steering = self._services.steering
                    shadow_marks.ShadowMarks(self._night.folder, watched, steering, self._visitor)
            with section("Two scans", "two"):
                ui.html(_asset("compare"), sanitize=False)
            if self._night.drifted():
                with section("Before and after drift correction", "flip"):
                    ui.html(_asset("flipbook"), sanitize=False)

    def _state(self, content: Content) -> dict[str, object]:
        return super()._state(content) | {"moment": str(self._watch.moment_ns)}

    async def _go(self, event: events.GenericEventArguments) -> None:
        self._watch.go(int(event.args["time"]))
        await self._refresh()


def _asset(name: str) -> str:
    return (ASSETS / f"{name}.html").read_text(encoding="utf-8")


class NightRequests:
    """The handler of requests from the night page's scripts."""

    def __init__(self, night: Night, archive: Archive) -> None:
        self._night = night
        self._archive = archive

    def add_to(self, app: FastAPI) -> None:
        app.get("/night/scans", response_model=None)(self._scans)
        app.get("/night/difference", response_model=None)(self._difference)
        app.get("/night/report", response_model=None)(self._report)

    async def _scans(self) -> Plain:
        # times are texts: JavaScript has no exact integers of 64 bits
        night = self._night
        drifted = night.drifted()
        published_ns = night.published_ns()
        scans = [_scan(row) for row in night.scans if row.region is not None and row.shape is not None]
        for scan in scans:
            scan["seen"] = str(published_ns.get(int(scan["time"]), scan["time"]))
            if (places := drifted.get(scan["number"])) is not None:
                scan |= {"tip": places.tip_m, "sample": places.sample_m}
        return {
            "begin": str(night.begin_ns),
            "end": str(night.end_ns),
            "offsets": [
                [str(since_ns), offset_s] for since_ns, offset_s in zone_offsets_s(night.begin_ns, night.end_ns)
            ],
            "scans": scans,
            "notes": [
                {"time": str(one.time_ns), "text": one.thing.text} for one in night.events if one.message == "Note"
            ],
        }

    async def _difference(self, first: int, second: int, channel: str, levelling: str = "plane") -> Response:
        # second minus first as a picture, with their alignment as text in its head
        how = Levelling(levelling) if levelling in Levelling._value2member_map_ else Levelling.PLANE
        return await asyncio.to_thread(self._compared, first, second, channel, how)

    def _compared(self, first: int, second: int, channel: str, how: Levelling) -> Response:
        one, other = self._archive.frame(first, channel), self._archive.frame(second, channel)
        if one is None or other is None:
            return PlainTextResponse("the values of one of the two scans can't be read", 404)
        try:
            change, words = difference(one, other, how)
        except InvalidValue as error:
            return PlainTextResponse(error.what, 422)
        found = value_range(change.values)
        most = max(abs(found.low), abs(found.high))
        span = ValueRange(-most, most)  # white is no difference
        look = Look(how, palette=DIVERGING)
        drawn = RenderedFrame(change, look, change.values, span, png(indices(change.values, span), DIVERGING))
        headers = {"X-Frame": drawn.head([]), "X-Words": json.dumps(words), "Cache-Control": "no-store"}
        return Response(drawn.png, media_type="image/png", headers=headers)

    async def _report(self) -> Response:
        file = self._night.folder / REPORT_FILE
        if not file.is_file():
            return PlainTextResponse(f"the run has no report yet: `afspm report {self._night.folder}` writes it", 404)
        return FileResponse(file, media_type="text/html")


def _scan(row: ScanRow) -> Plain:
    assert row.region is not None
    cut = ", interrupted" if row.interrupted else ""
    return {
        "time": str(row.time_ns),
        "number": row.number,
        "text": f"{time_of_day(row.time_ns)}, {typeset_area(row.region.size_m)}{cut}",
        "channels": [name for name, _ in row.channels],
        "size": row.region.size_m,
        "angle": row.region.angle_rad,
        "shape": row.shape,
    }


class NightActions(Actions):
    """The actions of one person on a recorded night."""

    def __init__(self, night: Night, who: str) -> None:
        self._night = night
        self._who = who

    def note(self, text: str, scan_ns: int | None = None, time_ns: int | None = None) -> ActionResult:
        """Append a note to the record, and write the report again if the run has one."""
        written_ns = ExperimentClock.real().now_ns()
        append_note(self._night.folder, self._who, text, written_ns, scan_ns, time_ns)
        self._night.reload()
        if (self._night.folder / REPORT_FILE).exists():
            write_report(self._night.folder)
        return ActionResult("Noted.")


class NightSteering(Steering):
    """An executor of night-page actions, one after the other."""

    def __init__(self, night: Night, access: Access, name: str) -> None:
        self._night = night
        self._access = access
        self._name = name
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="notes")
        self._log = logging.getLogger("afspm.plugins.web.dashboard")

    def do(self, visitor: Visitor, action: Action, *, urgent: bool = False) -> Future[ActionResult]:
        person = self._access.person_of(visitor)
        return self._thread.submit(self._note, f"{self._name}{PERSON}{person}", action) if person else not_signed_in()

    def close(self) -> None:
        self._thread.shutdown()

    def _note(self, who: str, action: Action) -> ActionResult:
        try:
            return action(NightActions(self._night, who))
        except AfspmError as error:
            return ActionResult(str(error), ok=False)


def difference(first: ChannelFrame, second: ChannelFrame, how: Levelling) -> tuple[ChannelFrame, str]:
    """Return second minus first as a frame at the place of the first, and a text about their alignment.

    Frames of equal size are aligned by registration. Both frames are levelled, and the median of the difference is set
    to zero. The difference is NaN where only one frame was measured.

    Raises:
        InvalidValue: the frames have different numbers of pixels or different units.
    """
    if first.values.shape != second.values.shape:
        (rows, columns), (others, along) = first.values.shape, second.values.shape
        raise InvalidValue(f"{columns} × {rows} and {along} × {others} pixels can't be subtracted")
    if first.unit != second.unit:
        raise InvalidValue(f"values in {first.unit or '1'} and {second.unit or '1'} can't be subtracted")
    before, after = levelled(first.values, how), levelled(second.values, how)
    aligned, words = onto_first(before, first.region, after, second.region)
    change = aligned - before
    if np.isfinite(change).any():
        change -= np.nanmedian(change)
    return replace(first, number=first.number ^ second.number, values=change), words
