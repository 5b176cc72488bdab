"""Random calls of the emulated GXSM, through its bridge or its shared memory, and malformed bytes.

Well-formed calls use the translator's own links, which must survive every reply.
"""

from __future__ import annotations

import json
import mmap
import os
import pickle
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

from afspm.plugins.gxsm import bridge, bridge_client
from afspm.plugins.gxsm.emulator import GxsmEmulator
from afspm.plugins.gxsm.emulator.signalled import CONTENT, LENGTH, SIZE, STATUS
from afspm.plugins.gxsm.errors import GxsmError
from afspm.plugins.gxsm.link import Address, Link, open_link
from afspm.translator.driver_base import ControllerLost
from benchmarks.fuzz.frame import Fuzzer, Unfit

_PATIENCE_S: Final = 60.0
_WAITS_S: Final = 0.05
_MOST_POINTS, _ALL_POINTS = 32, 20_000
"""A picture with more takes too long; above the second number GXSM refuses it."""
_METHODS: Final = (
    "list_refnames", "list_actions", "get", "gets", "rtquery", "y_current", "waitscan", "autosave", "chfname",
    "moveto_scan_xy", "get_geometry", "get_dimensions", "get_differentials", "get_slice", "get_probe_event", "nonsense",
    "_set", "answer",
)  # fmt: skip
_USUAL: Final[dict[str, tuple[Any, ...]]] = {
    "rtquery": ("s", "S", "W", "o", "f", "p", "P", "R", "z"),
    "chfname": (0, 3, 100, 101), "moveto_scan_xy": (0.0, 20.0, -40), "get_geometry": (0, 1), "get_dimensions": (0, 1),
    "get_differentials": (0, 1), "get_slice": (0, 0, 1, 8), "get_probe_event": (0, -1),
}  # fmt: skip
_ARITY: Final = {"moveto_scan_xy": 2, "get_slice": 5, "get_probe_event": 2}
_TEXTS: Final = (
    "abc", "1e400", "-1e400", "nan", "inf", "0x10", "33.7", " 5", "1,5", "5Å", "9" * 400, "\u0663", "0", "-1",
)  # fmt: skip
_LINES: Final = (
    b"", b"[]", b"{}", b"null", b"[1]", b"[[]]", b'["set"', b'["set", null, []]', b"[" * 5000, b"9" * 5000, b"\xff\xfe",
    b'["get", "\\ud800"]', b'["moveto_scan_xy", NaN, Infinity]', b'["get_slice", 0, 0, 0, 1' + b"0" * 400 + b", 1]",
    b'["get", 1e999]', b'["getcwd", 1]', b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b'["y_current"]',
)  # fmt: skip
_PICKLES: Final = (
    b"", b".", b"N.", b"\x80\x04", b"\x80\x04Nr\xff\xff\xff\x7f.", b"cos\nmkdir\n(Voutside\ntR.",
    b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7fx.", pickle.dumps(([None, {}],)), pickle.dumps(5),
    pickle.dumps("x" * 99),
)  # fmt: skip


class _Wire(Protocol):
    """A way to send malformed input."""

    def send_odd(self) -> str:
        """Send malformed input, outside any link; return a description."""


