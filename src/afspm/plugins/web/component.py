"""`WebComponent`: a component with a web server for pages or an API."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from afspm import Component
from afspm.basics import NS_PER_S, ConfigError
from afspm.night import plans_of
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.server import STALLED_S, WebServer, listening, url_of
from afspm.plugins.web.watch import Watch
from afspm.record import bands_allowed, cut_off_message, run_json_or_empty
from afspm.transport import step_back

if TYPE_CHECKING:
    import socket

    from afspm.plugins.web.asgi import AsgiApp
    from afspm.transport import ProcessContext


class WebComponent(Component):
    """A component that stores published messages and serves them, at low processor priority.

    Attributes:
        served: name of the server, in log lines and errors.
        usual_port: port if the setting `port` is None.
        stalled_s: see `WebServer`.

    Args:
        host: the address to listen at.
        port: 0 for any free port; None: `usual_port`, or any if `usual_port` is taken. A restart uses the same port
            again, if it is free.
        certificate, certificate_key: PEM files, for https.

    Raises:
        ConfigError: a certificate without its key, or a key without its certificate.
    """

    served: ClassVar[str]
    usual_port: ClassVar[int]
    has_people = True
    listens = ("",)
    stalled_s: ClassVar[float] = STALLED_S
    longest_step_s = 60.0  # on a busy computer the first import takes long

    def __init__(self, host: str, port: int | None, certificate: Path | None, certificate_key: Path | None) -> None:
        if (certificate is None) != (certificate_key is None):
            raise ConfigError("certificate and certificate_key belong together", where=self.served)
        self._host, self._port = host, port
        self._certificate = None if certificate is None else Path(certificate)
        self._certificate_key = None if certificate_key is None else Path(certificate_key)
        self._server: WebServer | None = None

    @property
    def encrypted(self) -> bool:
        return self._certificate is not None

    def run_process(self, context: ProcessContext) -> int:
        step_back()
        self._context = context
        return super().run_process(context)

    def state_file(self, ending: str) -> Path | None:
        """Return the file of this component in the state folder; None without a state folder."""
        folder = self._context.launch.state_dir
        return Path(folder) / f"{self.name}.{ending}" if folder else None

    def open_port(self) -> socket.socket:
        """Return the listening socket: at the set port, else at the port of the last start if that port is free."""
        before = self.memory.get("port")
        earlier = (before,) if isinstance(before, int) else ()
        usual = earlier if self._port == 0 else (*earlier, self.usual_port)
        return listening(self._host, self._port or None, usual, what=self.served)

    def watch_run(self) -> tuple[Archive, Watch]:
        """Return the record of the run so far, and the `Watch` that receives later messages."""
        archive = Archive(self.run_dir if self._context.launch.run_dir else None)
        problems = self._context.problems
        launch = self._context.launch
        watch = Watch(
            self.clock, problems, archive.past(problems), lambda: cut_off_message(self.run_dir),
            plans=plans_of(run_json_or_empty(self.run_dir)) if launch.run_dir else None,
            began_ns=round(float(launch.clock["start_s"]) * NS_PER_S) if launch.clock else None,
            bands=bands_allowed(self.run_dir) if launch.run_dir else None,
        )  # fmt: skip
        return archive, watch

    def serve(self, app: AsgiApp, bound: socket.socket, *, most_requests: int | None = None) -> None:
        """Start the server, and store its port and URL in the component's memory."""
        self._server = WebServer(
            app, bound, self._certificate, self._certificate_key,
            most_requests=most_requests, stalled_s=self.stalled_s,
        )  # fmt: skip
        self._server.start()
        port = bound.getsockname()[1]
        url = url_of(self._host, port, encrypted=self.encrypted)
        self.memory.update({"port": port, "url": url})
        self.memory.save()
        self.log.info("the %s is at %s", self.served, url)

    def packet_time_ns(self) -> int:
        """Return the publication time of the current message; the present time if the packet has none."""
        return self.packet.time_ns if self.packet and self.packet.time_ns is not None else self.clock.now_ns()
