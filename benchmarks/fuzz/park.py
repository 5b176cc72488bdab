"""Random calls of the emulated SmartScan: values and methods with odd arguments, and malformed scripts and requests."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

import zmq

from afspm.plugins.park.emulator import ParkEmulator
from afspm.plugins.park.emulator.smartscan import GEOMETRY, SmartScanProgram
from benchmarks.fuzz.frame import Fuzzer, Unfit

_WAITS_MS: Final = 300
_PATIENCE_MS: Final = 60_000
_ODD: Final = (
    b"", b"\0", b"null", b"4711", b"[1]", b"{}", b'{"method": 1}', b'{"method": "js_cmd", "params": NaN}', b"\xff",
    b'{"method": "js_cmd", "params": null, "id": []}', b'{"method": "js_cmd", "params": "\\ud800"}', b"[" * 5000,
)  # fmt: skip
_SCRIPTS: Final = (
    "", "x =", "spm", "spm = null", "throw {}", "throw undefined", "JSON = null", "[1, [2]]", "({a: 1})", "NaN",
    "'x'.repeat(1e5)", "spm.scan = 1", "spm.bias.tip = spm", "var t = []; while (true) t.push('x'.repeat(1e6))",
    "Object.keys(spm)", "Date.now()", "(function f() { f(); })()", "spm.scan.setScanGeometry.call(null)",
)  # fmt: skip
_QUERIES: Final = ("js_connect", "js_run", "scan_query", "pos_query", "geometry_query", "nonsense")
_LIVELY: Final = ("scan.triggerImageScan", "scan.startImageScan", "scan.stop", "approach.start", "spect.start")
_STOP: Final = "spm.scan.stop(); spm.spect.stop(); spm.approach.stop()"
_MOST_PIXELS: Final = 64
"""A scan with more takes too long."""


class ParkFuzzer(Fuzzer[ParkEmulator]):
    """See the module."""

    def connect(self, address: str) -> None:
        self._address = address
        self._context: zmq.Context[Any] = zmq.Context()
        self._socket = self._connection()
        program = self.emulator.program
        assert isinstance(program, SmartScanProgram)
        names = json.loads(program.names)
        self._values, self._methods = names["values"], names["methods"]

    def _connection(self) -> zmq.Socket[bytes]:
        connection: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        connection.setsockopt(zmq.LINGER, 0)
        connection.connect(self._address)
        return connection

    def close(self) -> None:
        self._context.destroy(linger=0)

    def call(self) -> tuple[str, bool | None]:
        request = self._request()
        reply = _asked(self._socket, request, _WAITS_MS)
        if reply is None:  # the script waits for the instrument
            self._socket.close()
            self._socket = self._connection()
            _asked(self._socket, _script(_STOP), _PATIENCE_MS)
        return request.decode("utf-8", "replace")[:400], None if reply is None else "error" not in reply

    def _request(self) -> bytes:
        kind = self.chance.random()
        if kind < 0.05:
            return self.chance.choice((*_ODD, self.chance.randbytes(self.chance.randrange(60))))
        if kind < 0.1:
            return json.dumps({"method": self.chance.choice(_QUERIES), "id": 1}).encode()
        return _script(self._statement())

    def _statement(self) -> str:
        kind = self.chance.random()
        if kind < 0.1:
            return self.chance.choice(_SCRIPTS)
        if kind < 0.4:  # a later call uses the value
            return f"spm.{self.chance.choice(self._values)} = {self._value()}"
        if kind < 0.6:
            return f"spm.scan.setScanGeometry({self._geometry()})"
        method = self.chance.choice(_LIVELY if kind < 0.75 else self._methods)
        given = ", ".join(self._value() for _ in range(self.chance.choice((0, 0, 1, 2, 3))))
        return f"spm.{method}({given})"

    def _geometry(self) -> str:
        if self.chance.random() < 0.1:
            return self._value()
        wanted = {name: self.number(1e-6, 1e-3, 0.1, 1.0, 100.0, -50.0) for name in GEOMETRY}
        pixels = {name: self.integer(1, 2, 16, _MOST_PIXELS) for name in ("pixelWidth", "pixelHeight")}
        wanted |= {name: count if count <= _MOST_PIXELS or count > 10_000 else 8 for name, count in pixels.items()}
        names = self.chance.sample(sorted(wanted), self.chance.randrange(len(wanted) + 1))
        return _in_javascript({name: wanted[name] for name in names})

    def _value(self) -> str:
        kind = self.chance.random()
        if kind < 0.1:
            return self.chance.choice(("null", "undefined", "true", "[]", "{}", "spm", "function () {}", "-0"))
        if kind < 0.2:
            member = self.chance.choice(("p", "i", "mode", "type", "subDir", "fileName", "name", "nonsense"))
            return _in_javascript({member: self.chance.choice((self.text("fd", "here"), self.number(1.0), None))})
        if kind < 0.5:
            return _in_javascript(self.text("fd", "iv", "here", "ZHeight", "q", "channelCurrent"))
        return _in_javascript(self.number(1e-3, 0.1, 1.0, 16.0, 1e3))

    def check(self) -> None:
        connection = self._connection()
        reply = _asked(connection, _script("1 + 1"), _PATIENCE_MS)
        connection.close()
        if reply is None or reply.get("value") != "2":
            raise Unfit(f"it answers {reply} to 1 + 1")


def _script(source: str) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "method": "js_cmd", "params": source, "id": 1}).encode()


def _in_javascript(value: object) -> str:
    return json.dumps(value)  # NaN, Infinity and -Infinity are written as JavaScript has them


def _asked(connection: zmq.Socket[bytes], request: bytes, patience_ms: int) -> dict[str, Any] | None:
    connection.send_multipart([b"", request])
    if not connection.poll(patience_ms):
        return None
    found: dict[str, Any] = json.loads(connection.recv_multipart()[-1])
    return found


def cases() -> Iterator[tuple[type[ParkFuzzer], ParkEmulator]]:
    """Yield the emulators to call."""
    yield ParkFuzzer, ParkEmulator()