class GxsmFuzzer(Fuzzer[GxsmEmulator]):
    """See the module."""

    _link: Link | None = None

    def connect(self, address: str) -> None:
        self._address = Address.parse(address)
        self._refs = self.emulator.program.entries.names()
        self._wire: _Wire = _Memory(self, address) if address.startswith("shm:") else _Bridge(self, address)

    def close(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None

    def call(self) -> tuple[str, bool | None]:
        if self.chance.random() < 0.05:
            return self._wire.send_odd(), None
        method, arguments = self.named()
        return f"{method}{arguments!r:.200}", self._call(method, *arguments)

    def _call(self, method: str, *arguments: Any) -> bool:
        try:
            if self._link is None:
                self._link = open_link(self._address, _PATIENCE_S, time.monotonic)
            self._link.call(method, *arguments)
        except GxsmError:
            return False
        except ControllerLost as error:
            raise Unfit(f"{method}{arguments!r:.200}: {error}") from error
        return True

    def named(self) -> tuple[str, tuple[Any, ...]]:
        """Return a call."""
        kind = self.chance.random()
        if kind < 0.4:  # a later call uses the setting
            ref = self.chance.choice(self._refs)
            return "set", (ref, self._set_to(ref))
        if kind < 0.5:
            return self.chance.choice(("startscan", "startscan", "stopscan")), ()
        if kind < 0.6:
            return "action", (self.chance.choice(self._actions()),)
        method = self.chance.choice(_METHODS)
        if self.chance.random() < 0.1:
            return method, tuple(self._odd() for _ in range(self.chance.randrange(4)))
        if method in ("get", "gets"):
            return method, (self.text(*self._refs, "Rang", "nonsense"),)
        usual = _USUAL.get(method, ())
        count = _ARITY.get(method, 1 if usual else 0)
        return method, tuple(self._number(usual) for _ in range(count))

    def _actions(self) -> tuple[str, ...]:
        modes = "IV", "FZ", "PL", "VP", "ABORT"
        return (
            "DSP_CMD_AUTOAPP", "DSP_CMD_STOPALL", "CHECK-MainAutoSave", "UNCHECK-MainAutoSave", "CHECK-SCAN-REPEAT",
            "UNCHECK-SCAN-REPEAT", "GETCHECK-MainAutoSave", "CHECK-IV", "nonsense", self.text(""),
            *(f"DSP_VP_{mode}_EXECUTE" for mode in modes),
        )  # fmt: skip

    def _set_to(self, ref: str) -> str:
        if ref == "script-control":
            return self.chance.choice(("1", "50", "101"))  # less ends the bridge, which is right
        if ref.startswith("Points"):
            return self._points()
        if self.chance.random() < 0.3:
            return self.chance.choice(_TEXTS)
        return repr(self.number(1.0, 10.0, 1e3, 1e5, 1e7))

    def _points(self) -> str:
        text = self.chance.choice((*_TEXTS, "2", "8", "16", "32", str(self.integer())))
        with suppress(ValueError):
            if _MOST_POINTS < float(text) <= _ALL_POINTS:
                return str(_MOST_POINTS)
        return text

    def _number(self, usual: tuple[Any, ...]) -> Any:
        if self.chance.random() < 0.8:
            return self.chance.choice(usual)
        return self.chance.choice((self.integer(), self.number()))

    def _odd(self) -> Any:
        return self.chance.choice((True, 1.5, 10**30, -(2**63), 2**63, "a\0b", "\ud800", self.number(), self.text("0")))

    def check(self) -> None:
        for settled in (("action", "UNCHECK-SCAN-REPEAT"), ("stopscan",)):
            self._call(*settled)
        if not self._call("get", "PointsX"):
            raise Unfit("it no longer tells how many points a line has")
        for path in self.emulator.folder.iterdir():  # thousands of scans take much of a disk
            path.unlink(missing_ok=True)


class _Bridge:
    """Malformed lines, and calls whose answers are not read."""

    def __init__(self, fuzzer: GxsmFuzzer, address: str) -> None:
        self._fuzzer, self._chance = fuzzer, fuzzer.chance
        host, _, port = address.rpartition(":")
        self._at = host, int(port)

    def send_odd(self) -> str:
        lines = [self._line() for _ in range(self._chance.randrange(1, 6))]
        sent = b"\n".join(lines) + self._chance.choice((b"\n", b"\n", b""))
        with socket.create_connection(self._at, _PATIENCE_S) as connection, suppress(ConnectionError):
            if self._chance.random() < 0.8:
                self._introduce(connection)
            connection.sendall(sent)
            if self._chance.random() < 0.8:
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(1 << 16):
                    pass
        return f"{lines!r:.400}"

    def _introduce(self, connection: socket.socket) -> None:
        known, nonce, address = bridge.secret(), "0" * bridge.NONCE, "{}:{}".format(*connection.getpeername())
        with connection.makefile("rb") as replies:
            connection.sendall(bridge_client.message("challenge", nonce))
            theirs, _ = json.loads(replies.readline())["value"]
            proof = bridge.proof(known, "client", address, nonce, theirs)
            connection.sendall(json.dumps(["response", proof]).encode() + b"\n")
            replies.readline()

    def _line(self) -> bytes:
        kind = self._chance.random()
        if kind < 0.5:
            return self._chance.choice(_LINES)
        if kind < 0.6:
            return self._chance.randbytes(self._chance.randrange(60))
        method, arguments = self._fuzzer.named()
        line = json.dumps([method, *arguments]).encode()
        return line[: self._chance.randrange(len(line))] if kind < 0.7 else line


class _Memory:
    """Requests that no program of Gxsm4 would write into its memory, or whose answers are not read."""

    def __init__(self, fuzzer: GxsmFuzzer, address: str) -> None:
        self._fuzzer, self._chance = fuzzer, fuzzer.chance
        name, _, pid = address.removeprefix("shm:").partition("@")
        self._pid = int(pid)
        with Path("/dev/shm", name).open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SIZE)

    def send_odd(self) -> str:
        written = [self._write() for _ in range(self._chance.choice((1, 1, 1, 3)))]
        until_s = time.monotonic() + _WAITS_S
        while struct.unpack_from("<q", self._memory, STATUS)[0] == 1 and time.monotonic() < until_s:
            pass
        return "; ".join(written)

    def _write(self) -> str:
        method, arguments = self._fuzzer.named()
        content = self._content(arguments)
        name = self._chance.choice((*[method.encode()] * 3, self._chance.randbytes(64), b"do", b"program", b""))
        length = self._chance.choice((len(content), len(content), 0, SIZE, 2**32 - 1, 2**63))
        status = self._chance.choice((1, 1, 1, 0, 2, -1, 2**62))
        self._memory[:64] = name.ljust(64, b"\0")
        self._memory[CONTENT : CONTENT + len(content)] = content
        struct.pack_into("<Q", self._memory, LENGTH, length)
        struct.pack_into("<q", self._memory, STATUS, status)
        os.kill(self._pid, signal.SIGUSR1)
        return f"{name!r} {content!r:.200}, {length} bytes, status {status}"

    def _content(self, arguments: tuple[Any, ...]) -> bytes:
        kind = self._chance.random()
        if kind < 0.4:
            return self._chance.choice(_PICKLES)
        if kind < 0.5:
            return self._chance.randbytes(self._chance.randrange(60))
        content = pickle.dumps(tuple(arguments), self._chance.randrange(5))
        return content[: self._chance.randrange(len(content))] if kind < 0.7 else content


def cases() -> Iterator[tuple[type[GxsmFuzzer], GxsmEmulator]]:
    """Yield the emulators to call."""
    yield GxsmFuzzer, GxsmEmulator(version=3)
    yield GxsmFuzzer, GxsmEmulator(version=4, card="RPSPMC")
    if sys.platform.startswith("linux"):
        yield GxsmFuzzer, GxsmEmulator(version=4, transport="shm")
