"""`Dashboard`: the component that shows an experiment in the browser, and steers it."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from afspm.addresses import Listens
from afspm.client.component import Component
from afspm.clock import ExperimentClock
from afspm.dashboard.access import Access
from afspm.dashboard.sessions import Sessions
from afspm.errors import ConfigError
from afspm.process.priority import step_back
from afspm.record.run_json import experiment_name
from afspm.record.run_lock import cut_off_message
from afspm.web.archive import Archive, adjustable_parameters, allowed_region
from afspm.web.passwords import is_loopback
from afspm.web.server import USUAL_PORT, WebServer, listening, url_of
from afspm.web.watch import Audience, Watch

if TYPE_CHECKING:
    from afspm.process.context import ProcessContext

TOLD_WITHIN_S = 1.5  # how long the pages may take to be told of the end


class Dashboard(Component):
    """Serves one page. It only subscribes, and asks through the scheduler in the names of persons; all others have the
    processor first.

    Args:
        host: the address to listen at. At any other than this computer's own a password is needed.
        port: 0 for any that is free; None: 8080, or any if that is taken. A restart takes the same one.
        people: who may steer: the hash of each person's password, as `afspm dashboard --make-password` prints it.
        password_hash: of a common password, with which one may look. The password itself may be in the environment:
            AFSPM_DASHBOARD_PASSWORD.
        certificate, certificate_key: PEM files, for https.

    Raises:
        ConfigError: others could come in without a password, the port is taken …
    """

    operates = True
    has_people = True
    requires = ("afspm[dashboard]",)
    listens = ("",)
    longest_step_s = 60.0  # the first import of everything, on a busy computer

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: Annotated[int | None, Listens(host="host", keyed=False)] = None,
        people: Mapping[str, str] | None = None,
        password_hash: str = "",
        certificate: Path | None = None,
        certificate_key: Path | None = None,
    ) -> None:
        if (certificate is None) != (certificate_key is None):
            raise ConfigError("certificate and certificate_key belong together", where="dashboard")
        self._host, self._port = host, port
        self._people, self._password_hash = dict(people or {}), password_hash
        self._certificate = None if certificate is None else Path(certificate)
        self._certificate_key = None if certificate_key is None else Path(certificate_key)
        self._server: WebServer | None = None

    def run_process(self, context: ProcessContext) -> int:
        step_back()
        self._context = context
        return super().run_process(context)

    def on_start(self) -> None:
        from afspm.dashboard.actions import Steering
        from afspm.dashboard.application import application
        from afspm.dashboard.conditions import Conditions
        from afspm.dashboard.content import Contents
        from afspm.dashboard.page import Services
        from afspm.web.persons import Persons

        launch = self._context.launch
        state_dir = Path(launch.state_dir) if launch.state_dir else None
        now_s = ExperimentClock.real().now_s
        sessions = Sessions(state_dir / f"{self.name}.sessions" if state_dir else None, now_s)
        access = Access(self._host, self._password_hash, self._people, now_s, sessions)
        bound = listening(self._host, self._port or None, self._usual_ports())
        archive = Archive(self.run_dir if launch.run_dir else None)
        problems = self._context.problems
        self._watch = Watch(self.clock, problems, archive.past(problems), lambda: cut_off_message(self.run_dir))
        self._steering = Steering(Persons(launch, self.clock, self._watch), self._watch, access)
        services = Services(
            self._watch,
            Contents(
                self._watch,
                allowed_region(self.run_dir),
                adjustable_parameters(self.run_dir),
                f"/live/thumbnail/{secrets.token_hex(4)}",
            ),
            self._steering,
            Audience(),
            access,
            experiment_name(self.run_dir, "afspm"),
            self.simulated,
            Conditions(self._watch, self._steering.read),
        )
        encrypted = self._certificate is not None
        app, self._wait_told = application(services, archive, host=self._host, encrypted=encrypted)
        self._server = WebServer(app, bound, self._certificate, self._certificate_key)
        self._server.start()
        self._say_where(bound.getsockname()[1])

    def on_message(self, envelope: str, message: object) -> None:
        time_ns = self.packet.time_ns if self.packet and self.packet.time_ns is not None else self.clock.now_ns()
        self._watch.take(envelope.partition("_")[0], message, time_ns, envelope)

    def on_end(self) -> None:
        if self._server is None:
            return
        self._watch.end()
        self._wait_told(TOLD_WITHIN_S)
        self._steering.close()
        self._server.stop()

    def _usual_ports(self) -> tuple[int, ...]:
        """Return the port of the last start, where the page in a browser looks for us."""
        before = self.memory.get("port")
        earlier = (before,) if isinstance(before, int) else ()
        return earlier if self._port == 0 else (*earlier, USUAL_PORT)

    def _say_where(self, port: int) -> None:
        url = url_of(self._host, port, encrypted=self._certificate is not None)
        self.memory.update({"port": port, "url": url})
        self.memory.save()
        self.log.info("the dashboard is at %s", url)
        if self._certificate is None and not is_loopback(self._host):
            self.log.warning(
                "other computers can reach the dashboard without encryption: set certificate and certificate_key"
            )
