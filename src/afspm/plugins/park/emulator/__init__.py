"""Emulated SmartScan: its socket, its scripts in a real JavaScript engine, and its files, with simulated physics."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NoReturn, cast

import zmq
from zmq.utils.monitor import recv_monitor_message

from afspm.basics import AfspmError, Duration, Plain, PlainMapping
from afspm.emulation import (
    LOOPBACK,
    Client,
    MakerProgram,
    OnRequest,
    ScriptedEmulator,
    ScriptFailed,
    ScriptWire,
    Unfinished,
)
from afspm.plugins.park.emulator.engine import Script
from afspm.plugins.park.emulator.smartscan import GEOMETRY, SmartScanProgram

if TYPE_CHECKING:
    from _typeshed import HasFileno

_DONE: Final = "Done"
_FAILED: Final = -32000
_NO_JSON: Final = -32700
LONGEST_REQUEST: Final = 1 << 20


class ParkEmulator(ScriptedEmulator):
    """The emulated program; settings choose between possible behaviours of the real program that are unconfirmed.

    Args:
        errors: form of a script's error in a reply: "rpc" (JSON-RPC's "error"), "result" (the result "Error", with the
            reason as value) or "value" (the usual result, with the reason as value).
        values: form of values: "text", or "native".
        replies: time of the reply to a script that waits for the instrument: "at-end", or "at-once" without a value.
        scan_words: answers of `scan_query`: scanning, idle.
        reports_gains: True if the gains of the feedback can be read, False if only set.
        start_s: duration of the ramp to the first line, in experiment time.
        file_s: delay between the end of a measurement and the first half of its file, and between both halves, in
            experiment time.
        seed, faults, and the simulated world: settings of every emulator.
    """

    vendor = "Park"
    requires: ClassVar[tuple[str, ...]] = ("afspm[park]",)
    usual: ClassVar[PlainMapping] = {"port": 5581}
    modes: ClassVar[Sequence[str]] = ("amplitude", "frequency-shift")

    def __init__(
        self,
        *,
        errors: Literal["rpc", "result", "value"] = "rpc",
        values: Literal["text", "native"] = "text",
        replies: Literal["at-end", "at-once"] = "at-end",
        scan_words: Sequence[str] = ("true", "false"),
        reports_gains: bool = True,
        start_s: Duration = 0.2,
        file_s: Duration = 0.1,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        self._errors, self._values, self._replies = errors, values, replies
        self._scan_words, self._reports_gains = scan_words, reports_gains
        self._times = {"start_s": start_s, "file_s": file_s}

    def make_program(self) -> MakerProgram:
        self._scripts: dict[Script, bool] = {}  # True: its reply was sent already
        self._smartscan = SmartScanProgram(
            self.rig, self.faults, self.clock, self.folder, self.log, file_clock=self.file_clock, **self._times
        )
        self._smartscan.reports_gains = self._reports_gains
        return self._smartscan

    def open_wire(self, port: int, on_request: OnRequest) -> ScriptWire:
        return SmartRemoteWire(port, on_request, self.woken)

    def answer(self, client: Client, request: bytes) -> bytes | Unfinished:
        """Run a script, or answer a query."""
        asked = _parsed(request)
        if asked is None:
            raise ScriptFailed("a request is no object of JSON")
        if asked.get("method") == "js_cmd":
            return self._run(client, request, str(asked.get("params", "")))
        return _reply(request, result=self._queried(str(asked.get("method"))))

    def failure(self, request: bytes, reason: str) -> bytes:
        """Return a reply with an error in the form of the setting `errors`; JSON-RPC's form for a malformed request."""
        if _parsed(request) is None:
            return _reply(request, error={"code": _NO_JSON, "message": reason})
        if self._errors == "rpc":
            return _reply(request, error={"code": _FAILED, "message": reason})
        if self._errors == "result":
            return _reply(request, result="Error", value=reason)
        return _reply(request, result=_DONE, value=reason)

    def not_a_number(self, request: bytes) -> bytes:
        """Return JavaScript's text of 0/0."""
        return _reply(request, result="NaN", value="NaN")

    def tick(self, now_s: float) -> float | None:
        """Advance the program, and the scripts that run on after an early reply."""
        for script in [one for one, is_answered in self._scripts.items() if is_answered]:
            try:
                ended = script.step() is not None
            except AfspmError as error:
                self.log.warning("a script failed: %s", error)
                ended = True
            if ended:
                del self._scripts[script]
        times = [super().tick(now_s), self._smartscan.next_waking_s(now_s)]
        for script in self._scripts:
            if math.isfinite(left_s := script.computes_for_s):
                times.append(now_s + max(left_s, 0.0) / self.clock.real_s(1.0))
        return min((at_s for at_s in times if at_s is not None), default=None)

    def abandon(self) -> None:
        """Drop the present activity, and end the scripts."""
        super().abandon()
        self._end_scripts()

    def close(self) -> None:
        super().close()
        self._end_scripts()

    def _end_scripts(self) -> None:
        scripts: dict[Script, bool] = getattr(self, "_scripts", {})
        for script in scripts:
            script.end()
        scripts.clear()

    def _has(self, client: Client) -> bool:
        return isinstance(self._wire, SmartRemoteWire) and self._wire.has(client)

    def _queried(self, method: str) -> str:
        program = self._smartscan
        if method == "js_connect":
            return "true"
        if method == "js_run":
            return "true" if self._scripts else "false"
        if method == "scan_query":
            return self._scan_words[0 if program.scanning else 1]
        if method == "pos_query":
            return ",".join(map(repr, program.stage_um))
        if method == "geometry_query":
            return ",".join(repr(program.geometry[name]) for name in GEOMETRY)
        raise ScriptFailed(f"there is no method {method!r}")

    def _run(self, client: Client, request: bytes, source: str) -> bytes | Unfinished:
        program = self._smartscan
        script = Script(source, program.names, program.ask, self.woken.post, lambda: not self._has(client))
        self._scripts[script] = False
        return self._step(request, script)

    def _step(self, request: bytes, script: Script) -> bytes | Unfinished:
        try:
            found = script.step()
        except BaseException:  # any end of a script, also by an error of the emulator
            self._scripts.pop(script, None)
            raise
        if found is None and script.waits and self._replies == "at-once":
            self._scripts[script] = True
            return _reply(request, result=_DONE, value="")
        if found is None:
            return Unfinished(lambda: self._step(request, script))
        self._scripts.pop(script, None)
        value, text = found
        return _reply(request, result=_DONE, value=text if self._values == "text" else value)


