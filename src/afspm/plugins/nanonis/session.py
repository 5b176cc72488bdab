"""Both connections to Nanonis: one for questions that are answered at once, one for calls that take their time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

import numpy as np

from afspm.basics.errors import AfspmError
from afspm.plugins.nanonis import protocol
from afspm.plugins.nanonis.protocol import BadReply, NanonisError
from afspm.translator.driver import Driver
from afspm.translator.driver_base import ControllerLost
from afspm.translator.tcp import Receiver, TcpConnection

MODULES: Final = {"IV": "BiasSpectr", "force": "ZSpectr"}
APPROACH: Final = "AutoApproach"
_WITHOUT_VERSION: Final = 10862
"""The release to take where the software can't tell its own."""
_WAIT_MS: Final = 1000
_LONGEST_CURVE_S: Final = 24 * 3600.0
_HINTS: Final = (
    "is Nanonis running, with its TCP programming interface on this port (File > Settings > TCP)?",
    "Nanonis is silent while a dialog waits for an answer on its screen",
)


class Link:
    """A connection to Nanonis; the arguments are those of `TcpConnection`.

    Attributes:
        release: of the controller's software; it can be changed once it is known.
    """

    def __init__(
        self,
        address: tuple[str, int],
        timeout_s: float,
        monotonic_s: Callable[[], float],
        release: int = protocol.NEWEST,
    ) -> None:
        self.release = release
        self._tcp = TcpConnection(address, timeout_s, monotonic_s, _HINTS)
        self.close = self._tcp.close

    def ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[Any, ...]:
        """Call a function of Nanonis.

        Args:
            longer_s: so much longer than usual may the answer take.

        Raises:
            NanonisError: it could not do it. InvalidValue: what was asked can't be sent.
            ControllerLost, BadReply: no answer, or none to be trusted; the connection is closed.
        """

        def read(receiver: Receiver) -> tuple[object, ...]:
            size = protocol.body_bytes(bytes(receiver.exactly(protocol.HEADER_BYTES)), name)
            return protocol.results(name, receiver.exactly(size), self.release)

        return self._tcp.ask(name, protocol.request(name, arguments, self.release), read, longer_s=longer_s)


class Session:
    """Two connections to Nanonis, proved and with all modules open.

    Args:
        driver: that they are for.
        addresses: of both; the same one only where a port serves several clients.
        timeout_s: for an answer, in real time.
        release: None: Nanonis is asked for it.

    Attributes:
        controller: its name and version, for a person.
        opened: the modules that can be used: Nanonis has those that were bought, and they answer once they are open.
        listener: on the second connection.

    Raises:
        ControllerLost.
    """

    def __init__(self, driver: Driver, addresses: list[tuple[str, int]], timeout_s: float, release: int | None) -> None:
        self._log = driver.log
        self._link = Link(addresses[0], timeout_s, driver.clock.monotonic_s)
        self.ask = self._link.ask
        self._listener: Listener | None = None
        try:
            driver.prove()
            self.controller = f"Nanonis, release {release}"
            self._link.release = release or self._found_release()
            self.opened = {module for module in (*MODULES.values(), APPROACH) if self._open(module)}
            second = Link(addresses[-1], timeout_s, driver.clock.monotonic_s, self._link.release)
            self._listener = self.listener = Listener(second, driver.wake)
            driver.prove()
        except AfspmError:
            self.close()
            raise

    def close(self) -> None:
        """End both connections."""
        if self._listener is not None:
            self._listener.close()
        self._link.close()

    def _found_release(self) -> int:
        try:
            product, version, host_release, engine_release = self.ask("Util.VersionGet")
        except NanonisError:
            self.controller = f"Nanonis, assumed to be release {_WITHOUT_VERSION}"
            self._log.warning("Nanonis does not report its release; assuming %d (or set release)", _WITHOUT_VERSION)
            return _WITHOUT_VERSION
        self.controller = f"{product} {version}, release {host_release}"
        self._log.info("%s (real-time engine %d)", self.controller, engine_release)
        return int(host_release)

    def _open(self, module: str) -> bool:
        try:
            self.ask(f"{module}.Open")
        except NanonisError as error:
            self._log.warning("the module %s of Nanonis is not available: %s", module, error)
            return False
        return True


@dataclass(frozen=True)
class ScanEnded:
    """A scan came to its end, or was broken off.

    Attributes:
        path: where Nanonis saved it, as its own computer calls it; empty if it did not.
    """

    path: str


@dataclass(frozen=True)
class CurveEnded:
    """A spectrum came to its end.

    Attributes:
        names: of the channels, with units.
        values: [channels, points].
    """

    names: tuple[str, ...]
    values: np.ndarray


Heard = ScanEnded | CurveEnded | AfspmError
"""An error: what was waited for can't be waited for."""


class Listener:
    """Waits in a thread of its own for one thing at a time, on the second connection.

    Args:
        wake: called from that thread when there is something in `heard`.
    """

    def __init__(self, link: Link, wake: Callable[[], None]) -> None:
        self._link = link
        self._wake = wake
        self._jobs: SimpleQueue[Callable[[], Heard | None] | None] = SimpleQueue()
        self._heard: SimpleQueue[Heard] = SimpleQueue()
        self._for_scan = self._closed = False
        Thread(target=self._work, name="Nanonis' second connection", daemon=True).start()

    def scan(self) -> None:
        """Wait for the end of a scan, if that is not being done already."""
        if not self._for_scan:
            self._for_scan = True
            self._jobs.put(self._next_end_of_scan)

    def curve(self, module: str, base_name: str) -> None:
        """Take a spectrum with a module and wait for its data."""
        self._for_scan = False
        self._jobs.put(lambda: self._curve(module, base_name))

    def heard(self) -> list[Heard]:
        """Return what has come since the last time."""
        found = []
        while not self._heard.empty():
            found.append(self._heard.get())
        return found

    def close(self) -> None:
        """End the thread, whatever it waits for."""
        self._closed = True
        self._link.close()
        self._jobs.put(None)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None and not self._closed:
            result = self._done(job)
            if self._closed:
                return
            if result is not None:
                self._heard.put(result)
                self._wake()
            if isinstance(result, ControllerLost):
                return

    def _done(self, job: Callable[[], Heard | None]) -> Heard | None:
        try:
            return job()
        except AfspmError as error:
            self._for_scan = False
            return error
        except Exception as error:  # whatever it says, this connection goes on being listened to, or is made anew
            self._for_scan = False
            return BadReply(f"Nanonis sent an unreadable message on a measurement: {error!r}")

    def _next_end_of_scan(self) -> Heard | None:
        """Ask again and again: so a connection that has died is noticed, and a spectrum gets its turn."""
        while self._for_scan and not self._closed:
            timed_out, path = self._link.ask("Scan.WaitEndOfScan", _WAIT_MS, longer_s=_WAIT_MS / 1000)
            if not timed_out:
                self._for_scan = False
                return ScanEnded(path)
        return None

    def _curve(self, module: str, base_name: str) -> Heard:
        with_data = 1
        names, values, _ = self._link.ask(f"{module}.Start", with_data, base_name, longer_s=_LONGEST_CURVE_S)
        return CurveEnded(tuple(names), values)
