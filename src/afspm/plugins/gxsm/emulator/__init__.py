"""Emulated GXSM, version 3 or 4: its module `gxsm` and its files, with simulated physics."""

from __future__ import annotations

import os
import select
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Final

from afspm.basics import ConfigError, PlainMapping, PositiveLength
from afspm.emulation import Crashed, Emulator
from afspm.plugins.gxsm.emulator import block, calls, file_writer, files, program
from afspm.plugins.gxsm.emulator.block import SharedMemoryBlock
from afspm.plugins.gxsm.emulator.calls import GxsmFunctions, NoAnswer, WrongArguments
from afspm.plugins.gxsm.emulator.console import SCRIPT, ScriptCall, ScriptConsole
from afspm.plugins.gxsm.emulator.entries import USER_UNITS
from afspm.plugins.gxsm.emulator.program import GxsmProgram

PROCESS: Final = "emulated-gxsm4"
_TRANSPORTS: Final = ("bridge", "shm")


class GxsmEmulator(Emulator):
    """The emulated GXSM.

    Args:
        version: 3 or 4.
        card: hardware of GXSM: "SRanger", "RPSPMC" or GXSM's own "simulator".
        transport: "bridge": a script runs in the console; "shm": the shared memory of Gxsm4, on Linux.
        script: path of the script for the console. Default: afspm's bridge.
        block: name of the shared memory. Default: a unique name.
        process: name of the process that serves the shared memory.
        user_unit: unit of lengths on the panel: "Å", "nm" or "µm".
        decimal_comma: True for a locale with decimal commas, 12,5.
        auto_save, probe_auto_save: Auto Save of scans and of spectra at the start.
        feedback_actions: names of the actions that switch the feedback on and off. Default: none.
        display_units: display units by the name of a channel, e.g. "pA" for "I-Tunnel"; GXSM stores values in its base
            unit (Å, V, nA, Hz) in any case.
        channels_set: True if a person has set the channels at the panel, and begun a scan with them if the folder has
            scans from before. False: no channel is set, as after each start of a real Gxsm4.
        reach_m: reach of the scanner in x and y, from the centre.
        seed, faults, and the simulated world: settings of every emulator.

    Attributes:
        unanswered: received calls without an answer yet, oldest first.
        silent: True after a call that blocks GXSM until a restart.
    """

    vendor = "GXSM"
    usual: ClassVar[PlainMapping] = {"port": 65431, "block": "gxsm4_py_shm_data_block", "process": "gxsm4"}
    fault_kinds: ClassVar[Mapping[str, str]] = {
        "wedge": "nothing is answered for the duration",
        "crash": "GXSM crashes; its shared memory stays",
        "script-stopped": "script-control is set to 0: the script in the console ends",
        **calls.FAULT_KINDS,
        **program.FAULT_KINDS,
        **file_writer.FAULT_KINDS,
        **block.FAULT_KINDS,
    }

    def __init__(
        self,
        *,
        version: int = 4,
        card: str = "SRanger",
        transport: str = "bridge",
        script: str = "",
        block: str = "",
        process: str = PROCESS,
        user_unit: str = "Å",
        decimal_comma: bool = False,
        auto_save: bool = True,
        probe_auto_save: bool = True,
        feedback_actions: Sequence[str] = (),
        display_units: Mapping[str, str] = MappingProxyType({}),
        channels_set: bool = True,
        reach_m: PositiveLength = 2e-6,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        for name, value, known in (
            ("version", version, (3, 4)),
            ("card", card, program.CARDS),
            ("transport", transport, _TRANSPORTS if version == 4 else _TRANSPORTS[:1]),
            ("user_unit", user_unit, USER_UNITS),
        ):
            if value not in known:
                raise ConfigError(f"unknown value {value!r}", where=name, hint=f"one of {', '.join(map(str, known))}")
        for unit in display_units.values():
            if unit not in files.UNITS:
                raise ConfigError(
                    f"unknown unit {unit!r}", where="display_units", hint=f"one of {', '.join(files.UNITS)}"
                )
        self._settings = program.GxsmSettings(
            version, card, user_unit, decimal_comma, auto_save, probe_auto_save, reach_m, display_units, channels_set
        )
        self._transport = transport
        self._script = Path(script) if script else SCRIPT
        self._block_name, self._process = block or f"emulated_gxsm4_{os.urandom(8).hex()}", process
        self._feedback_actions = tuple(feedback_actions)
        self.unanswered: deque[ScriptCall] = deque()
        self.silent = False
        self._console: ScriptConsole | None = None
        self._listens = False
        self._block: SharedMemoryBlock | None = None

    def open(self) -> str:
        files.prepare(self._settings.version)
        self.silent = False
        self.unanswered.clear()
        self.program = GxsmProgram(self.rig, self.faults, self.clock, self.file_clock, self.folder, self._settings)
        self._calls = GxsmFunctions(self.program, self._feedback_actions)
        if self._transport == "shm":
            self._block = SharedMemoryBlock(
                self._block_name, self._process, self.folder, self.faults, self.clock.now_s, self.unanswered.append
            )
            return f"shm:{self._block_name}@{self._block.pid}"
        return self.run_script()

    def run_script(self) -> str:
        """Run the script in the console, as a user does; return the address at which the script listens."""
        self.take_button_away()
        before = self._console
        if before is not None:
            before.end()
            self.unanswered.clear()
        self._console = ScriptConsole(self._script, self.port, self.folder.absolute(), self._post, self.woken.post)
        while (address := self._console.poll()) is None:
            self.serve(1.0)
        self.port = int(address.rpartition(":")[2])
        self._listens = True
        if before is not None:
            self.listening(address)
        return address

    def serve(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` real seconds for a call, and answer the received calls."""
        watched = [one for one in (self.woken, self._block) if one is not None]
        ready = select.select(watched, [], [], timeout_s)[0]
        if self._block is not None and self._block in ready:
            self._block.take()
        self.woken.take()
        self._answer_all()

    def tick(self, now_s: float) -> float | None:
        """Advance scans and files, and answer waiting calls."""
        if self.faults.strikes("crash", now_s) or self.program.has_crashed:
            if self._block is not None:
                self._block.end(remains=True)
                self._block = None
            raise Crashed("an emulated crash")
        if self._console is not None and self._listens and not self._console.runs:
            self._listens = False
            self.listening("")
            self.show_button("run-the-script-again", "the script in the console has ended", self.run_script)
        if self.faults.strikes("script-stopped", now_s):
            self.program.entries.put(calls.SCRIPT_CONTROL, 0.0)
        next_s = self.program.advance(now_s)
        self._answer_all()
        return next_s

    def close(self) -> None:
        if self._console is not None:
            self._console.end()
            self._console = None
        if self._block is not None:
            self._block.end()
            self._block = None

    def answer(self, method: str, arguments: tuple[object, ...]) -> object:
        """Call a function of GXSM, with the errors of `GxsmFunctions.answer`."""
        return self._calls.answer(method, arguments)

    def _post(self, call: ScriptCall) -> None:
        self.unanswered.append(call)
        self.woken.post()

    def _answer_all(self) -> None:
        while self.unanswered and not self.silent and not self.faults.lasts("wedge", self.clock.now_s()):
            call = self.unanswered.popleft()
            self.program.advance(self.clock.now_s())  # GXSM's calls and its own work alternate in one thread
            try:
                found = self.answer(call.method, call.arguments)
            except NoAnswer:
                self.silent = True
                return
            except WrongArguments as error:
                found = SystemError(str(error)) if self._block is None else error.value
            except (NameError, SystemError) as error:  # errors of the real module, for the script
                found = error
            except Exception as error:  # the emulator must survive its own errors: the script gets them
                self.log.exception("%s failed", call.method)
                found = SystemError(str(error))
            call.answered(found)
