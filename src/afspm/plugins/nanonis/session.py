"""The connections to Nanonis: one for quick requests, one for blocking calls, and one for withdrawing the tip."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from threading import Thread
from typing import Any, ClassVar, Final

import numpy as np

from afspm.basics import AfspmError
from afspm.driver import ControllerLost, ControllerSilent, Driver, Receiver, TcpConnection
from afspm.plugins.nanonis import protocol
from afspm.plugins.nanonis.protocol import BadReply, NanonisError, UnreadableReply

MODULES: Final = {"IV": "BiasSpectr", "force": "ZSpectr"}
APPROACH: Final = "AutoApproach"
_WITHOUT_VERSION: Final = 10862
"""The release to assume if the software refuses Util.VersionGet, and can't report its release."""
_WAIT_MS: Final = 1000
_LONGEST_CURVE_S: Final = 24 * 3600.0
_HELD_EVERY_S: Final = 60.0
_MISSED_EVERY_S: Final = 10.0
_MOST_MISSED: Final = 3
"""Questions in a row without an answer, after which no way is left to withdraw the tip: a network is often lost for
seconds, and the connection held meanwhile is found dead only at the next question."""
_WITHDRAWS_WITHIN_S: Final = 2.0
"""Longest wait for an answer of the port that is kept for withdrawing, real time."""
_HINTS: Final = (
    "is Nanonis running, with this port open (File > Settings Options > TCP Programming Interface)?",
    "Nanonis is silent while a dialog waits for an answer on its screen; or another client has this port, which serves "
    "one, or another program listens there",
)


_WEDGED: Final = (
    "%s: another program may hold this port, or it may be wedged until Nanonis is restarted, as others report after a "
    "client was killed in mid-answer; the next port is used in place of %d"
)
_ALONE: Final = (
    "no port of Nanonis is left for a second connection: no spectrum can be taken, and the end of a scan is noticed by "
    "polling; restart Nanonis, or name a fourth port in address"
)


class Link:
    """A TCP connection to Nanonis; for arguments, see `TcpConnection`.

    Attributes:
        release: release of the controller's software, set once known.
        code_page: of the controller's computer, for texts that are not UTF-8; empty: as `text_of` decodes them.
    """

    def __init__(
        self,
        address: tuple[str, int],
        timeout_s: float,
        monotonic_s: Callable[[], float],
        release: int = protocol.NEWEST,
    ) -> None:
        self.release = release
        self.code_page = ""
        self._tcp = TcpConnection(address, timeout_s, monotonic_s, _HINTS)
        self.close = self._tcp.close

    def ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[Any, ...]:
        """Call a function of Nanonis.

        Args:
            longer_s: additional wait for the answer, real time.

        Raises:
            NanonisError: Nanonis reports an error. InvalidValue: the arguments can't be sent.
            UnreadableReply: other results than expected. ControllerLost, BadReply: no answer, or one to something else;
                the connection is closed.
        """

        def read(receiver: Receiver) -> bytearray:
            # A reply may exceed one segment of TCP, e.g. 128 names of signals, or a scan.
            size = protocol.body_bytes(bytes(receiver.exactly(protocol.HEADER_BYTES)), name)
            return receiver.exactly(size)

        body = self._tcp.ask(name, protocol.request(name, arguments, self.release), read, longer_s=longer_s)
        return protocol.results(name, body, self.release, self.code_page)


Address = tuple[str, int]


@dataclass
class Ports:
    """Nanonis' ports; each serves one client.

    Attributes:
        named: the ports as named: for quick requests, for blocking calls, for withdrawing, and for the data of scans or
            in place of a silent one. A single port is an emulator's, and serves all.
        silent: ports that have accepted a connection and answered nothing. Others report of a real Nanonis that a port
            stays so until Nanonis is restarted, after a client was killed in mid-answer.
    """

    named: Sequence[Address]
    silent: set[Address] = field(default_factory=set)

    @property
    def for_withdrawing(self) -> Address | None:
        return self.named[2] if len(self.named) > 2 else None

    def working(self) -> list[Address]:
        """Return the ports for quick requests and blocking calls, silent ones last."""
        some = [one for one in self.named if one != self.for_withdrawing]
        return sorted(some, key=lambda one: one in self.silent)

    def besides(self, *taken: Address | None) -> list[Address]:
        """Return the ports beside those taken, silent ones last. A single port is never taken."""
        return list(self.named) if len(self.named) == 1 else [one for one in self.working() if one not in taken]


