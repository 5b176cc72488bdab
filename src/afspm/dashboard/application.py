"""The web application: NiceGUI's page, what it fetches by itself, the entrance, and the guard before all of it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.dashboard.access import Access, Visitor, is_loopback
from afspm.dashboard.audience import Audience
from afspm.dashboard.bell import Bell
from afspm.dashboard.content import Contents
from afspm.dashboard.entrance import add_entrance
from afspm.dashboard.guard import VISITOR, App, Guard
from afspm.dashboard.live import Live
from afspm.dashboard.record import Archive
from afspm.dashboard.steering import Steering
from afspm.dashboard.watch import Watch
from afspm.model import Region

if TYPE_CHECKING:
    from fastapi import FastAPI

ASSETS = Path(__file__).with_name("assets")


def application(
    watch: Watch,
    steering: Steering,
    access: Access,
    archive: Archive,
    *,
    title: str,
    limits: Region | None,
    simulated: bool,
    host: str,
    encrypted: bool,
) -> tuple[App, Callable[[float], bool]]:
    """The application, once a process; and what waits, so many seconds, until all pages have been told of the end."""
    from fastapi import FastAPI
    from fastapi.staticfiles import StaticFiles
    from nicegui import app as nicegui
    from nicegui import ui

    from afspm.dashboard.page import Page, Services

    bell = Bell()
    watch.on_change(bell.ring)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI):  # type: ignore[no-untyped-def]  # an async iterator that starlette knows
        bell.hang_up()
        yield

    app = FastAPI(lifespan=lifespan, openapi_url=None)
    add_entrance(app, access, title, encrypted=encrypted, only_here=is_loopback(host))
    live = Live(watch, bell, archive)
    live.add_to(app)
    app.mount("/assets", StaticFiles(directory=ASSETS))
    audience = Audience()
    services = Services(watch, Contents(watch, limits), steering, audience, access, title, simulated)

    def page() -> None:
        request = ui.context.client.request
        Page(services, getattr(request.state, VISITOR, Visitor()))

    nicegui.on_exception(_tell)
    ui.run_with(app, root=page, title=title, show_welcome_message=False, tailwind=False, reconnect_timeout=10.0)

    def farewell(within_s: float) -> bool:
        told = audience.wait_told(within_s)
        live.close()
        return told

    return Guard(app, access, host), farewell


def _tell(error: Exception) -> None:
    """What goes wrong on a page is no reason to end."""
    logging.getLogger("afspm.dashboard").error("the page has an error", exc_info=error)
