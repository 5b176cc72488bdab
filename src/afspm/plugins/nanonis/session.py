"""Both connections to Nanonis: one for quick requests, one for blocking calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Thread
from typing import Any, ClassVar, Final

import numpy as np

from afspm.basics import AfspmError
from afspm.driver import ControllerLost, Driver, Receiver, TcpConnection
from afspm.plugins.nanonis import protocol
from afspm.plugins.nanonis.protocol import BadReply, NanonisError

MODULES: Final = {"IV": "BiasSpectr", "force": "ZSpectr"}
APPROACH: Final = "AutoApproach"
_WITHOUT_VERSION: Final = 10862
"""The release to assume if the software refuses Util.VersionGet, and can't report its release."""
_WAIT_MS: Final = 1000
_LONGEST_CURVE_S: Final = 24 * 3600.0
_HINTS: Final = (
    "is Nanonis running, with this port open (File > Settings Options > TCP Programming Interface)?",
    "Nanonis is silent while a dialog waits for an answer on its screen",
)


class Link:
    """A TCP connection to Nanonis; for arguments, see `TcpConnection`.

    Attributes:
        release: release of the controller's software, set once known.
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
            longer_s: additional wait for the answer, real time.

        Raises:
            NanonisError: Nanonis reports an error. InvalidValue: the arguments can't be sent.
            ControllerLost, BadReply: no answer, or a malformed answer; the connection is closed.
        """

        def read(receiver: Receiver) -> tuple[object, ...]:
            # A reply may exceed one segment of TCP, e.g. 128 names of signals, or a scan.
            size = protocol.body_bytes(bytes(receiver.exactly(protocol.HEADER_BYTES)), name)
            return protocol.results(name, receiver.exactly(size), self.release)

        return self._tcp.ask(name, protocol.request(name, arguments, self.release), read, longer_s=longer_s)


class Session:
    """Two connections to the same Nanonis, with the modules for spectra and approach open.

    Args:
        driver: driver that uses the connections.
        addresses: addresses of the first and the second connection; a single address serves both.
        timeout_s: longest wait for an answer, real time.
        release: release of the software; None: query Nanonis.

    Attributes:
        controller: name and release of the software, for people.
        opened: names of the opened modules; a module that was not purchased can't be opened.
        listener: thread that uses the second connection.

    Raises:
        ControllerLost: a connection can't be opened, or fails.
    """

    link: ClassVar[type[Link]] = Link

    def __init__(self, driver: Driver, addresses: list[tuple[str, int]], timeout_s: float, release: int | None) -> None:
        self._log = driver.log
        self._link = self.link(addresses[0], timeout_s, driver.clock.monotonic_s)
        self.ask = self._link.ask
        self._listener: Listener | None = None
        # each port of Nanonis serves one client, one call at a time: a blocking call needs a port of its own
        try:
            driver.prove()
            self.controller = f"Nanonis, release {release}"
            # The fields of requests and replies depend on the release.
            self._link.release = release or self._found_release()
            # The spectroscopy modules of the real software answer only after their Open.
            self.opened = {module for module in (*MODULES.values(), APPROACH) if self._open(module)}
            self._find_range()
            second = self.link(addresses[-1], timeout_s, driver.clock.monotonic_s, self._link.release)
            self._listener = self.listener = Listener(second, driver.wake)
            driver.prove()
        except AfspmError:
            self.close()
            raise

    def close(self) -> None:
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

    def _find_range(self) -> None:
        try:
            self.ask("Piezo.RangeGet")
        except NanonisError as error:
            text = (
                "Nanonis has no module Piezo, so positions of the probe will be refused, and no frame is compared with "
                "the scanner's range: %s"
            )
            self._log.warning(text, error)

    def _open(self, module: str) -> bool:
        try:
            self.ask(f"{module}.Open")
        except NanonisError as error:
            self._log.warning("the module %s of Nanonis is not available: %s", module, error)
            return False
        return True


@dataclass(frozen=True)
class ScanEnded:
    """The event that a scan was completed or stopped.

    Attributes:
        path: file path on Nanonis' computer; empty: not saved.
    """

    path: str


@dataclass(frozen=True)
class CurveEnded:
    """The event that a spectrum was completed or stopped.

    Attributes:
        names: channel names with units, "Current (A)".
        values: [channels, points], in these units.
    """

    names: tuple[str, ...]
    values: np.ndarray


ListenerEvent = ScanEnded | CurveEnded | AfspmError
"""An event of the second connection; an error means that its blocking call failed."""


class Listener:
    """A thread that makes blocking calls on the second connection, one at a time.

    Args:
        wake: called from that thread when `events` has new entries.

    Attributes:
        for_scan: whether the thread waits for the end of a scan, or is about to.
        for_curve: whether it waits for the end of a spectrum, or is about to.
    """

    def __init__(self, link: Link, wake: Callable[[], None]) -> None:
        self._link = link
        self._wake = wake
        self._jobs: SimpleQueue[Callable[[], ListenerEvent | None] | None] = SimpleQueue()
        self._events: SimpleQueue[ListenerEvent] = SimpleQueue()
        self.for_scan = self.for_curve = self._closed = False
        Thread(target=self._work, name="Nanonis' second connection", daemon=True).start()

    def scan(self) -> None:
        """Let the thread wait for the end of a scan, unless it already waits."""
        if not self.for_scan:
            self.for_scan = True
            self._jobs.put(self._next_end_of_scan)

    def curve(self, module: str, base_name: str) -> None:
        """Let the thread start a spectrum with a module, and wait for its data instead of the end of a scan."""
        self.for_scan, self.for_curve = False, True
        self._jobs.put(lambda: self._curve(module, base_name))

    def events(self) -> list[ListenerEvent]:
        """Return the events since the last call."""
        found = []
        while not self._events.empty():
            found.append(self._events.get())
        return found

    def close(self) -> None:
        """Close the connection, which ends the thread and its blocking call."""
        self._closed = True
        self._link.close()
        self._jobs.put(None)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None and not self._closed:
            result = self._done(job)
            if self._closed:
                return
            if result is not None:
                self._events.put(result)
                self._wake()
            if isinstance(result, ControllerLost):
                return

    def _done(self, job: Callable[[], ListenerEvent | None]) -> ListenerEvent | None:
        try:
            return job()
        except AfspmError as error:
            self.for_scan = False
            return error
        except Exception as error:  # a malformed reply can raise any error: the thread must report it, not die
            self.for_scan = False
            return BadReply(f"Nanonis sent an unreadable message on a measurement: {error!r}")

    def _next_end_of_scan(self) -> ListenerEvent | None:
        # Short waits in a loop: a dead connection is noticed, and a spectrum gets its turn.
        while self.for_scan and not self._closed:
            timed_out, path = self._link.ask("Scan.WaitEndOfScan", _WAIT_MS, longer_s=_WAIT_MS / 1000)
            if not timed_out:
                self.for_scan = False
                return ScanEnded(path)
        return None

    def _curve(self, module: str, base_name: str) -> ListenerEvent:
        with_data = 1
        # With data requested, Start replies at the end of the spectrum, and blocks this connection until then.
        try:
            names, values, _ = self._link.ask(f"{module}.Start", with_data, base_name, longer_s=_LONGEST_CURVE_S)
        finally:
            self.for_curve = False
        return CurveEnded(tuple(names), values)