class Session:
    """Two connections to the same Nanonis, with the modules for spectra and approach open.

    Args:
        driver: driver that uses the connections.
        ports: the ports to connect to; silent ones are remembered in it.
        timeout_s: longest wait for an answer, real time.
        release: release of the software; None: query Nanonis.
        code_page: see `Link`.

    Attributes:
        controller: name and release of the software, for people.
        opened: names of the opened modules; a module that was not purchased can't be opened.
        listener: thread that uses the second connection.

    Raises:
        ControllerLost: a connection can't be opened, or fails.
    """

    link: ClassVar[type[Link]] = Link

    def __init__(
        self, driver: Driver, ports: Ports, timeout_s: float, release: int | None, code_page: str = ""
    ) -> None:
        self._code_page = code_page
        self._log = driver.log
        self._driver, self._timeout_s = driver, timeout_s
        self._listener: Listener | None = None
        self._data: Link | None = None
        working = self._reach_first(ports, release)
        # each port of Nanonis serves one client, one call at a time: a blocking call needs a port of its own
        try:
            at, second = self._reach_second(ports, working)
            others = ports.besides(working, at) if len(ports.named) > 1 else []
            self._data_at = next((one for one in others if one not in ports.silent), None)
            if second is None:
                self._log.warning(_ALONE)
            silent = ports.silent.add
            self._listener = self.listener = Listener(second, driver.wake, lambda: silent(at) if at else None)
            driver.prove()
        except AfspmError:
            self.close()
            raise

    def _reach_first(self, ports: Ports, release: int | None) -> Address:
        """Return the port that answers quick requests: the first one named, unless it stays silent."""
        candidates = ports.working()
        for address in candidates:
            try:
                self._open_first(address, ports, release)
            except ControllerSilent as error:
                ports.silent.add(address)
                if address == candidates[-1]:
                    raise
                self._log.error(_WEDGED, error, address[1])
            else:
                ports.silent.discard(address)
                return address
        raise AssertionError("there is a port")

    def _reach_second(self, ports: Ports, working: Address) -> tuple[Address | None, Link | None]:
        """Return the port for blocking calls and its connection, which has answered a question."""
        for address in ports.besides(working):
            link = self._connected(address, self._link.release)
            try:
                with suppress(NanonisError, UnreadableReply):  # an error is an answer, too
                    link.ask("Scan.StatusGet")
            except ControllerLost as error:
                link.close()
                if address in ports.silent:
                    self._log.warning("the port %d still stays silent: %s", address[1], error)
                elif isinstance(error, ControllerSilent):
                    ports.silent.add(address)
                    self._log.error(_WEDGED, error, address[1])
                else:
                    raise
                continue
            ports.silent.discard(address)
            return address, link
        return None, None

    def _open_first(self, address: Address, ports: Ports, release: int | None) -> None:
        try:
            self._link = self._connected(address)
        except ControllerLost:
            ports.silent.clear()  # Nanonis does not run: it answers at all ports once it is started again
            raise
        self.ask = self._link.ask
        try:
            self._driver.prove()
            self.controller = f"Nanonis, release {release}"
            # The fields of requests and replies depend on the release.
            self._link.release = release or self._found_release()
            # The spectroscopy modules of the real software answer only after their Open.
            self.opened = {module for module in (*MODULES.values(), APPROACH) if self._open(module)}
            self._find_range()
        except AfspmError:
            self._link.close()
            raise

    def _connected(self, address: Address, release: int = protocol.NEWEST) -> Link:
        link = self.link(address, self._timeout_s, self._driver.clock.monotonic_s, release)
        link.code_page = self._code_page
        return link

    def close(self) -> None:
        if self._listener is not None:
            self._listener.close()
        if self._data is not None:
            self._data.close()
        self._link.close()

    def ask_for_data(self, name: str, *arguments: object) -> tuple[Any, ...]:
        """Call a function with a large answer, over a port of its own if one is left, otherwise as `ask`."""
        if self._data_at is None:
            return self.ask(name, *arguments)
        try:
            if self._data is None:
                self._data = self._connected(self._data_at, self._link.release)
            return self._data.ask(name, *arguments)
        except UnreadableReply:
            raise
        except ControllerLost as error:
            self._log.warning("the data of scans comes over the first port from now on: %s", error)
            self._data_at = None
            return self.ask(name, *arguments)

    def _found_release(self) -> int:
        try:
            product, version, host_release, engine_release = self.ask("Util.VersionGet")
        except (NanonisError, UnreadableReply) as error:
            self.controller = f"Nanonis, assumed to be release {_WITHOUT_VERSION}"
            text = "Nanonis does not report its release; assuming %d (or set release): %s"
            self._log.warning(text, _WITHOUT_VERSION, error)
            return _WITHOUT_VERSION
        self.controller = f"{product} {version}, release {host_release}"
        self._log.info("%s (real-time engine %d)", self.controller, engine_release)
        return int(host_release)

    def _find_range(self) -> None:
        try:
            self.ask("Piezo.RangeGet")
        except (NanonisError, UnreadableReply) as error:
            text = (
                "Nanonis does not report the scanner's range (module Piezo), so positions of the probe will be "
                "refused, and no frame is compared with it: %s"
            )
            self._log.warning(text, error)

    def _open(self, module: str) -> bool:
        try:
            self.ask(f"{module}.Open")
        except NanonisError as error:
            self._log.warning("the module %s of Nanonis is not available: %s", module, error)
            return False
        except UnreadableReply as error:  # its functions refuse if it is not open
            self._log.info("the module %s of Nanonis counts as open: %s", module, error)
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
        link: the second connection; None: Nanonis has no port left for it, and `scan` does nothing.
        wake: called from that thread when `events` has new entries.
        on_silent: called from that thread if the port accepts a connection, and answers nothing.

    Attributes:
        for_scan: whether the thread waits for the end of a scan, or is about to.
        for_curve: whether it waits for the end of a spectrum, or is about to.
    """

    def __init__(self, link: Link | None, wake: Callable[[], None], on_silent: Callable[[], None]) -> None:
        self._link = link
        self._wake = wake
        self._on_silent = on_silent
        self._jobs: SimpleQueue[Callable[[], ListenerEvent | None] | None] = SimpleQueue()
        self._events: SimpleQueue[ListenerEvent] = SimpleQueue()
        self.for_scan = self.for_curve = self._closed = False
        Thread(target=self._work, name="Nanonis' second connection", daemon=True).start()

    def scan(self) -> None:
        """Let the thread wait for the end of a scan, unless it already waits."""
        if self._link is not None and not self.for_scan:
            self.for_scan = True
            self._jobs.put(self._next_end_of_scan)

    @property
    def is_there(self) -> bool:
        return self._link is not None

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
        if self._link is not None:
            self._link.close()
        self._jobs.put(None)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None and not self._closed:
            result = self._done(job)
            if self._closed:
                return
            if isinstance(result, ControllerSilent):
                self._on_silent()
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

    def _ask(self, name: str, *arguments: object, longer_s: float) -> tuple[Any, ...]:
        assert self._link is not None
        return self._link.ask(name, *arguments, longer_s=longer_s)

    def _next_end_of_scan(self) -> ListenerEvent | None:
        # Short waits in a loop: a dead connection is noticed, and a spectrum gets its turn.
        while self.for_scan and not self._closed:
            timed_out, path = self._ask("Scan.WaitEndOfScan", _WAIT_MS, longer_s=_WAIT_MS / 1000)
            if not timed_out:
                self.for_scan = False
                return ScanEnded(path)
        return None

    def _curve(self, module: str, base_name: str) -> ListenerEvent:
        with_data = 1
        # With data requested, Start replies at the end of the spectrum, and blocks this connection until then.
        try:
            names, values, _ = self._ask(f"{module}.Start", with_data, base_name, longer_s=_LONGEST_CURVE_S)
        finally:
            self.for_curve = False
        return CurveEnded(tuple(names), values)


class WithdrawalPort:
    """A port of Nanonis that is held open, asked once a minute, and used for withdrawing the tip alone.

    Args:
        connected: opens the connection, with a wait for an answer in real seconds.
    """

    def __init__(
        self, connected: Callable[[float], Link], monotonic_s: Callable[[], float], log: logging.Logger
    ) -> None:
        self._connected, self._monotonic_s, self._log = connected, monotonic_s, log
        self._link: Link | None = None
        self._next_s = -math.inf
        self._missed = 0

    def hold(self) -> None:
        """Ask a question if the last one was a minute ago, over a new connection if the old one is lost.

        Without an answer it is asked again after some seconds.
        """
        if self._monotonic_s() < self._next_s:
            return
        was_held = self._link is not None
        try:
            try:
                self._asked("ZCtrl.OnOffGet")
            except ControllerLost:
                if not was_held or self._link is not None:
                    raise
                self._asked("ZCtrl.OnOffGet")  # over a new connection
        except AfspmError as error:
            self._missed += 1
            self._next_s = self._monotonic_s() + _MISSED_EVERY_S
            if self._missed == _MOST_MISSED:
                self._log.error("no way is left to withdraw the tip if the first port falls silent: %s", error)
            return
        self._next_s = self._monotonic_s() + _HELD_EVERY_S
        if self._missed >= _MOST_MISSED:
            self._log.info("the port kept for withdrawing the tip answers again")
        self._missed = 0

    def withdraw(self) -> None:
        """Stop approach and measurement, and withdraw the tip by its piezo.

        Raises:
            ControllerLost: the port is silent or lost. NanonisError: Nanonis refuses to withdraw.
        """
        off, stop, no_direction, at_once, no_timeout = 0, 1, 0, 0, -1
        stops: tuple[tuple[object, ...], ...] = (
            (f"{APPROACH}.OnOffSet", off),
            ("Scan.Action", stop, no_direction),
            *((f"{module}.Stop",) for module in MODULES.values()),
        )
        try:
            for name, *arguments in stops:
                try:
                    self._asked(str(name), *arguments)
                except (NanonisError, UnreadableReply) as error:  # most often it does not run, or was not purchased
                    self._log.info("%s before the tip is withdrawn: %s", name, error)
        except ControllerLost as error:  # a connection that was held for a minute may be gone
            self._log.warning("the port kept for withdrawing the tip is connected again: %s", error)
        self._asked("ZCtrl.Withdraw", at_once, no_timeout)

    def _asked(self, name: str, *arguments: object) -> None:
        if self._link is None:
            self._link = self._connected(_WITHDRAWS_WITHIN_S)
        try:
            self._link.ask(name, *arguments)
        except UnreadableReply:
            raise
        except ControllerLost:
            self.close()
            raise

    def close(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None
