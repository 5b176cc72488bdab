"""`python -m afspm.plugins.web.dashboard.recorded`: server of the page of a recorded night, until Ctrl-C.

The page reads only the run folder. A component kept alive after the end would hold the lock of a run that is over, and
a replay to a live dashboard has one moment for all viewers and can't go back. Here each viewer has a moment.

The page needs a separate process, because a process can hold only one NiceGUI application. The settings are read as one
line of JSON from standard input; the page ends when standard input is closed.
"""

from __future__ import annotations

import json
import secrets
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from afspm import Memory
from afspm.basics import AfspmError, ExperimentClock, FileError
from afspm.plugins.web.archive import Archive, allowed_region
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.dashboard.sessions import Sessions
from afspm.plugins.web.server import USUAL_PORT, WebServer, listening, url_of
from afspm.record import STATE_DIR


@dataclass(frozen=True)
class RecordedSettings:
    """The settings of the page of a recorded night; see `Dashboard`.

    Attributes:
        folder: the run folder.
        name: name of the dashboard's component; the page takes over its port and sessions.
    """

    folder: str
    name: str
    host: str = "127.0.0.1"
    port: int | None = None
    people: dict[str, str] = field(default_factory=dict)
    password_hash: str = ""
    certificate: str | None = None
    certificate_key: str | None = None

    def to_json(self) -> str:
        return json.dumps(asdict(self))


def serve(settings: RecordedSettings, tell: Callable[[str], object], stopped: threading.Event | None = None) -> None:
    """Serve the page until Ctrl-C, or until `stopped` is set.

    Raises:
        FileError: the record is missing or damaged.
        ConfigError: the address can't be used, or other computers could come in without a password.
    """
    from afspm.plugins.web.dashboard.application import application
    from afspm.plugins.web.dashboard.conditions import Conditions
    from afspm.plugins.web.dashboard.content import Contents
    from afspm.plugins.web.dashboard.night import Night, NightWatch
    from afspm.plugins.web.dashboard.night_page import NightPage, NightRequests, NightSteering
    from afspm.plugins.web.dashboard.page import Services
    from afspm.plugins.web.watch import Audience

    night = Night(Path(settings.folder))
    state = night.folder / STATE_DIR
    now_s = ExperimentClock.real().now_s
    kept = state / f"{settings.name}.sessions" if state.is_dir() else None
    access = Access(settings.host, settings.password_hash, settings.people, now_s, Sessions(kept, now_s))
    usual = () if settings.port == 0 else (USUAL_PORT,)
    bound = listening(settings.host, settings.port or None, (*_port_before(state, settings.name), *usual))
    watch, archive = NightWatch(night), Archive(night.folder)
    steering = NightSteering(night, access, settings.name)
    pictures = f"live/thumbnail/{secrets.token_hex(4)}"
    services = Services(
        watch, Contents(watch, allowed_region(night.folder), pictures=pictures), steering, Audience(), access,
        night.title, night.simulated, Conditions(watch, partial(steering.do, Visitor())), night.folder,
    )  # fmt: skip
    encrypted = settings.certificate is not None
    app, wait_until_end_shown = application(
        services, archive, host=settings.host, encrypted=encrypted,
        page=partial(NightPage, night, pictures), more=NightRequests(night, archive).add_to,
    )  # fmt: skip
    certificate, key = (None if one is None else Path(one) for one in (settings.certificate, settings.certificate_key))
    server = WebServer(app, bound, certificate, key)
    stopped = stopped or threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    server.start()
    url = url_of(settings.host, bound.getsockname()[1], encrypted=encrypted)
    tell(f"the dashboard is at {url}; press Ctrl-C to close it")
    while not stopped.wait(1.0):  # on Windows a signal does not end a wait without a limit
        pass
    wait_until_end_shown(0.0)
    steering.close()
    server.stop()


def _port_before(state: Path, name: str) -> tuple[int, ...]:
    # an open browser looks for the page at the port of the running experiment
    try:
        port = Memory(state / f"{name}.json").get("port")
    except FileError:
        return ()
    return (port,) if isinstance(port, int) else ()


def _main() -> None:
    settings = RecordedSettings(**json.loads(sys.stdin.readline()))
    stopped = threading.Event()

    def watch_parent() -> None:
        sys.stdin.read()
        stopped.set()

    threading.Thread(target=watch_parent, daemon=True).start()
    serve(settings, lambda text: sys.stdout.write(f"{text}\n") and sys.stdout.flush(), stopped)


if __name__ == "__main__":
    try:
        _main()
    except AfspmError as error:
        sys.exit(str(error))
