"""Random calls of the emulated Nanosurf Studio: values and commands with odd arguments, and malformed scripts."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from typing import Final

from afspm.plugins.nanosurf.emulator import NanosurfEmulator
from afspm.plugins.nanosurf.emulator.studio import PANEL
from benchmarks.fuzz.frame import Fuzzer, Unfit

_WAITS_S: Final = 0.3
_PATIENCE_S: Final = 60.0
_COMMANDS: Final = (
    "imaging.start", "imaging.stop", "imaging.acquire", "imaging.pause", "imaging.resume", "approach.approach",
    "approach.approach_async", "approach.withdraw", "approach.stop_approach", "spectroscopy.start", "spectroscopy.stop",
    "spectroscopy.acquire", "scanner.move_to_target_offsets", "imaging.scanning_started.empty", "nothing.there",
    "workspace.add_frame", "workspace.delete_item", "workspace.all_item_ids", "workspace.save_to_file",
    "workspace.clear", "workspace.load_from_file", "automation.add_to_queue", "automation.process_queue",
    "automation.clear_queue", "automation.abort", "laser.alignment.align_all", "mode.wavemode.load",
    "spectroscopy.select_cycle",
)  # fmt: skip
_SCRIPTS: Final = (
    "local t = {} while true do t[#t + 1] = ('x'):rep(1e6) end", "t = {} while true do t[#t + 1] = ('x'):rep(1e6) end",
    "string.format = nil return 1.5", "while true do pcall(function() while true do end end) end",
    "", "x =", "return", "return root", "return nil, nil", "while true do end", "error({})", "error()", "return {{}}",
    "return string.rep('x', 1e5)", "local t = {} t.t = t return t", "root = nil return 1", "return os, io, require",
    "return root.session.select('91-01-000', 5)", "return root.session.select_main(0)", "return root.session.select(1)",
    "root.workflow.imaging.scanning_started.connect(function() error('no') end)", "return pcall(error)",
    "root.workflow.imaging.scanning_started.connect(1)",
    "return root.core.acquisition.lu_data_buffer_channel_data(4410, 0)",
    "return root.scripting.wrapper.python.create_python_wrapper(root, 'root', '../outside/cmd_tree_x.py')",
)  # fmt: skip


class NanosurfFuzzer(Fuzzer[NanosurfEmulator]):
    """See the module."""

    def connect(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self._address = host, int(port)
        self._socket = self._connection()

    def _connection(self) -> socket.socket:
        connection = socket.create_connection(self._address, _PATIENCE_S)
        self._ask(connection, "return root.session.select('91-01-000', 2)")
        return connection

    def close(self) -> None:
        self._socket.close()

    def call(self) -> tuple[str, bool | None]:
        script = self._script()
        self._socket.settimeout(_WAITS_S)
        try:
            if self.chance.random() < 0.02:
                self._socket.sendall(self.chance.randbytes(self.chance.randrange(40)))
            return script, self._ask(self._socket, script).startswith("{0,")
        except OSError:  # it waits for the instrument, or was given a length that is none
            self._socket.close()
            self._socket = self._connection()
            return script, None

    def _script(self) -> str:
        kind = self.chance.random()
        if kind < 0.15:
            return self.chance.choice(_SCRIPTS)
        if kind < 0.45:
            return f"return root.workflow.{self.chance.choice(_COMMANDS)}({self._value()})"
        path = self.chance.choice(tuple(PANEL))
        field = "value_raw" if PANEL[path].enum else "value"
        if kind < 0.9:
            return f"root.workflow.{path}.{field}_set({self._value()})"
        return f"return root.workflow.{path}.{self.chance.choice((field, 'unit', 'min'))}"

    def _value(self) -> str:
        if self.chance.random() < 0.2:
            text = self.text("Image_[INDEX]", "a").replace("\\", "\\\\").replace("\0", "\\0")
            return self.chance.choice((f'"{text}"', "nil", "true", "{}", "0/0", "math.huge", ""))
        value = self.number(1e-7, 2e-7, 16.0, 100.0, 0.0, 1.0)
        return repr(value) if abs(value) < 1e300 else "1/0"

    @staticmethod
    def _ask(connection: socket.socket, script: str) -> str:
        raw = script.encode()
        connection.sendall(struct.pack("<I", len(raw)) + raw)
        (size,) = struct.unpack("<I", _exactly(connection, 4))
        return _exactly(connection, size).decode()

    def check(self) -> None:
        connection = self._connection()
        with connection:
            reply = self._ask(connection, "return root.session.list()")
        if reply != '{0,{{[1]="91-01-000"}}}':
            raise Unfit(f"it answers {reply}")


def _exactly(connection: socket.socket, size: int) -> bytes:
    received = b""
    while len(received) < size:
        part = connection.recv(size - len(received))
        if not part:
            raise ConnectionError("the connection was closed")
        received += part
    return received


def cases() -> Iterator[tuple[type[NanosurfFuzzer], NanosurfEmulator]]:
    """Yield the emulators to call."""
    yield NanosurfFuzzer, NanosurfEmulator()
