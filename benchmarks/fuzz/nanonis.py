"""Random calls of the emulated Nanonis: every function, with arguments that are right, odd, or malformed."""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final

from afspm.plugins.nanonis.emulator import NanonisEmulator, wire
from benchmarks.fuzz.frame import Fuzzer, Unfit

_WAITS_S: Final = 0.1
"""A reply may wait for the end of a scan: after so long, it is no longer waited for."""
_PATIENCE_S: Final = 60.0
_BITS: Final = {"B": 0xFF, "H": 0xFFFF, "I": 0xFFFFFFFF}
_LIVELY: Final = (
    "Scan.Action", "Scan.BufferSet", "Scan.FrameSet", "Scan.PropsSet", "Scan.SpeedSet", "Scan.FrameDataGrab",
    "BiasSpectr.Start", "ZSpectr.Start", "BiasSpectr.Open", "ZSpectr.Open", "Piezo.TiltSet", "ZCtrl.OnOffSet",
    "ZCtrl.SetpntSet", "ZCtrl.GainSet", "Bias.Pulse", "TipShaper.Start", "FolMe.XYPosSet", "ZCtrl.Withdraw",
    "AutoApproach.OnOffSet", "Motor.StartMove",
)  # fmt: skip
"""What sets things in motion is called more often than what does not."""


class NanonisFuzzer(Fuzzer[NanonisEmulator]):
    """See the module."""

    def connect(self, address: str) -> None:
        host, port = address.split(":")
        self._at = host, int(port.split(",")[0])
        self._functions = sorted(wire.functions())
        self._socket = self._connection(_WAITS_S)

    def _connection(self, timeout_s: float) -> socket.socket:
        connection = socket.create_connection(self._at, timeout=_PATIENCE_S)
        connection.settimeout(timeout_s)
        return connection

    def close(self) -> None:
        self._socket.close()

    def call(self) -> tuple[str, bool | None]:
        name = self.chance.choice(_LIVELY if self.chance.random() < 0.3 else self._functions)
        called, body = self._body(name)
        header = name.encode().ljust(32, b"\0") + struct.pack(">iHH", len(body), 1, 0)
        if self.chance.random() < 0.002:
            called, header = f"{name} with a broken header", self.chance.randbytes(40)
        answered = None
        try:
            self._socket.sendall(header + body)
            answered = _succeeded(_reply(self._socket))
        except OSError:  # it waits for something, or has cut the connection
            self._socket.close()
            self._calm()
            self._socket = self._connection(_WAITS_S)
        return called, answered

    def _body(self, name: str) -> tuple[str, bytes]:
        if self.chance.random() < 0.05:
            raw = self.chance.randbytes(self.chance.randrange(40))
            return f"{name} {raw.hex()}", raw
        codes = wire.functions()[name].argument_codes(self.emulator.release)
        values = self._values(codes)
        body = b"".join(_packed(code, value) for code, value in zip(codes, values, strict=True))
        if self.chance.random() < 0.02:
            body = body[: self.chance.randrange(len(body) + 1)]
        return f"{name} {values}", body

    def _values(self, codes: list[str]) -> list[Any]:
        # one for each code; lists that should have equal lengths mostly have
        values: list[Any] = []
        count = 0
        for code in codes:
            if code == "n":
                count = self.chance.choice((0, 1, 2, 3))
                values.append(count if self.chance.random() < 0.9 else self.integer())
            else:
                values.append(self._value(code, count if code.startswith("*") else None))
        return values

    def _value(self, code: str, count: int | None = None) -> Any:
        if code in "BHIi":
            return self.integer(0, 1, 2, 16, 32, 48)
        if code in "fd":
            return self.number(1e-9, 20e-9, 0.1, 1.0, 2.0, 1e-3)
        if code == "S":
            return self.text("curve", "scan_", "comment")
        items = self.chance.choice((0, 1, 1, 2, 3)) if count is None else count
        if code == "2f":
            return [[self.number(0.1) for _ in range(2)] for _ in range(items)]
        return [self._value("S" if code == "A" else code[1]) for _ in range(items)]

    def _calm(self) -> None:
        # stops calls that would go on for ever
        for name, codes, values in (("Scan.Action", "HI", (1, 0)), ("Scan.BufferSet", ["[i]", "i", "i"], ([], 16, 16))):
            body = b"".join(_packed(code, value) for code, value in zip(codes, values, strict=True))
            self._ask(name, body)

    def _ask(self, name: str, body: bytes = b"") -> bytes:
        with self._connection(_PATIENCE_S) as connection:
            connection.sendall(name.encode().ljust(32, b"\0") + struct.pack(">iHH", len(body), 1, 0) + body)
            return _reply(connection)

    def check(self) -> None:
        if not _succeeded(self._ask("Util.VersionGet")):
            raise Unfit("it no longer tells its version")


def _reply(connection: socket.socket) -> bytes:
    header = _exactly(connection, wire.HEADER_BYTES)
    return _exactly(connection, struct.unpack_from(">i", header, 32)[0])


def _exactly(connection: socket.socket, count: int) -> bytes:
    received = bytearray()
    while len(received) < count:
        part = connection.recv(min(count - len(received), 1 << 20))
        if not part:
            raise ConnectionError("the connection was closed")
        received += part
    return bytes(received)


def _succeeded(body: bytes) -> bool:
    # only an error has a text at its end
    return body.endswith(bytes(8))


def _packed(code: str, value: Any) -> bytes:
    if code in _BITS:
        return struct.pack(f">{code}", value & _BITS[code])
    if code == "f":
        with suppress(OverflowError):
            return struct.pack(">f", value)
        return struct.pack(">f", math.inf)
    if code == "S":
        raw: bytes = value.encode()
        return struct.pack(">i", len(raw)) + raw
    if code == "2f":
        return struct.pack(">ii", len(value), 2) + b"".join(_packed("f", one) for row in value for one in row)
    if code == "A":
        return struct.pack(">ii", 0, len(value)) + b"".join(_packed("S", one) for one in value)
    if code[0] in "[*]":
        count = struct.pack(">i", len(value)) if code[0] == "[" else b""
        return count + b"".join(_packed(code[1], one) for one in value)
    return struct.pack(f">{code.replace('n', 'i')}", value)


def cases() -> Iterator[tuple[type[NanonisFuzzer], NanonisEmulator]]:
    """Yield the emulators to call."""
    yield NanonisFuzzer, NanonisEmulator()
