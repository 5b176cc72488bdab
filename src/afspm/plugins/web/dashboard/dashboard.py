"""`Dashboard`: the component with the page of an experiment, for watching and steering."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from afspm.basics import ExperimentClock, Listens
from afspm.plugins.web.archive import adjustable_parameters, agents_in, allowed_region
from afspm.plugins.web.component import WebComponent
from afspm.plugins.web.dashboard.access import Access
from afspm.plugins.web.dashboard.sessions import Sessions
from afspm.plugins.web.passwords import is_loopback
from afspm.plugins.web.server import USUAL_PORT
from afspm.plugins.web.watch import Audience
from afspm.record import bands_allowed, experiment_name

END_SHOWN_WITHIN_S = 1.5  # time for the pages to show the end


class Dashboard(WebComponent):
    """The page of an experiment. Persons steer through the scheduler, each under their own name.

    Other processes have priority for the processor.

    Args:
        host: the address to listen at. Any but a loopback address needs a password.
        port: 0 for any free port; None: 8080, or any if 8080 is taken. A restart uses the same port.
        people: persons who may steer: the hash of each password, as `afspm dashboard --make-password` prints it.
        password_hash: hash of a common password for viewers who only look. The password itself may be in the
            environment: AFSPM_DASHBOARD_PASSWORD.
        certificate, certificate_key: PEM files, for https.

    Raises:
        ConfigError: other computers could come in without a password, or the port is taken.
    """

    served = "dashboard"
    usual_port = USUAL_PORT
    operates = True
    requires = ("afspm[dashboard]",)

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: Annotated[int | None, Listens(host="host", keyed=False)] = None,
        people: Mapping[str, str] | None = None,
        password_hash: str = "",
        certificate: Path | None = None,
        certificate_key: Path | None = None,
    ) -> None:
        super().__init__(host, port, certificate, certificate_key)
        self._people, self._password_hash = dict(people or {}), password_hash

    def on_start(self) -> None:
        # imported here: a file is checked also where the extra `dashboard` is not installed
        from afspm.plugins.web.dashboard.actions import Steering
        from afspm.plugins.web.dashboard.application import application
        from afspm.plugins.web.dashboard.conditions import Conditions
        from afspm.plugins.web.dashboard.content import Contents
        from afspm.plugins.web.dashboard.page import Services
        from afspm.plugins.web.persons import Persons

        now_s = ExperimentClock.real().now_s
        access = Access(
            self._host, self._password_hash, self._people, now_s, Sessions(self.state_file("sessions"), now_s)
        )
        bound = self.open_port()
        archive, self._watch = self.watch_run()
        self._steering = Steering(Persons(self._context.launch, self.clock, self._watch), self._watch, access)
        services = Services(
            self._watch,
            Contents(
                self._watch,
                allowed_region(self.run_dir),
                adjustable_parameters(self.run_dir),
                f"live/thumbnail/{secrets.token_hex(4)}",
                bands_allowed(self.run_dir),
                agents_in(self.run_dir),
            ),
            self._steering,
            Audience(),
            access,
            experiment_name(self.run_dir, "afspm"),
            self.simulated,
            Conditions(self._watch, self._steering.read),
            self.run_dir,
        )
        app, self._wait_for_end_shown = application(services, archive, host=self._host, encrypted=self.encrypted)
        self.serve(app, bound)
        if not self.encrypted and not is_loopback(self._host):
            self.log.warning(
                "other computers can reach the dashboard without encryption: set certificate and certificate_key"
            )

    def on_message(self, envelope: str, message: object) -> None:
        self._watch.take(envelope.partition("_")[0], message, self.packet_time_ns(), envelope)

    def on_end(self) -> None:
        if self._server is None:
            return
        self._watch.end()
        self._wait_for_end_shown(END_SHOWN_WITHIN_S)
        self._steering.close()
        self._server.stop()
