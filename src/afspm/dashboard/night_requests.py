"""Requests of the scripts of a recorded night: its scans, the difference of two, its report."""

from __future__ import annotations

import asyncio
import json
from datetime import datetime

from fastapi import FastAPI, Response
from fastapi.responses import FileResponse, PlainTextResponse

from afspm.clock import NS_PER_S
from afspm.dashboard.comparison import difference
from afspm.dashboard.night import Night
from afspm.dashboard.pictures import Look, RenderedFrame
from afspm.drawing.levelling import Levelling
from afspm.drawing.palette import DIVERGING
from afspm.drawing.raster import ValueRange, indices, png, value_range
from afspm.errors import InvalidValue
from afspm.formatting import time_of_day, typeset_area
from afspm.plain_data import Plain
from afspm.record.report import REPORT_FILE
from afspm.record.tables import ScanRow
from afspm.web.archive import Archive


class NightRequests:
    """Answers what only the page of a recorded night asks for."""

    def __init__(self, night: Night, archive: Archive) -> None:
        self._night = night
        self._archive = archive

    def add_to(self, app: FastAPI) -> None:
        """Serve /night/scans, /night/difference and /night/report."""
        app.get("/night/scans", response_model=None)(self._scans)
        app.get("/night/difference", response_model=None)(self._difference)
        app.get("/night/report", response_model=None)(self._report)

    async def _scans(self) -> Plain:
        """Answer with the ends of the night, its scans and notes. Times are texts: JSON has no numbers of 64 bits."""
        night = self._night
        drifted = night.drifted()
        offset = datetime.fromtimestamp(night.end_ns / NS_PER_S).astimezone().utcoffset()
        published_ns = night.published_ns()
        scans = [_scan(row) for row in night.scans if row.region is not None and row.shape is not None]
        for scan in scans:
            scan["seen"] = str(published_ns.get(int(scan["time"]), scan["time"]))
            if (places := drifted.get(scan["number"])) is not None:
                scan |= {"tip": places.tip_m, "sample": places.sample_m}
        return {
            "begin": str(night.begin_ns),
            "end": str(night.end_ns),
            "offset_s": offset.total_seconds() if offset is not None else 0.0,
            "scans": scans,
            "notes": [
                {"time": str(one.time_ns), "text": one.thing.text} for one in night.events if one.message == "Note"
            ],
        }

    async def _difference(self, first: int, second: int, channel: str, levelling: str = "plane") -> Response:
        """Answer with second minus first as a picture, and in its head how they were laid over each other."""
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
        """Answer with the report of the night."""
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
