"""An emulated Nanosurf Studio: its socket, its scripts in a real Lua, and its files, with simulated physics behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from afspm.basics.plain_data import PlainMapping
from afspm.basics.units import Duration
from afspm.plugins.nanosurf.emulator.studio import StudioProgram
from afspm.plugins.nanosurf.emulator.tree import CommandTree
from afspm.plugins.nanosurf.emulator.wire import StudioWire
from afspm.simulation.emulation.program import MakerProgram
from afspm.simulation.emulation.scripted import Client, OnRequest, ScriptedEmulator, ScriptWire, Unfinished


class NanosurfEmulator(ScriptedEmulator):
    """The emulated program. Needs lupa.

    Args:
        release: of Studio: 19 lacks commands that 17 and 18 have.
        image_buffer: number of the low-level buffer that the lines of a running scan are read from.
        start_s: how long the ramp to the first line takes, experiment time.
        file_s: how long after the end a file begins to appear; the other half of it comes as much later.
        one_client: whether a further connection waits until the first has gone.
        seed, faults, and all of the simulated world: as of every emulator.
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
        """Make Studio with its tree of commands."""
        self._levels: dict[Client, int | None] = {}
        self._client: Client = None
        program = StudioProgram(self.rig, self.faults, self.clock, self.folder, self.log, **self._times)
        self._tree = CommandTree(program, self._release, self._image_buffer, self._select, self.log)
        return program

    def open_wire(self, port: int, on_request: OnRequest) -> ScriptWire:
        """Listen for the connections of clients."""
        return StudioWire(port, on_request, self.woken, one_client=self._one_client)

    def answer(self, client: Client, request: bytes) -> bytes | Unfinished:
        """Run a script in the tree that the client has selected."""
        self._client = client
        thread, problem = self._tree.start(request.decode("utf-8", "replace"), self._levels.get(client))
        return problem.encode() if problem is not None else self._run_on(client, thread)

    def failure(self, request: bytes, reason: str) -> bytes:
        """Status 1, and the reason."""
        quoted = reason.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        return f'{{1,{{"{quoted}"}}}}'.encode()

    def not_a_number(self, request: bytes) -> bytes:
        """The value that Lua writes for 0/0."""
        return b"{0,{(0/0)}}"

    def _run_on(self, client: Client, thread: object) -> bytes | Unfinished:
        self._client = client
        reply = self._tree.step(thread)
        return Unfinished(lambda: self._run_on(client, thread)) if reply is None else reply.encode()

    def _select(self, level: int | None) -> None:
        self._levels[self._client] = level
