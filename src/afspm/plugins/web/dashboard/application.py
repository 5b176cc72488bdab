"""The web application: NiceGUI's page, the requests of its scripts, the sign-in page, and the guard before them."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import AsyncIterator, Callable

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles
from nicegui import app as nicegui
from nicegui import ui

from afspm.basics import Clock
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.asgi import AsgiApp
from afspm.plugins.web.dashboard.access import Visitor
from afspm.plugins.web.dashboard.live import Live
from afspm.plugins.web.dashboard.page import ASSETS, Page, Services
from afspm.plugins.web.dashboard.sign_in import VISITOR, Guard, add_sign_in
from afspm.plugins.web.passwords import is_loopback
from afspm.plugins.web.watch import Bell
from afspm.transport import RateLimitedLog


def application(
    services: Services,
    archive: Archive,
    *,
    host: str,
    encrypted: bool,
    page: Callable[[Services, Visitor], object] = Page,
    more: Callable[[FastAPI], None] = lambda _: None,
) -> tuple[AsgiApp, Callable[[float], None]]:
    """Return the web application (one per process), and a function that waits until all pages show the end.

    Args:
        page: creates the page of a viewer.
        more: adds further routes.
    """
    bell, access, title = Bell(), services.access, services.title
    services.watch.on_change(bell.ring)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        bell.attach()
        yield

    app = FastAPI(lifespan=lifespan, openapi_url=None)
    add_sign_in(app, access, title, encrypted=encrypted, only_here=is_loopback(host))
    live = Live(services.watch, bell, archive, services.conditions)
    live.add_to(app)
    more(app)
    app.mount("/assets", StaticFiles(directory=ASSETS))

    def root() -> None:
        request = ui.context.client.request
        page(services, getattr(request.state, VISITOR, Visitor()))

    nicegui.on_exception(_log_error)
    complaints = MessageComplaints(services.watch.clock)
    for name in ("engineio.server", "asyncio"):
        logging.getLogger(name).addFilter(complaints)
    ui.run_with(app, root=root, title=title, show_welcome_message=False, tailwind=False, reconnect_timeout=10.0)

    def wait_until_end_shown(within_s: float) -> None:
        services.audience.wait_until_end_shown(within_s)
        live.close()

    return Guard(app, access, host), wait_until_end_shown


def _log_error(error: Exception) -> None:
    # an error of one page is no reason to end the others
    logging.getLogger("afspm.plugins.web.dashboard").error("the page has an error", exc_info=error)


class MessageComplaints(logging.Filter):
    """A filter that logs the libraries' tracebacks of messages from browsers as one line each, and only counts a flood.

    Any visitor may send what no page sends, as lists that are nested too deep.
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._log = RateLimitedLog(logging.getLogger("afspm.plugins.web.dashboard"), clock)

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is logged as it is."""
        error = record.exc_info[1] if record.exc_info else None
        if error is None or (record.name == "asyncio" and "AsyncServer._handle_event" not in record.getMessage()):
            return True
        self._log.warning(f"a message from a browser can't be processed: {error!r:.200}")
        return False
