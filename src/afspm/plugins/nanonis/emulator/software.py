"""The Nanonis software: its modules, patterns and utilities."""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics import Clock
from afspm.emulation import ControllerClock, Faults, SimulatedInstrument
from afspm.plugins.nanonis.emulator import as_reported
from afspm.plugins.nanonis.emulator.core import NanonisCore
from afspm.plugins.nanonis.emulator.dispatch import Answer, Dispatcher, FunctionRefused, answers, chosen
from afspm.plugins.nanonis.emulator.files import read_dat
from afspm.plugins.nanonis.emulator.scans import ScanModule
from afspm.plugins.nanonis.emulator.session import SessionFolder, checked_name
from afspm.plugins.nanonis.emulator.signals import Signals
from afspm.plugins.nanonis.emulator.spectra import SpectroscopyModules
from afspm.plugins.nanonis.emulator.tip import TipModules, ZController

_RANGE_Z_M: Final = 2e-6
_EXPERIMENTS: Final = {"Bias Spectroscopy": "IV", "Z Spectroscopy": "force"}
_PATTERNS: Final = ("Grid", "Line", "Cloud")
_BUSY: Final = "pattern"


class NanonisSoftware:
    """The emulated Nanonis software: all its modules, with one simulated instrument.

    Args:
        session_path: session folder's path on the controller's computer; empty: the path of `folder`.
        range_m: range of the scanner in x and y.
        rows_as_recorded, unscanned, clips_frames: see `ScanModule`.
        reported: see `NanonisCore`.
    """

    def __init__(
        self,
        rig: SimulatedInstrument,
        faults: Faults,
        clock: Clock,
        folder: Path,
        *,
        session_path: str,
        range_m: float,
        release: int,
        rows_as_recorded: bool,
        unscanned: float,
        clips_frames: bool,
        file_clock: ControllerClock,
        log: logging.Logger,
        reported: Collection[str] = (),
    ) -> None:
        session = SessionFolder(folder, session_path, faults, file_clock, log)
        self.core = NanonisCore(rig, faults, clock, file_clock, session, (range_m, range_m, _RANGE_Z_M), release, log)
        self.core.reported = reported
        self.signals = Signals(self.core)
        self.scans = ScanModule(
            self.core,
            self.signals,
            rows_as_recorded=rows_as_recorded,
            unscanned=unscanned,
            clips_frames=clips_frames,
        )
        self.spectra = SpectroscopyModules(self.core, self.signals)
        self.z_controller = ZController(self.core, self.scans, self.signals)
        self.tip = TipModules(self.core, self.scans, self.z_controller)
        modules = (
            self.signals,
            self.scans,
            self.spectra,
            self.z_controller,
            self.tip,
            PatternModule(self.core),
            Utilities(self.core),
        )
        self.functions = Dispatcher(self.core.registers, modules)
        if as_reported.CLOSED_MODULES in reported:
            self.functions.close("TipShaper")

    def advance(self, now_s: float) -> float | None:
        """Advance faults, scans, spectra and files; return the time of the next delayed scan or file, None without."""
        self.z_controller.go_wrong(now_s)
        self.tip.advance(now_s)
        starts_s = self.scans.advance(now_s)
        self.spectra.advance(now_s)
        late_s = self.core.session.write_late(now_s)
        return min((at_s for at_s in (starts_s, late_s) if at_s is not None), default=None)


class PatternModule:
    """Patterns of spectra (grid, line, cloud): only their duration is emulated, no data is saved."""

    def __init__(self, core: NanonisCore) -> None:
        self._core = core

    @answers("Pattern.PropsSet")
    def _set_properties(self, experiment: str, base_name: str, path: str, delay_s: float, save_channels: int) -> Answer:
        before = self._core.registers.get("Pattern.Props")
        if experiment and experiment not in _EXPERIMENTS:
            raise FunctionRefused(f"there is no experiment {experiment!r}")
        names = experiment or before[0], checked_name(base_name) or before[1]
        self._core.registers.put("Pattern.Props", *names, path, delay_s, save_channels)
        return ()

    @answers("Pattern.PropsGet")
    def _properties(self) -> Answer:
        return list(_EXPERIMENTS), *self._core.registers.get("Pattern.Props")[1:]

    @answers("Pattern.ExpOpen")
    def _open(self) -> Answer:
        self._core.opened.add("Pattern")
        return ()

    @answers("Pattern.ExpStart")
    def _start(self, pattern: int) -> Answer:
        if "Pattern" not in self._core.opened:
            raise FunctionRefused("the experiment is not open")
        registers, rig = self._core.registers, self._core.rig
        active = chosen(pattern, (*registers.get("Pattern.Active"), _PATTERNS[0])[0], *_PATTERNS)
        first, second, *_ = (*registers.get(f"Pattern.{active}"), 1, 1)
        points = first * second if active == "Grid" else first
        if points < 1:
            raise FunctionRefused(f"a pattern of {points} points")
        kind = _EXPERIMENTS[registers.get("Pattern.Props")[0]]
        rig.occupy(_BUSY, points * rig.world.spectrum_s(kind), self._core.now_s)
        registers.put("Pattern.Active", active)
        return ()

    @answers("Pattern.ExpStop")
    def _stop(self) -> Answer:
        self._core.rig.stop(_BUSY, self._core.now_s)
        return ()

    @answers("Pattern.ExpStatusGet")
    def _status(self) -> Answer:
        return (int(self._core.rig.doing(self._core.now_s) == _BUSY),)


class Utilities:
    """Session path, version, lock and files."""

    def __init__(self, core: NanonisCore) -> None:
        self._core = core

    @answers("Util.SessionPathSet")
    def _set_session_path(self, path: str, save_settings: int) -> Answer:
        self._core.session.change(path)
        return ()

    @answers("Util.SessionPathGet")
    def _session_path(self) -> Answer:
        return (self._core.session.path,)

    @answers("Util.VersionGet")
    def _version(self) -> Answer:
        return "Nanonis SPM Control Software", "Generic 5", self._core.release, self._core.release

    @answers("File.datLoad")
    def _load(self, path: str, header_only: int) -> Answer:
        # (! dat-rows)
        try:
            found = read_dat(self._core.session.read(path))
        except (OSError, ValueError) as error:
            raise FunctionRefused(f"{path!r} can't be loaded: {error}") from error
        return ([], np.zeros((0, 0)), found.header) if header_only else (found.columns, found.values.T, found.header)

    @answers("Util.Lock", "Util.UnLock")
    def _lock(self) -> Answer:
        return ()
