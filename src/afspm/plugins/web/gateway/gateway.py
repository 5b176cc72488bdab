"""`Gateway`: the component with which HTTP clients take part in an experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from afspm.basics import ConfigError, ExperimentClock, Listens
from afspm.model import Frame
from afspm.plugins.web.component import WebComponent
from afspm.plugins.web.passwords import Passwords, is_loopback
from afspm.plugins.web.watch import Bell
from afspm.record import experiment_name

MOST_REQUESTS = 200


class Gateway(WebComponent):
    """A JSON API over HTTP: state, parameters, scans, control, measurements, events.

    A client with a name acts as `<gateway>:<name>`, with the roles and limits of that name. Control has a lease, which
    the scheduler keeps: a client that vanishes loses control at the end of its lease. Other processes have priority for
    the processor.

    Args:
        host: the address to listen at. Any but a loopback address needs `people` and a certificate.
        port: 0 for any free port; None: 8090, or any if 8090 is taken. A restart uses the same port.
        people: names that may command: the hash of each token, as `afspm dashboard --make-password` prints it. Without
            `people`, every name is accepted, but only from this computer.
        certificate, certificate_key: PEM files, for https.
        origins: origins of other pages that may send requests, e.g. "http://localhost:3000"; by default none.

    Raises:
        ConfigError: other computers could come in without a token, or listen in; or the port is taken.
    """

    served = "gateway"
    usual_port = 8090
    requires = ("afspm[gateway]",)

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: Annotated[int | None, Listens(host="host", keyed=False)] = None,
        people: Mapping[str, str] | None = None,
        certificate: Path | None = None,
        certificate_key: Path | None = None,
        origins: Sequence[str] = (),
    ) -> None:
        super().__init__(host, port, certificate, certificate_key)
        if not is_loopback(host) and not (people and certificate):
            raise ConfigError(
                f"at {host} other computers can reach the gateway: it needs people, certificate and certificate_key",
                where="gateway",
                hint="`afspm dashboard --make-password` makes a line of people; or listen on 127.0.0.1",
            )
        # "*" lets every page in, and "null" is the origin of any local file or sandboxed frame
        if any(one in ("*", "null") for one in origins):
            raise ConfigError("origins names pages one by one", where="gateway", hint='e.g. ["http://localhost:3000"]')
        self._passwords = Passwords(host, "", people or {}, ExperimentClock.real().now_s)
        self._origins = tuple(origins)

    def on_start(self) -> None:
        # imported here: a file is checked also where the extra `gateway` is not installed
        from afspm.plugins.web.gateway.application import application
        from afspm.plugins.web.gateway.events import EventHistory, fill
        from afspm.plugins.web.gateway.measurements import Measurements
        from afspm.plugins.web.gateway.services import GatewayServices
        from afspm.plugins.web.persons import Persons

        launch, problems = self._context.launch, self._context.problems
        bound = self.open_port()
        archive, watch = self.watch_run()
        self._watch = watch
        bell = Bell()
        watch.on_change(bell.ring)
        self._history = EventHistory(problems)
        fill(self._history, self.run_dir, Path(launch.state_dir) if launch.state_dir else None, self.clock.now_ns())
        self._measurements = Measurements(self.state_file("measurements.json"), watch, self.clock.monotonic_s)
        self._persons = Persons(launch, self.clock, watch)
        services = GatewayServices(
            watch, bell, archive, self._history, self._measurements, self._persons,
            experiment_name(self.run_dir, "afspm"), self.simulated,
            Frame.SAMPLE if launch.sample_coordinates else Frame.TIP,
        )  # fmt: skip
        app = application(services, self._passwords, host=self._host, origins=self._origins)
        self.serve(app, bound, most_requests=MOST_REQUESTS)

    def on_message(self, envelope: str, message: object) -> None:
        time_ns = self.packet_time_ns()
        name = envelope.partition("_")[0]
        self._measurements.on_packet(message, time_ns)
        self._history.take(name, message, time_ns)
        self._watch.take(name, message, time_ns, envelope)  # last: the watch wakes waiting requests

    def on_end(self) -> None:
        if self._server is not None:
            self._watch.end()
            self._persons.close()
            self._server.stop()
