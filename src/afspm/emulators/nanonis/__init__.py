"""An emulated Nanonis controller: the vendor's TCP protocol and files, with simulated physics behind them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from afspm.emulators.emulator import LOOPBACK, Crashed, Emulator
from afspm.emulators.nanonis import on_curves, on_scans, on_signals, on_tip, panel, wire
from afspm.emulators.nanonis.answers import Later, Nope, Results, answer
from afspm.emulators.nanonis.panel import Panel
from afspm.emulators.nanonis.server import Connection, Server
from afspm.emulators.rig import RigBusy
from afspm.errors import ConfigError, InvalidValue
from afspm.units import Length

RELEASES: Final = {"2021": 10862, "2022": 11798, "2023": 13742, "2024": 14429, "2025": 14573}
"""By the year of the software: the first that has what the protocol has from then on."""
_ACTS: Final = ("Start", "Action", "Set", "Pulse", "Withdraw", "StartMove", "Home")
_ANSWERING: Final = (on_curves, on_scans, on_signals, on_tip)
"""What answers to the functions, by having been imported."""
_OTHER_NAME: Final = "Util.RTFreqGet"


@dataclass(frozen=True)
class Waiting:
    """A reply that comes when something has happened."""

    name: str
    later: Later


@dataclass(frozen=True)
class Delayed:
    """A reply that is ready, and sent at a time."""

    content: bytes
    at_s: float


class NanonisEmulator(Emulator):
    """The emulated controller.

    Args:
        release: of its software: a year of `RELEASES`, or the number itself.
        port: the first that it listens on; 0: any free.
        ports: how many, one after the other; where any is free, each is any.
        one_each: whether a port serves one client at a time, as the real one's do.
        session_path: what it calls its session folder, e.g. "D:\\\\Data"; left out: what the folder is called here.
        range_m: of its scanner in x and y.
        bare_errors: replies with an error have no results; they have, all zero, if not.
        grabbed_rows: how scans in its memory are handed out: "top-first" or as "recorded".
        seed, faults, and all of the simulated world: as of every emulator.
    """

    vendor = "Nanonis"
    usual: ClassVar[Mapping[str, Any]] = {"port": 6501, "ports": 4}
    fault_kinds: ClassVar[Mapping[str, str]] = {
        "no-reply": "a request is not answered",
        "slow": "a reply comes later, by the duration",
        "dialog": "a dialog waits on the screen: nothing is answered for the duration",
        "cut": "the connection is cut instead of a reply",
        "truncated": "half a reply, then the connection is cut",
        "error": "a reply with an error",
        "refused": "an error in reply to what sets or starts something",
        "wrong-name": "the reply to another function",
        "wrong-release": "for the duration, fields as of another release than it says",
        "garbage": "bytes that are no reply",
        "huge": "a reply that announces two gigabytes",
        "not-utf8": "texts that are not UTF-8",
        "nan": "NaN for every number",
        "crash": "the software vanishes",
        **panel.FAULT_KINDS,
    }

    def __init__(
        self,
        *,
        release: str | int = "2025",
        ports: int = 1,
        one_each: bool = False,
        session_path: str = "",
        range_m: Length = 100e-6,
        bare_errors: bool = False,
        grabbed_rows: str = "top-first",
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        self.release = _release(release)
        self._ports = ports
        self._one_each = one_each
        self._session_path = session_path
        self._range_m = range_m
        self._bare_errors = bare_errors
        if grabbed_rows not in ("top-first", "recorded"):
            raise ConfigError(f"{grabbed_rows!r}", where="grabbed_rows", hint='"top-first" or "recorded"')
        self._grabbed_rows = grabbed_rows

    def open(self) -> str:
        """Listen on all ports."""
        ports = [self.port + i if self.port else 0 for i in range(self._ports)]
        self._server = Server(LOOPBACK, ports, one_each=self._one_each, wakes=self.woken, on_bytes=self._answer_all)
        self.panel = Panel(
            self.rig,
            self.faults,
            self.clock,
            self.folder,
            session_path=self._session_path,
            range_m=self._range_m,
            release=self.release,
            rows_as_recorded=self._grabbed_rows == "recorded",
        )
        return f"{LOOPBACK}:{','.join(map(str, self._server.ports))}"

    def serve(self, timeout_s: float) -> None:
        """Answer what has come."""
        self._server.poll(timeout_s)

    def tick(self, now_s: float) -> float | None:
        """Scans end, files are written, and who has waited for that is answered."""
        times = [self.panel.advance(now_s)]
        for connection in self._server.connections:
            times.append(self._go_on(connection, now_s))
            self._answer_all(connection)
        return min((at_s for at_s in times if at_s is not None), default=None)

    def _go_on(self, connection: Connection, now_s: float) -> float | None:
        """Send what was waited for, if it is there; returns when to look again."""
        waits = connection.waits_for
        if isinstance(waits, Delayed):
            if now_s < waits.at_s:
                return waits.at_s
            connection.waits_for = None
            self._server.send(connection, waits.content)
        elif isinstance(waits, Waiting):
            results = waits.later.ready(now_s)
            if results is None and now_s >= waits.later.until_s:
                results = waits.later.timed_out
            if results is None:
                return None if math.isinf(waits.later.until_s) else waits.later.until_s
            connection.waits_for = None
            self._reply(connection, waits.name, results)
        return None

    def close(self) -> None:
        """Listen no more."""
        if hasattr(self, "_server"):
            self._server.close()

    # --- requests ---

    def _answer_all(self, connection: Connection) -> None:
        """What has come on a connection, as far as it does not wait for something."""
        while connection.waits_for is None and not connection.closing:
            now_s = self.clock.now_s()
            if self.faults.lasts("dialog", now_s):
                return
            try:
                request = wire.split(connection.received)
            except wire.Unreadable as error:
                self.log.warning("a client is cut: %s", error)
                self._server.cut(connection)
                return
            if request is None:
                return
            name, wants_answer, body = request
            self._answer(connection, name, body, wants_answer, now_s)

    def _answer(self, connection: Connection, name: str, body: bytes, wants_answer: bool, now_s: float) -> None:
        if self.faults.strikes("crash", now_s):
            raise Crashed(f"at {name}")
        known = wire.functions().get(name)
        try:
            if known is None or known.since > self.release:
                raise Nope(f"the function {name} is not known")
            if self.faults.strikes("error", now_s):
                raise Nope("an emulated error")
            if name.endswith(_ACTS) and self.faults.strikes("refused", now_s):
                raise Nope("it is not possible now")
            arguments = wire.arguments(name, body, self._wire_release(now_s))
            zeros = tuple(wire.ZEROS[code] for code, _ in known.results)
            found = answer(self.panel, name, arguments, zeros)
        except (Nope, RigBusy, InvalidValue, wire.Unreadable) as error:
            if wants_answer:
                self._send(connection, name, wire.error_body(name, str(error), self.release, bare=self._bare_errors))
            return
        if isinstance(found, Later):
            connection.waits_for = Waiting(name, found)
        elif wants_answer:
            self._reply(connection, name, found)

    def _wire_release(self, now_s: float) -> int:
        """The release by which the fields go."""
        if self.faults.lasts("wrong-release", now_s):
            return min(RELEASES.values()) if self.release > min(RELEASES.values()) else max(RELEASES.values())
        return self.release

    def _reply(self, connection: Connection, name: str, results: Results) -> None:
        now_s = self.clock.now_s()
        encoding = "utf-8"
        if self.faults.strikes("not-utf8", now_s):
            encoding = "latin-1"
            results = tuple(f"{value}\u00b5" if isinstance(value, str) else value for value in results)
        if any(isinstance(value, float) for value in results) and self.faults.strikes("nan", now_s):
            results = tuple(math.nan if isinstance(value, float) else value for value in results)
        codes = wire.functions()[name].results
        padded = (*results, *(wire.ZEROS[code] for code, _ in codes[len(results) :]))
        self._send(connection, name, wire.body(name, padded, self._wire_release(now_s), encoding))

    def _send(self, connection: Connection, name: str, body: bytes) -> None:
        """A reply, or what goes wrong with it."""
        now_s = self.clock.now_s()
        content = wire.reply(name, body)
        if self.faults.strikes("no-reply", now_s):
            return
        if self.faults.strikes("cut", now_s):
            self._server.cut(connection)
            return
        if self.faults.strikes("wrong-name", now_s):
            content = wire.reply(_OTHER_NAME, body)
        if self.faults.strikes("garbage", now_s):
            content = bytes(range(255, 155, -1))
        if self.faults.strikes("huge", now_s):
            content = content[:32] + (0x7FFFFFFF).to_bytes(4, "big") + content[36:]
        if self.faults.strikes("truncated", now_s):
            content, connection.closing = content[: len(content) // 2], True
        slow = self.faults.strikes("slow", now_s)
        if slow is not None:
            connection.waits_for = Delayed(content, now_s + slow.duration_s)
            return
        self._server.send(connection, content)


def _release(given: str | int) -> int:
    text = str(given)
    if text in RELEASES:
        return RELEASES[text]
    if text.isdigit() and int(text) > 3000:
        return int(text)
    raise ConfigError(f"there is no release {text!r}", where="release", hint=f"{', '.join(RELEASES)}, or its number")


EMULATOR = NanonisEmulator
