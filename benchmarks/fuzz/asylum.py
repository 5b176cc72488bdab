"""Random calls of the emulated Asylum: its functions and values with odd arguments, and malformed requests."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

import zmq

from afspm.plugins.asylum.emulator import AsylumEmulator
from afspm.plugins.asylum.emulator.values import NUMBERS
from benchmarks.fuzz.frame import Fuzzer, Unfit

_WAITS_MS: Final = 300
_PATIENCE_MS: Final = 60_000
_ODD: Final = (
    b"", b"\0", b"null", b"4711", b"[1]", b"{}", b'{"version": 1}', b'{"version": 1e400}', b"\xef\xbb\xbf{}", b"\xff",
    b'{"version": 1, "messageID": "\\ud800", "CallFunction": {"name": "GV", "params": ["ScanSize"]}}',
    b'{"version": 1, "CallFunction": {"name": ""}}', b'{"version": ' + b"9" * 400 + b"}",
)  # fmt: skip
_BUTTONS: Final = {
    "DoScanFunc": ("DoScan", "UpScan_0", "DownScanButton_1", "StopScan", "StopEngage_"),
    "DoForceFunc": ("SingleForce", "GoForce", "ResetForce", "StopForce", "NoForce", ""),
}
"""What DoScanFunc does not know opens a dialog, and Igor is busy until somebody presses OK."""


class AsylumFuzzer(Fuzzer[AsylumEmulator]):
    """See the module."""

    def connect(self, address: str) -> None:
        self._address = address
        self._context: zmq.Context[Any] = zmq.Context()
        self._functions = {name: made.takes for name, made in self.emulator.functions().items()}
        self._socket = self._connection()
        self._count = 0

    def _connection(self) -> zmq.Socket[bytes]:
        connection: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        connection.setsockopt(zmq.LINGER, 0)
        connection.connect(self._address)
        return connection

    def close(self) -> None:
        self._context.destroy(linger=0)

    def call(self) -> tuple[str, bool | None]:
        self._count += 1
        payload = self._payload()
        self._socket.send_multipart([b"", payload])
        reply = self._reply(self._socket, _WAITS_MS)
        if reply is None:
            self._socket.close()
            self._socket = self._connection()
            return payload.decode("utf-8", "replace"), None
        return payload.decode("utf-8", "replace"), reply["errorCode"]["value"] == 0

    def _payload(self) -> bytes:
        kind = self.chance.random()
        if kind < 0.05:
            return self.chance.choice(_ODD)
        if kind < 0.08:
            return self.chance.randbytes(self.chance.randrange(60))
        name, parameters = self._named()
        asked = {"name": name, "params": parameters}
        message = {"version": 1, "messageID": str(self._count), "CallFunction": asked}
        return json.dumps(message).encode()[:1024]

    def _named(self) -> tuple[str, list[Any]]:
        kind = self.chance.random()
        if kind < 0.4:  # a later call uses the value
            names = ";".join(self.chance.choices(tuple(NUMBERS), k=self.chance.choice((1, 1, 2))))
            return "PV", [names, self._value("v")]
        if kind < 0.5:
            return "PS", [self.chance.choice(("BaseName", "SaveImage", "SaveForce")), self.text("Image", "Curve_1")]
        if kind < 0.75:
            function = self.chance.choice(tuple(_BUTTONS))
            return function, [self.chance.choice(_BUTTONS[function])]
        name = self.chance.choice([name for name in self._functions if name != "doscanfunc"])
        return name, [self._value(kind) for kind in self._functions[name]]

    def _value(self, kind: str) -> Any:
        if self.chance.random() < 0.05:
            return self.chance.choice((None, True, [], {}, "1.a", "0x10", "infinity", " 1", "1 ", 10**30))
        if kind != "v":
            return self.text("ScanSize", "BaseName", "DoScan")
        value = self.number(1e-6, 1.0, 128.0, 0.0, 2.0)
        return value if value == value and abs(value) < 1e300 else str(value)

    def _reply(self, connection: zmq.Socket[bytes], patience_ms: int) -> dict[str, Any] | None:
        if not connection.poll(patience_ms):
            return None
        found: dict[str, Any] = json.loads(connection.recv_multipart()[-1])
        return found

    def check(self) -> None:
        connection = self._connection()
        asked = {"version": 1, "messageID": "check", "CallFunction": {"name": "GV", "params": ["MaxScanSize"]}}
        connection.send_multipart([b"", json.dumps(asked).encode()])
        reply = self._reply(connection, _PATIENCE_MS)
        connection.close()
        if reply is None or reply["errorCode"]["value"] != 0 or reply.get("messageID") != "check":
            raise Unfit(f"it answers {reply} to GV")


def cases() -> Iterator[tuple[type[AsylumFuzzer], AsylumEmulator]]:
    """Yield the emulators to call."""
    yield AsylumFuzzer, AsylumEmulator()
