"""Emulated Nanosurf Studio: its socket, its scripts in a real Lua engine, and its files, with simulated physics.

Scripts run in a real Lua, so that the maker's own client, its demo and its notebook run unmodified, and test more than
the agreement of this driver with itself. The tree has the commands in them; any other command fails, as in a Studio
without its licence. Values without effect would let a user's script end without having done anything.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

from afspm.basics import Duration, PlainMapping
from afspm.emulation import (
    LOOPBACK,
    Client,
    ClientConnection,
    MakerProgram,
    OnRequest,
    ScriptedEmulator,
    ScriptWire,
    TcpServer,
    Unfinished,
)
from afspm.plugins.nanosurf.emulator.studio import StudioProgram
from afspm.plugins.nanosurf.emulator.tree import CommandTree

if TYPE_CHECKING:
    from _typeshed import HasFileno

_LENGTH: Final = struct.Struct("<I")
LONGEST_SCRIPT: Final = 1 << 20
_MOST_UNREAD: Final = 64 << 20
"""Highest number of reply bytes that a client has not read; with more the connection ends."""


class NanosurfEmulator(ScriptedEmulator):
    """The emulated program. Needs lupa.

    Args:
        release: release of Studio; 19 lacks commands of 17 and 18. Before 17 it has the tree that users' scripts for
            Studio 13 speak, without spectroscopy.
        image_buffer: number of the low-level buffer with the lines of the running scan.
        start_s: duration of the ramp to the first line, experiment time.
        file_s: delay between the end of a measurement and the first half of its file, and between both halves,
            experiment time.
        one_client: True if a further connection waits for the end of the first.
        seed, faults, and the simulated world: settings of every emulator.
    """

    vendor = "Nanosurf"
    requires: ClassVar[tuple[str, ...]] = ("afspm[nanosurf]",)
    usual: ClassVar[PlainMapping] = {"port": 33030}
    modes: ClassVar[Sequence[str]] = ("amplitude", "frequency-shift")

    def __init__(
        self,
        *,
        release: int = 19,
        image_buffer: int = 4410,
        start_s: Duration = 0.2,
        file_s: Duration = 0.1,
        one_client: bool = False,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        self._release, self._image_buffer = release, image_buffer
        self._one_client = one_client
        self._times = {"start_s": start_s, "file_s": file_s}

    def make_program(self) -> MakerProgram:
        self._levels: dict[Client, int | None] = {}
        self._client: Client = None
        program = StudioProgram(
            self.rig, self.faults, self.clock, self.folder, self.log, file_clock=self.file_clock, **self._times
        )
        self._tree = CommandTree(program, self._release, self._image_buffer, self._select, self.log)
        return program

    def open_wire(self, port: int, on_request: OnRequest) -> ScriptWire:
        return StudioWire(port, on_request, self.woken, one_client=self._one_client)

    def answer(self, client: Client, request: bytes) -> bytes | Unfinished:
        """Run a script in the tree selected by the client."""
        self._client = client
        thread, problem = self._tree.start(request.decode("utf-8", "replace"), self._levels.get(client))
        return problem.encode() if problem is not None else self._run_on(client, thread)

    def failure(self, request: bytes, reason: str) -> bytes:
        """Return a reply with status 1 and the reason."""
        quoted = reason.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        return f'{{1,{{"{quoted}"}}}}'.encode()

    def not_a_number(self, request: bytes) -> bytes:
        """Return Lua's text of 0/0."""
        return b"{0,{(0/0)}}"

    def _run_on(self, client: Client, thread: object) -> bytes | Unfinished:
        self._client = client
        reply = self._tree.step(thread)
        return Unfinished(lambda: self._run_on(client, thread)) if reply is None else reply.encode()

    def _select(self, level: int | None) -> None:
        self._levels[self._client] = level


class StudioWire:
    """Studio's socket: a script and its reply, each preceded by its length in four bytes, little-endian.

    See `ScriptWire`.
    """

    def __init__(self, port: int, on_request: OnRequest, wakes: HasFileno, *, one_client: bool) -> None:
        self._on_request = on_request
        self._server = TcpServer(LOOPBACK, [port], one_each=one_client, wakes=wakes, on_bytes=self._split)

    @property
    def port(self) -> int:
        return self._server.ports[0]

    @property
    def address(self) -> str:
        return f"{LOOPBACK}:{self.port}"

    def poll(self, timeout_s: float) -> None:
        self._server.poll(timeout_s)

    def send(self, client: Client, reply: bytes) -> None:
        connection = cast(ClientConnection, client)
        if connection in self._server.connections:
            self._server.send(connection, _LENGTH.pack(len(reply)) + reply)
            if len(connection.sending) > _MOST_UNREAD:
                self._server.cut(connection)

    def send_half(self, client: Client, reply: bytes) -> None:
        """Send half a reply, then end the connection."""
        connection = cast(ClientConnection, client)
        if connection in self._server.connections:
            connection.closing = True
            self._server.send(connection, (_LENGTH.pack(len(reply)) + reply)[: 4 + len(reply) // 2])

    def close(self) -> None:
        self._server.close()

    def _split(self, connection: ClientConnection) -> None:
        # A connection that announces a script of more than 1 MiB ends.
        received = connection.received
        while len(received) >= _LENGTH.size:
            (size,) = _LENGTH.unpack_from(received)
            if size > LONGEST_SCRIPT:
                self._server.cut(connection)
                return
            if len(received) < _LENGTH.size + size:
                return
            script = bytes(received[_LENGTH.size : _LENGTH.size + size])
            del received[: _LENGTH.size + size]
            self._on_request(connection, script)
