"""The functions of GXSM's Python module `gxsm`: effects on the emulated program, and answers to callers."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, TypeVar

import numpy as np

from afspm.emulation import InstrumentBusy
from afspm.plugins.gxsm.emulator.program import ANGSTROM_M, GxsmProgram

FAULT_KINDS: Final[Mapping[str, str]] = {
    "error": "a call raises an error",
    "garbage": "GXSM reports its state from uninitialised memory",
    "wrong-type": "a call is answered with a text",
    "nan": "a value is not a number",
}
SCRIPT_CONTROL: Final = "script-control"
_NEVER_WRITTEN: Final = 6.9e-310
_MODES: Final = {
    "SRanger": ("IV", "FZ", "PL", "LP", "SP", "TS", "GVP", "TK", "AC", "AX", "ABORT"),
    "RPSPMC": ("IV", "VP"),
    "simulator": (),
}
_KINDS: Final = {"FZ": "force"}
_NOBODY: Final = 4294967295
_VOLT: Final = 532.0
"""Ångström per volt of the scanner."""


_Method = TypeVar("_Method", bound=Callable[..., object])
_LONGS: Final = range(-(2**63), 2**63)
_FUNCTIONS: dict[str, tuple[Callable[..., object], inspect.Signature]] = {}


def _function(method: _Method) -> _Method:
    # Functions are found by their name without the underscore. Their signatures are read once: reading one takes longer
    # than most calls.
    _FUNCTIONS[method.__name__[1:]] = method, inspect.signature(method)
    return method


def _converts(value: object, kind: str) -> bool:
    # The conversions of Python's C interface: an int must fit into 64 bits, a text can't contain NUL.
    if kind == "str":
        return isinstance(value, str) and "\0" not in value and not any("\ud800" <= one <= "\udfff" for one in value)
    if kind == "int":
        return isinstance(value, int) and value in _LONGS
    return isinstance(value, float) or (isinstance(value, int) and value in _LONGS)


def _fits(signature: inspect.Signature, arguments: tuple[object, ...]) -> bool:
    takes = [*signature.parameters.values()][1:]  # without self
    needed = sum(one.default is inspect.Parameter.empty for one in takes)
    kinds = [one.annotation for one in takes]
    return needed <= len(arguments) <= len(takes) and all(map(_converts, arguments, kinds))


class NoAnswer(Exception):
    """The exception that a call blocks GXSM, so that no call is answered until a restart."""


class WrongArguments(SystemError):
    """The error that a call has a wrong number of arguments, or arguments that can't be converted to C types.

    Attributes:
        value: result that Gxsm4 returns instead through its shared memory.
    """

    def __init__(self, method: str) -> None:
        super().__init__(f"<built-in function {method}> returned a result with an exception set")
        self.value: object = (0.0, 0.0, 0.0) if method == "rtquery" else -1


class Uninitialised:
    """A value that the real program leaves uninitialised."""


class GxsmFunctions:
    """The functions of the module `gxsm`, executed by the emulated program. Not thread-safe.

    Args:
        program: the emulated program.
        feedback_actions: names of the actions that switch the feedback on and off; empty: none.
    """

    def __init__(self, program: GxsmProgram, feedback_actions: Sequence[str] = ()) -> None:
        self._program = program
        self._feedback_actions = feedback_actions
        self._faults = program.faults

    def answer(self, method: str, arguments: tuple[object, ...]) -> object:
        """Call a function.

        Raises:
            NoAnswer: GXSM is blocked until a restart. NameError: there is no such function.
            WrongArguments: the arguments do not fit. SystemError: the instrument is busy, or an emulated error is due.
        """
        if method not in _FUNCTIONS:
            raise NameError(method)
        now_s = self._program.clock.now_s()
        # twice a second the bridge looks at this entry: a fault meant for a client would end the script instead
        is_own_look = (method, arguments) == ("get", (SCRIPT_CONTROL,))
        if not is_own_look and self._faults.strikes("error", now_s):
            raise SystemError("an emulated error")
        function, signature = _FUNCTIONS[method]
        if not _fits(signature, arguments):
            raise WrongArguments(method)
        try:
            found = function(self, *arguments)
        except InstrumentBusy as busy:
            raise SystemError(str(busy)) from busy
        if not is_own_look and self._faults.strikes("wrong-type", now_s):
            return "\x04"
        return found

    # --- parameters ---

    @_function
    def _list_refnames(self) -> tuple[str, ...]:
        return self._program.entries.names()

    @_function
    def _list_actions(self) -> tuple[str, ...]:
        program = self._program
        found = ["CHECK-MainAutoSave", "UNCHECK-MainAutoSave", "CHECK-SCAN-REPEAT", "UNCHECK-SCAN-REPEAT"]
        modes = _MODES[program.card]
        found += [f"DSP_VP_{mode}_EXECUTE" for mode in modes]
        if program.version == 3:
            found += [f"CHECK-{mode}" for mode in modes]
        if program.card == "SRanger":
            found += ["DSP_CMD_AUTOAPP", "DSP_CMD_STOPALL", "DSP_CMD_MOV-XP_XY"]
        if program.card == "RPSPMC":
            found += ["GVP_CMD_UP_Z0", "GVP_CMD_DN_Z0"]
        return (*found, *self._feedback_actions)

    @_function
    def _set(self, ref: str, value: str) -> int:
        if self._faults.strikes("refused", self._program.clock.now_s()):
            self._program.dialogs.append(f"Valid Range of {ref}")
            return 0
        takes_all = self._faults.lasts("takes-all", self._program.clock.now_s())
        return self._program.entries.set(ref, value, takes_all=takes_all)

    @_function
    def _get(self, ref: str) -> float | str:
        if ref != SCRIPT_CONTROL and self._faults.strikes("nan", self._program.clock.now_s()):
            return math.nan
        return self._program.entries.get(ref)

    @_function
    def _gets(self, ref: str) -> str:
        return self._program.entries.gets(ref)

    @_function
    def _action(self, name: str) -> object:
        program = self._program
        kind, _, switch = name.partition("-")
        if kind in ("CHECK", "UNCHECK") and switch == "MainAutoSave":
            program.panel.auto_save = kind == "CHECK"
        elif kind in ("CHECK", "UNCHECK") and switch == "SCAN-REPEAT":
            program.panel.repeats = kind == "CHECK"
        elif name == "GETCHECK-MainAutoSave" and program.version == 4:
            return "TRUE" if program.panel.auto_save else "FALSE"
        elif name in self._list_actions():
            self._do(name)
        return Uninitialised() if program.version == 3 else 0

    def _do(self, name: str) -> None:
        program, rig = self._program, self._program.rig
        now_s = program.clock.now_s()
        if name in self._feedback_actions:
            rig.switch_feedback(now_s, on=name == self._feedback_actions[0])
        elif name.startswith("CHECK-") and name.removeprefix("CHECK-") in _MODES[program.card]:
            program.panel.probe_auto_save = True
        elif name == "DSP_VP_ABORT_EXECUTE":
            rig.stop_spectrum(now_s)
            program.curve = None
        elif name.startswith("DSP_VP_"):
            mode = name.split("_")[2]
            depth = -program.entries["dsp-Z-end"] * ANGSTROM_M if mode == "FZ" else 0.0
            if depth > 0.0:
                rig.crash(depth, program.entries["dsp-Z-Slope"] * ANGSTROM_M, now_s)
                return
            program.take_curve(_KINDS.get(mode, "IV"))
        elif name == "DSP_CMD_AUTOAPP":
            rig.engage(now_s)
        elif name == "DSP_CMD_STOPALL":
            program.stop_scan()

    # --- what goes on ---

    @_function
    def _rtquery(self, code: str) -> tuple[float, float, float]:
        program = self._program
        now_s = program.clock.now_s()
        if self._faults.strikes("garbage", now_s):
            return (_NEVER_WRITTEN, 1.4e-45, -2.7e209)
        if code in ("s", "S") or (code == "W" and program.version == 4):
            return (float(self._bits(now_s)), _NEVER_WRITTEN, _NEVER_WRITTEN)
        if code in ("o", "O"):
            volts = program.entries["OffsetX"] / _VOLT, program.entries["OffsetY"] / _VOLT
            return (0.0, *volts)
        shown = program.rig.signals(now_s) if code in ("f", "R", "z") else {}
        if code == "f":
            return (shown.get("Frequency Shift", 0.0), shown["Current"] * 1e9, 0.0)
        if code in ("p", "P"):
            return self._pixel(now_s, centred=code == "p")
        if code == "R":
            return (shown["Height"] / ANGSTROM_M, program.entries["ScanX"], program.entries["ScanY"])
        if code == "z":
            x_m, y_m = program.rig.probe_at(now_s)
            volt_m = _VOLT * ANGSTROM_M
            return (shown["Height"] / volt_m, x_m / volt_m, y_m / volt_m)
        return (_NEVER_WRITTEN, _NEVER_WRITTEN, _NEVER_WRITTEN)

    def _pixel(self, now_s: float, *, centred: bool) -> tuple[float, float, float]:
        rows, columns = self._program.scan.activity.shape if self._program.scan.activity is not None else (0, 0)
        x, y = columns // 2, self._program.y_current(now_s)
        return (float(x - columns // 2), float(rows // 2 - y), 0.0) if centred else (float(x), float(y), 0.0)

    def _bits(self, now_s: float) -> int:
        program = self._program
        doing, scan = program.rig.doing(now_s), program.rig.scan
        scanning = doing == "scan" and scan is not None and now_s >= scan.start_s + program.scan.shows_s
        scanning = scanning or (program.is_between_repeats and not doing)
        paused, probing = scanning and scan is not None and scan.paused, doing == "spectrum"
        feedback = program.rig.feedback_reads(now_s)
        if program.card == "RPSPMC":
            ended = not (scanning or probing) and scan is not None
            return feedback + 2 * (scanning or probing) + 4 * paused + 16 * ended
        bits = feedback + 2 * scanning
        if program.card == "SRanger":
            bits += 4 * paused + 8 * probing + 16 * (doing == "move") + 128 * (doing == "approach")
        return bits

    @_function
    def _y_current(self) -> int:
        return self._program.y_current(self._program.clock.now_s())

    @_function
    def _startscan(self) -> int:
        self._program.start_scan()
        return 0

    @_function
    def _stopscan(self) -> int:
        self._program.stop_scan()
        return 0

    @_function
    def _waitscan(self, how: int = 0) -> int:
        program = self._program
        if program.version == 4 and program.card == "simulator":
            raise NoAnswer("waitscan")
        return -1 if not program.rig.busy(program.clock.now_s()) else self._y_current()

    @_function
    def _autosave(self) -> int:
        self._program.save(self._program.clock.now_s())
        return self._y_current()

    @_function
    def _chfname(self, channel: int) -> str:
        names = self._program.names(self._program.clock.now_s())
        if channel < 0 or channel % 100 >= len(names):
            return "EE: invalid channel"
        return self._program.shown(names[channel % 100])

    @_function
    def _moveto_scan_xy(self, x: float, y: float) -> float:
        return self._program.move_tip(float(x), float(y))

    # --- data ---

    @_function
    def _get_geometry(self, channel: int) -> tuple[float, ...]:
        if not self._has(channel):
            return (0.0,) * 5
        x, y, width, height, angle_deg = self._program.scan.frame
        return (width, height, x, y, angle_deg)

    @_function
    def _get_dimensions(self, channel: int) -> tuple[int, ...]:
        scan = self._program.scan.activity
        if scan is None or not self._has(channel):
            return (_NOBODY,) * 4
        return (scan.shape[1], scan.shape[0], self._program.panel.layers, 1)

    @_function
    def _get_differentials(self, channel: int) -> tuple[float, ...]:
        if not self._has(channel):
            return (0.0,) * 4
        _, _, width, height, _ = self._program.scan.frame
        columns, rows, _, _ = self._get_dimensions(channel)
        return (width / (columns - 1), height / (rows - 1), self._program.channels[channel].dz, 10.0)

    def _has(self, channel: int) -> bool:
        return 0 <= channel < len(self._program.channels)

    @_function
    def _get_slice(self, channel: int, value: int, time: int, first: int, count: int) -> object:
        program = self._program
        if program.scan.activity is None or not self._has(channel):
            return -1
        one = program.channels[channel]
        if time >= 0 and program.version == 4:
            program.retrieve()
        image = program.image(one)
        if first < 0 or count < 0 or first + count > len(image):
            return -1
        return image[first : first + count].astype(np.float64) * one.dz

    @_function
    def _get_probe_event(self, channel: int, nth: int) -> object:
        program = self._program
        curve = program.rig.spectrum
        if curve is None or curve is program.curve:
            return 0
        columns = program.columns(curve)
        labels = [label.rpartition(" (")[0] for label in columns]
        units = [label.rpartition(" (")[2].rstrip(")") for label in columns]
        where = (program.entries["ScanX"], program.entries["ScanY"], 0.0, 0.0)
        return np.array([*columns.values()]), labels, units, where