def _reply(request: bytes, **fields: object) -> bytes:
    asked = _parsed(request)
    number = None if asked is None else asked.get("id")
    return json.dumps({"jsonrpc": "2.0", **fields, "id": number}).encode()


def _parsed(request: bytes) -> Plain | None:
    # Lone surrogates are valid JSON but can't be encoded in a reply.
    try:
        asked = json.loads(request, parse_constant=_no_constant)
        json.dumps(asked, ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return None
    return asked if isinstance(asked, dict) else None


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")


class SmartRemoteWire:
    """SmartRemote's socket: like a ZeroMQ REP socket to each client, with replies pending for several clients.

    See `ScriptWire`.
    """

    def __init__(self, port: int, on_request: OnRequest, wakes: HasFileno) -> None:
        self._on_request = on_request
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDTIMEO, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_REQUEST)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        try:
            self._socket.bind(f"tcp://{LOOPBACK}:{port or '*'}")
        except zmq.ZMQError as error:
            self.close()
            raise OSError(error.errno, str(error)) from error
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._clients: dict[int, Client] = {}  # by the file descriptors of open connections; b"": nothing received yet
        self._poller = zmq.Poller()
        for readable in (wakes, self._socket, self._monitor):
            self._poller.register(readable, zmq.POLLIN)

    @property
    def address(self) -> str:
        return f"tcp://{LOOPBACK}:{self.port}"

    def poll(self, timeout_s: float) -> None:
        self._poller.poll(max(0, round(timeout_s * 1000)))
        self._follow_connections()
        while True:
            try:
                identity, *frames = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            # after the message: a new connection may have the descriptor of one that has ended since the last look
            self._follow_connections()
            descriptor = int(identity.get(zmq.SRCFD))
            if descriptor in self._clients:
                self._clients[descriptor] = identity.bytes
            if len(frames) == 2 and not frames[0].bytes:
                self._on_request(identity.bytes, frames[1].bytes)

    def _follow_connections(self) -> None:
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor)
            if event["event"] == zmq.EVENT_ACCEPTED:
                self._clients[event["value"]] = b""
            else:
                self._clients.pop(event["value"], None)

    def has(self, client: Client) -> bool:
        """Return whether a client is connected."""
        return client in self._clients.values()

    def send(self, client: Client, reply: bytes) -> None:
        self._socket.send_multipart([cast(bytes, client), b"", reply])

    def send_half(self, client: Client, reply: bytes) -> None:
        """Send a reply cut in half. ZeroMQ never cuts a message, but its content may be incomplete."""
        self.send(client, reply[: len(reply) // 2])

    def close(self) -> None:
        self._context.destroy(linger=0)
