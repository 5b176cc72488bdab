"""Emulated Nanonis controller: the vendor's TCP protocol and files, with simulated physics."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final

from afspm.basics import ConfigError, Count, InvalidValue, Listens, PlainMapping, PositiveLength
from afspm.emulation import LOOPBACK, ClientConnection, Crashed, Emulator, InstrumentBusy, TcpServer
from afspm.plugins.nanonis.emulator import as_reported, logger, wire
from afspm.plugins.nanonis.emulator.dispatch import (
    DeferredResult,
    FunctionRefused,
    NoResult,
    OldLayout,
    OtherLayout,
    Results,
)
from afspm.plugins.nanonis.emulator.software import NanonisSoftware

RELEASES: Final = {"2021": 10862, "2022": 11798, "2023": 13742, "2024": 14429, "2025": 14573}
"""The first release with each version of the protocol, by the year of the software."""
_ACTS: Final = ("Start", "Action", "Set", "Pulse", "Withdraw", "StartMove", "Home")
_UNSCANNED: Final = {"nan": math.nan, "zeros": 0.0}
_LOGS_EVERY_S: Final = 0.005
"""Real time between two polls of the TCP Logger."""
_OTHER_NAME: Final = "Util.RTFreqGet"
# An STM with a qPlus sensor, since most users of Nanonis have an STM. As a tapping AFM with a current beside it, the
# emulated controller passed every check of the tip with any tip. A sharp tip shows -8 Hz, a blunt one -37 Hz, a
# contaminated one -14 Hz. Z does not depend on setpoint and bias: the simulated I(V) curves would have to, too.
_QPLUS: Final[PlainMapping] = {"resonance_hz": 30e3, "spring_n_per_m": 1800.0, "oscillation_m": 100e-12}
_STM: Final[PlainMapping] = {"mode": "current", "setpoint": 100e-12, "qplus": True}


@dataclass(frozen=True)
class NanonisRequest:
    """A request to the emulated controller.

    Attributes:
        name: the function's name in the protocol.
        sent: the name as sent by the client, which the reply repeats.
    """

    name: str
    sent: str
    wants_answer: bool


@dataclass(frozen=True)
class PendingReply:
    """A reply that waits for an event."""

    asked: NanonisRequest
    later: DeferredResult

    @property
    def name(self) -> str:
        return self.asked.name


@dataclass(frozen=True)
class DelayedReply:
    """A complete reply with the time at which it is sent."""

    content: bytes
    at_s: float


class NanonisEmulator(Emulator):
    r"""The emulated controller of an STM with a qPlus sensor, unless `feedback` has another mode.

    Args:
        release: release of the software: a year of `RELEASES`, or the number itself.
        port: first port to listen on; 0: any free port.
        ports: number of ports, consecutive unless `port` is 0.
        logger_port: port of the TCP Logger's stream; 0: any free port.
        one_each: True if a port serves one client at a time, like a real controller's port.
        wedges: True if a port stays silent for ever once its client has reset the connection in mid-answer, as others
            report of real ones.
        other_layout: functions whose replies have four bytes more than documented, such as "Scan.FrameDataGrab".
        session_path: path of the session folder on the controller's computer, e.g. "D:\\Data". Default: the local path.
        range_m: range of the scanner in x and y.
        clips_frames: True if a frame beyond the range is clipped when it is set. False: it is kept as set, and the tip
            stays at the edge of the range.
        bare_errors: True if replies with an error have no results; False: results of zeros.
        grabbed_rows: order of rows of scans in `Scan.FrameDataGrab`: "top-first" or as "recorded".
        unscanned: values of rows not yet scanned in `Scan.FrameDataGrab`: "nan" or "zeros"; saved files have NaN.
        seed, faults, and the simulated world: settings of every emulator.
    """

    vendor = "Nanonis"
    usual: ClassVar[Mapping[str, object]] = {"port": 6501, "ports": 4, "logger_port": logger.USUAL_PORT}
    reported: ClassVar[Mapping[str, str]] = as_reported.OF_NANONIS
    reported_of_others: ClassVar[Mapping[str, str]] = as_reported.OF_OTHERS
    fault_kinds: ClassVar[Mapping[str, str]] = {
        "no-reply": "a request is not answered",
        "slow": "a reply comes later, by the duration",
        "dialog": "a dialog waits on the screen: nothing is answered for the duration",
        "cut": "the connection is cut instead of a reply",
        "wedged": "the port stays silent for ever, also for later clients",
        "truncated": "half a reply, then the connection is cut",
        "error": "a reply with an error",
        "refused": "an error in reply to what sets or starts something",
        "wrong-name": "the reply to another function",
        "wrong-release": "for the duration, replies have the fields of another release",
        "garbage": "bytes that are not a reply",
        "huge": "a reply that announces two gigabytes",
        "not-utf8": "texts that are not UTF-8",
        "nan": "NaN for every number",
        "nonsense": "for the duration, well-formed replies with absurd values",
        "crash": "the software crashes",
        "file-late": "a file appears only after the duration",
        "half-file": "a file is half written, and whole only after the duration",
        "file-missing": "a file is announced but never written",
        "stale-name": "the file of the previous scan is announced for a scan",
        "autosave-off": "scans and spectra are not saved for the duration, despite the settings",
        "late-start": "a scan begins, and is reported as running, only after the duration",
        "takes-all": "for the duration, values are taken as sent that are otherwise refused, rounded or clipped",
        "no-start": "a scan does not begin, without an error",
        "blocks": "for the duration, a pulse or a shaping of the tip is answered at its end, although no one waits",
        "ends-at-once": "for the duration, waiting for the end of a scan returns at once if none runs",
        "safe-tip": "the safe tip withdraws the tip and ends the scan",
        "safe-tip-unnoticed": "the safe tip withdraws the tip, and the scan goes on in the air",
        "panel-stop": "the scan is stopped at the panel",
    }

    def __init__(
        self,
        *,
        release: str | int = "2025",
        ports: Count = 1,
        logger_port: Annotated[int, Listens()] = 0,
        one_each: bool = False,
        wedges: bool = False,
        other_layout: Sequence[str] = (),
        session_path: str = "",
        range_m: PositiveLength = 100e-6,
        bare_errors: bool = False,
        grabbed_rows: str = "top-first",
        unscanned: str = "nan",
        clips_frames: bool = False,
        **settings: Any,
    ) -> None:
        super().__init__(**{**settings, "feedback": _of_stm(settings.get("feedback", {}))})
        self.release = _release(release)
        self._ports = max(ports, 4) if as_reported.WEDGED_PORT in self.as_reported else ports
        self.logger_port = logger_port
        self._chance = random.Random(self.seed)
        is_wedged = as_reported.WEDGED_PORT in self.as_reported
        self._one_each, self._wedges = one_each or is_wedged, wedges or is_wedged
        self._encoding = "gbk" if as_reported.CODE_PAGE in self.as_reported else "utf-8"
        self._session_path = session_path
        self._other_layout = other_layout
        if unknown := set(other_layout) - wire.functions().keys():
            what = f"Nanonis has no function {min(unknown)!r}"
            raise ConfigError(what, where="other_layout", hint='a list of functions, such as ["Piezo.TiltGet"]')
        self._range_m = range_m
        self._bare_errors = bare_errors
        for name, value, known in (
            ("grabbed_rows", grabbed_rows, ("top-first", "recorded")),
            ("unscanned", unscanned, tuple(_UNSCANNED)),
        ):
            if value not in known:
                raise ConfigError(f"unknown value {value!r}", where=name, hint=f"one of {', '.join(known)}")
        self._grabbed_rows, self._unscanned, self._clips_frames = grabbed_rows, unscanned, clips_frames

    def open(self) -> str:
        ports = [self.port + i if self.port else 0 for i in range(self._ports)]
        self._server = TcpServer(
            LOOPBACK,
            ports,
            stream_port=self.logger_port,
            one_each=self._one_each,
            wedges=self._wedges,
            wakes=self.woken,
            on_bytes=self._answer_all,
        )
        self.logger_port = self._server.stream_port
        self.software = NanonisSoftware(
            self.rig,
            self.faults,
            self.clock,
            self.folder,
            session_path=self._session_path,
            range_m=self._range_m,
            release=self.release,
            rows_as_recorded=self._grabbed_rows == "recorded",
            unscanned=_UNSCANNED["zeros" if as_reported.ZEROS in self.as_reported else self._unscanned],
            clips_frames=self._clips_frames and as_reported.OVER_RANGE not in self.as_reported,
            reported=self.as_reported,
            file_clock=self.file_clock,
            log=self.log,
        )
        return f"{LOOPBACK}:{','.join(map(str, self._server.ports))}"

    def serve(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` real seconds for clients, and answer the received requests."""
        self._server.poll(timeout_s)

    def tick(self, now_s: float) -> float | None:
        """Advance scans, files and the TCP Logger; send the replies that are due, and answer waiting requests."""
        times = [self.software.advance(now_s), self._log_signals(now_s)]
        for connection in self._server.connections:
            times.append(self._go_on(connection, now_s))
            self._answer_all(connection)
        return min((at_s for at_s in times if at_s is not None), default=None)

    def _log_signals(self, now_s: float) -> float | None:
        readers, signals = self._server.readers, self.software.signals
        stream = signals.logger
        stream.unread = [len(reader.sending) for reader in readers]
        if not stream.running:
            return None
        for counter in stream.due(now_s):
            values = signals.values([signals.slots[slot] for slot in stream.slots], now_s)
            for reader in readers:
                if len(reader.sending) < logger.MOST_WAITING:
                    self._server.send(reader, stream.frame(counter, values))
        return max(stream.next_s(), now_s + self.software.core.experiment_s(_LOGS_EVERY_S))

    def _go_on(self, connection: ClientConnection, now_s: float) -> float | None:
        waits = connection.waits_for
        if isinstance(waits, DelayedReply):
            if now_s < waits.at_s:
                return waits.at_s
            connection.waits_for = None
            self._server.send(connection, waits.content)
        elif isinstance(waits, PendingReply):
            with self._refusing(connection, waits.asked):
                return self._settled(connection, waits, now_s)
        return None

    def _settled(self, connection: ClientConnection, waits: PendingReply, now_s: float) -> float | None:
        later = waits.later
        results = later.ready(now_s)
        if results is None and now_s >= later.until_s:
            results = later.timed_out
            later.gave_up()
        if results is None:
            again_s = min(later.until_s, later.next_s(now_s))
            return None if math.isinf(again_s) else again_s
        connection.waits_for = None
        self._reply(connection, waits.asked, results)
        return None

    @property
    def wedged_ports(self) -> int:
        """Return the number of ports that accept connections and answer nothing any more."""
        return self._server.wedged

    def close(self) -> None:
        """Close the listening socket, if the emulator was started."""
        if hasattr(self, "_server"):
            self._server.close()

    # --- requests ---

    def _answer_all(self, connection: ClientConnection) -> None:
        while connection.waits_for is None and not connection.closing:
            now_s = self.clock.now_s()
            if self.faults.lasts("dialog", now_s):
                return
            try:
                request = wire.split(connection.received)
            except wire.MalformedRequest as error:
                self.log.warning("disconnected a client: %s", error)
                self._server.cut(connection)
                return
            if request is None:
                return
            sent, wants_answer, body = request
            asked = NanonisRequest(wire.known_as(sent) or sent, sent, wants_answer)
            with self._refusing(connection, asked):
                self._answer(connection, asked, body, now_s)

    @contextmanager
    def _refusing(self, connection: ClientConnection, asked: NanonisRequest) -> Iterator[None]:
        try:
            yield
        except (FunctionRefused, InstrumentBusy, InvalidValue, wire.MalformedRequest) as error:
            self._refuse(connection, asked, str(error))
        except Crashed:
            raise
        except Exception as error:  # an error of the emulator must not end the emulator: the client gets an error, too
            self.log.exception("%s failed", asked.name)
            self._refuse(connection, asked, str(error))

    def _refuse(self, connection: ClientConnection, asked: NanonisRequest, reason: str) -> None:
        connection.waits_for = None
        if asked.wants_answer:
            text = f"Error in command: {asked.sent.lower()}: {reason}"
            body = wire.error_body(asked.name, text, self.release, bare=self._bare_errors)
            self._send(connection, asked.sent, body)

    def _answer(self, connection: ClientConnection, asked: NanonisRequest, body: bytes, now_s: float) -> None:
        name = asked.name
        if self.faults.strikes("crash", now_s):
            raise Crashed(f"at {name}")
        known = wire.functions().get(name)
        if known is None or known.since > self.release:
            raise FunctionRefused(f"the function {name} is not known")
        if self.faults.strikes("error", now_s):
            raise FunctionRefused("an emulated error")
        if name.endswith(_ACTS) and self.faults.strikes("refused", now_s):
            raise FunctionRefused("it is not possible now")
        self.software.core.client = connection.memory
        found = self.software.functions.call(
            name, wire.arguments(name, body, self._wire_release(now_s), self._encoding)
        )
        if isinstance(found, DeferredResult):
            connection.waits_for = PendingReply(asked, found)
        else:
            self._reply(connection, asked, found)

    def _wire_release(self, now_s: float) -> int:
        # A fault makes the replies use the fields of another release.
        if self.faults.lasts("wrong-release", now_s):
            return min(RELEASES.values()) if self.release > min(RELEASES.values()) else max(RELEASES.values())
        return self.release

    def _reply(self, connection: ClientConnection, asked: NanonisRequest, results: Results) -> None:
        if not asked.wants_answer:
            return
        now_s = self.clock.now_s()
        release = min(RELEASES.values()) if isinstance(results, OldLayout) else self._wire_release(now_s)
        encoding = self._encoding
        if self.faults.strikes("not-utf8", now_s):
            encoding = "latin-1"
            results = tuple(f"{value}\u00b5" if isinstance(value, str) else value for value in results)
        if any(isinstance(value, float) for value in results) and self.faults.strikes("nan", now_s):
            results = tuple(math.nan if isinstance(value, float) else value for value in results)
        fields = wire.functions()[asked.name].results
        padded = (*results, *(wire.ZEROS[field.code] for field in fields[len(results) :]))
        if self.faults.lasts("nonsense", now_s):
            padded = tuple(wire.senseless_value(field.code, self._chance) for field in fields)
        is_empty = isinstance(results, NoResult)
        body = wire.error_block("", 0) if is_empty else wire.body(asked.name, padded, release, encoding)
        more = b"\0" * 4 if asked.name in self._other_layout or isinstance(results, OtherLayout) else b""
        self._send(connection, asked.sent, body + more)

    def _send(self, connection: ClientConnection, name: str, body: bytes) -> None:
        now_s = self.clock.now_s()
        content = wire.reply(name, body)
        if self.faults.strikes("no-reply", now_s):
            return
        if self.faults.strikes("wedged", now_s):
            self._server.wedge(connection)
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
            connection.waits_for = DelayedReply(content, now_s + slow.duration_s)
            return
        self._server.send(connection, content)


def _of_stm(feedback: object) -> object:
    # A feedback of another mode, or a malformed table, stays as it is.
    if not isinstance(feedback, Mapping) or feedback.get("mode", "current") != "current":
        return feedback
    sensor = feedback.get("sensor", {})
    return {**_STM, **feedback, "sensor": {**_QPLUS, **sensor} if isinstance(sensor, Mapping) else sensor}


def _release(given: str | int) -> int:
    text = str(given)
    if text in RELEASES:
        return RELEASES[text]
    if text.isdigit() and int(text) > 3000:
        return int(text)
    raise ConfigError(f"there is no release {text!r}", where="release", hint=f"{', '.join(RELEASES)}, or its number")
