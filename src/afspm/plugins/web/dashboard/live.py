"""Handling of requests from the browser's scripts: live pictures, values, profiles.

The browser requests a picture after drawing the one before, and gets the newest. A slow browser skips pictures, and
does not delay this process.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from fastapi import Depends, FastAPI, Response
from fastapi.responses import PlainTextResponse

from afspm.drawing import DIVERGING, LEVELS, PALETTES, png, profile
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.dashboard.conditions import Conditions
from afspm.plugins.web.dashboard.pictures import Look, PictureCache, RenderedFrame, Thumbnails
from afspm.plugins.web.dashboard.scan_facts import Facts, began_ns, scan_facts
from afspm.plugins.web.frames import ChannelFrame, number_or_none
from afspm.plugins.web.watch import Bell, Watch

POLL_S = 20.0  # then the browser repeats its request: proxies may close a connection that is silent for longer
GROWING_S = 0.2  # between two pictures of a growing scan
FINISHED_S = 0.004  # between two pictures of finished scans, times the number of waiting viewers (at least ten)


@dataclass(frozen=True)
class PictureRequest:
    """The query of a request for a picture.

    Attributes:
        time: time of a finished scan, ns; 0: the newest scan.
        beside: time of another scan for comparison, ns: both get the same range of values; 0: none.
    """

    channel: str = ""
    time: int = 0
    beside: int = 0
    levelling: str = ""
    contrast: str = ""
    palette: str = ""


Asked = Annotated[PictureRequest, Depends()]


class Live:
    """The handler of requests from the browser's scripts.

    Args:
        archive: source of scans that are no longer in memory.
        conditions: parameters at the start of each scan.
    """

    def __init__(self, watch: Watch, bell: Bell, archive: Archive, conditions: Conditions) -> None:
        self._conditions = conditions
        self._watch = watch
        self._bell = bell
        self._archive = archive
        self._cache = PictureCache()
        self._thumbnails = Thumbnails(self._finished)
        self._waiting = 0
        self._closing = False

    def close(self) -> None:
        """Answer all pending requests for pictures, and make later requests return at once. Thread-safe."""
        self._closing = True
        self._bell.ring()

    def add_to(self, app: FastAPI) -> None:
        """Serve /live/image, /live/thumbnail, /live/value, /live/profile and /live/palette."""
        app.get("/live/thumbnail/{start}/{time}", response_model=None)(self._thumbnail)
        app.get("/live/palette/{name}.png", response_model=None)(self._palette)
        app.get("/live/image", response_model=None)(self._image)
        app.get("/live/value", response_model=None)(self._value)
        app.get("/live/profile", response_model=None)(self._profile)

    async def _image(self, asked: Asked, after: int = 0, patient: bool = True) -> Response:
        # a picture newer than number `after`, or of one finished scan; 204: nothing new yet
        if not asked.time and not await self._wait_for_newer(asked.channel, after, POLL_S if patient else 0.0):
            return Response(status_code=204)
        drawn = await asyncio.to_thread(self._drawn, asked)
        if drawn is None:
            return PlainTextResponse("the values of this scan are no longer kept here", 404)
        # facts in a header of the picture, so that both always belong together
        headers = {"X-Frame": drawn.head(self._facts(drawn.frame)), "Cache-Control": "no-store"}
        return Response(drawn.png, media_type="image/png", headers=headers)

    async def _value(self, asked: Asked, column: int, row: int) -> dict[str, object]:
        # the value of one pixel, as published and as levelled
        drawn = await asyncio.to_thread(self._drawn, asked)
        if drawn is None or not (0 <= row < drawn.values.shape[0] and 0 <= column < drawn.values.shape[1]):
            return {"value": None, "levelled": None, "unit": ""}
        return {
            "value": number_or_none(float(drawn.frame.values[row, column])),
            "levelled": number_or_none(float(drawn.values[row, column])),
            "unit": drawn.frame.unit,
            "number": drawn.frame.number,
        }

    async def _profile(self, asked: Asked, x0: float, y0: float, x1: float, y1: float) -> dict[str, object]:
        # levelled values along a line between two (column, row)
        drawn = await asyncio.to_thread(self._drawn, asked)
        if drawn is None:
            return {"distances_m": [], "values": [], "unit": ""}
        distances_m, values = profile(drawn.values, drawn.frame.region.size_m, (x0, y0), (x1, y1))
        return {
            "distances_m": distances_m.tolist(),
            "values": [number_or_none(value) for value in values.tolist()],
            "unit": drawn.frame.unit,
        }

    async def _thumbnail(self, start: str, time: int, channel: str) -> Response:
        # `start` differs with each start of the dashboard: the browser keeps pictures, and another simulated night may
        # have the same times
        found = await asyncio.to_thread(self._thumbnails.png, time, channel)
        if found is None:
            return PlainTextResponse("the values of this scan are no longer kept here", 404)
        headers = {"Cache-Control": "private, max-age=86400, immutable"}
        return Response(found, media_type="image/png", headers=headers)

    async def _palette(self, name: str) -> Response:
        # one pixel wide, the highest value on top
        if name not in (*PALETTES, DIVERGING):
            return Response(status_code=404)
        return Response(png(np.arange(LEVELS, dtype=np.uint8)[:, None], name), media_type="image/png")

    async def _wait_for_newer(self, channel: str, after: int, within_s: float) -> bool:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        end_s, growing_s = now_s + within_s, now_s + GROWING_S
        self._waiting += 1
        try:
            # with many viewers each gets fewer pictures, so that the experiment keeps its processor time
            finished_s = now_s + FINISHED_S * max(10, self._waiting)
            while True:
                number, complete = self._newest(channel)
                at_once = not after or not within_s  # who does not wait asks only when something is new
                due_s = now_s if at_once else finished_s if complete else growing_s
                now_s = loop.time()
                if number > after and now_s >= due_s:
                    return True
                if now_s >= end_s or self._closing:
                    return False
                await self._bell.wait((due_s if number > after else end_s) - now_s)
        finally:
            self._waiting -= 1

    def _newest(self, channel: str) -> tuple[int, bool]:
        with self._watch.reading():
            return self._watch.frames.newest_number(channel or None)

    def _drawn(self, asked: PictureRequest) -> RenderedFrame | None:
        if asked.time:
            frame = self._finished(asked.time, asked.channel)
        else:
            with self._watch.reading():
                frame = self._watch.frames.newest(asked.channel or None)
        look = Look.named(asked.levelling, asked.contrast, asked.palette)
        other = self._finished(asked.beside, asked.channel) if asked.beside else None
        return None if frame is None else self._cache.draw(frame, look, other)

    def _facts(self, frame: ChannelFrame) -> Facts:
        with self._watch.reading() as overview:
            conditions = self._conditions.at(began_ns(frame, overview))
            return scan_facts(frame, overview, conditions, self._watch.clock.now_ns(), self._watch.frames.roles)

    def _finished(self, time_ns: int, channel: str) -> ChannelFrame | None:
        with self._watch.reading():
            frame = self._watch.frames.kept(time_ns, channel)
        return frame or self._archive.frame(time_ns, channel)
