"""The modules for bias and z spectroscopy: sweep settings, the running spectrum, and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from afspm.basics import ConfigError
from afspm.emulation import SpectrumActivity, SweptCurve
from afspm.plugins.nanonis.emulator import as_reported, files
from afspm.plugins.nanonis.emulator.core import NanonisCore
from afspm.plugins.nanonis.emulator.dispatch import (
    Answer,
    DeferredResult,
    FunctionRefused,
    NoResult,
    OldLayout,
    Results,
    answers,
    chosen,
)
from afspm.plugins.nanonis.emulator.session import checked_name
from afspm.plugins.nanonis.emulator.signals import CHANNELS, Signals, name_and_unit, spectrum_columns, spectrum_signal

_KINDS: Final = {"BiasSpectr": "IV", "ZSpectr": "force"}
_CHANNELS: Final = {"BiasSpectr": (0, 22), "ZSpectr": (20, 21)}
"""Indexes of the signals in simulated spectra; bias spectra of a sensor have its frequency shift as well."""
_TITLES: Final = {"BiasSpectr": "bias spectroscopy", "ZSpectr": "Z spectroscopy"}
_FILE_NAMES: Final = {"BiasSpectr": "Bias-Spectroscopy", "ZSpectr": "Z-Spectroscopy"}
_MOST_POINTS: Final = 1 << 16


@dataclass
class SweepSettings:
    """Sweep settings of a spectroscopy module.

    Attributes:
        points: number of points; None: as in the simulated spectrum.
        limits: first and last bias; None: as in the simulated spectrum.
        sweeps: number of averaged sweeps.
        channels: indexes of recorded signals; None: all signals of the simulated spectrum.
        backward: True if the spectrum is also swept backwards.
        saves: True if a file is written.
        saves_all, dialog: stored without effect.
    """

    points: int | None = None
    limits: tuple[float, float] | None = None
    sweeps: int = 1
    channels: list[int] | None = None
    backward: bool = True
    saves: bool = True
    saves_all: bool = False
    dialog: bool = False

    def kept(self, curve: SpectrumActivity) -> SpectrumActivity:
        """Return the spectrum without the way back unless it is swept, too."""
        kept = [k for k, name in enumerate(curve.names) if self.backward or not name.endswith(" Retrace")]
        return replace(
            curve,
            values=curve.values[:, kept],
            names=tuple(curve.names[k] for k in kept),
            units=tuple(curve.units[k] for k in kept),
        )


class SpectroscopyModules:
    """The functions of both spectroscopy modules, and the running spectrum.

    Attributes:
        sweeps: sweep settings by module.
        running: the running spectrum; None without a spectrum.
        module: the module of the last spectrum.
        ended: number of ended spectra, completed or stopped.
    """

    def __init__(self, core: NanonisCore, signals: Signals) -> None:
        self._core, self._signals = core, signals
        self._reported = core.reported
        saves = as_reported.UNSAVED_CURVES not in core.reported
        self.sweeps = {module: SweepSettings(saves=saves) for module in _KINDS}
        self.running: SpectrumActivity | None = None
        self.module = "BiasSpectr"
        self.ended = 0
        self._stopped: tuple[SpectrumActivity | None, float] = (None, 0.0)
        self._base_names = dict(_FILE_NAMES)

    def advance(self, now_s: float) -> None:
        """End and save the spectrum once its duration has passed."""
        curve = self.running
        if curve is None or curve.running(now_s):
            return
        self.running = None
        self.ended += 1
        module = self.module
        if self.sweeps[module].saves and not self._core.faults.lasts("autosave-off", now_s):
            content = files.dat(self._header(module, curve, now_s), spectrum_columns(curve), curve.values)
            session = self._core.session
            session.save(session.next_name(self._base_names[module], 5, ".dat"), content, now_s)

    def start(self, module: str, base_name: str) -> None:
        """Start a spectrum. Raises InstrumentBusy; InvalidValue: `base_name` can't be part of a file's name."""
        self._base_names[module] = checked_name(base_name) or self._base_names[module]
        sweep = self.sweeps[module]
        swept = self._swept(module, sweep)
        try:
            curve = self._core.rig.start_spectrum(self._kind(module), self._core.now_s, sweep.sweeps, swept)
        except ConfigError as error:  # values beyond any instrument
            raise FunctionRefused(str(error)) from error
        curve, self.module = sweep.kept(curve), module
        self.running = curve if sweep.channels is None else self._recorded(curve, sweep.channels)

    def _swept(self, module: str, sweep: SweepSettings) -> SweptCurve:
        # what no client has set is as in the simulated spectrum
        changed = self._core.registers.changed
        timing, z_range, modulation = changed(f"{module}.Timing"), changed("ZSpectr.Range"), changed("LockIn.ModAmp", 1)
        point_s = sum(timing[4:6] if module == "BiasSpectr" else timing[3:5]) if timing else None
        if module == "ZSpectr":
            towards = -1.0 if as_reported.Z_SWEEP_TOWARDS in self._reported else 1.0
            ends = None if z_range is None else (z_range[0], z_range[0] + towards * z_range[1])
            return SweptCurve(ends, sweep.points, point_s)
        z_offset_m = timing[1] if timing else 0.0
        return SweptCurve(sweep.limits, sweep.points, point_s, z_offset_m, modulation[0] if modulation else None)

    def _kind(self, module: str) -> str:
        # A sweep of z that records neither deflection nor force is for current and frequency shift, near the setpoint.
        channels = self.sweeps[module].channels
        presses = channels is None or not set(channels).isdisjoint(_CHANNELS["ZSpectr"])
        return "z" if module == "ZSpectr" and not presses else _KINDS[module]

    def _recorded(self, curve: SpectrumActivity, channels: list[int]) -> SpectrumActivity:
        # A recorded channel that the simulated spectrum lacks is constant.
        names, units, columns = [curve.names[0]], [curve.units[0]], [curve.values[:, 0]]
        for index in channels:
            having = [k for k, name in enumerate(curve.names) if spectrum_signal(name) == index]
            for k in having:
                names.append(curve.names[k])
                units.append(curve.units[k])
                columns.append(curve.values[:, k])
            if not having:
                name, unit = name_and_unit(self._signals.names[index])
                names.append(name)
                units.append(unit)
                columns.append(np.full(len(curve.values), self._signals.values([index], curve.start_s)[0]))
        return replace(curve, names=tuple(names), units=tuple(units), values=np.stack(columns, axis=1))

    def _header(self, module: str, curve: SpectrumActivity, now_s: float) -> dict[str, str]:
        (x, y), number, shown_s = curve.position_m, files.engineering, self._core.file_clock.shown_s
        return {
            "Experiment": _TITLES[module],
            "Saved Date": files.moment(shown_s(now_s)),
            "User": "",
            "Date": "",
            "X (m)": number(x),
            "Y (m)": number(y),
            "Z (m)": number(0.0),
            "Start time": files.moment(shown_s(curve.start_s)),
            "Bias>Bias (V)": number(self._core.rig.setup.bias_v),
        }

    # --- functions ---

    @answers("BiasSpectr.Open", "ZSpectr.Open")
    def _open(self, name: str) -> Answer:
        self._core.opened.add(name.partition(".")[0])
        return ()

    def _module(self, name: str) -> str:
        module = name.partition(".")[0]
        if module not in self._core.opened:
            raise FunctionRefused(f"the module {module} is not open")
        return module

    @answers("BiasSpectr.StatusGet", "ZSpectr.StatusGet")
    def _status(self, name: str) -> Answer:
        module, curve = self._module(name), self.running
        if as_reported.CURVE_STATUS in self._reported:
            return NoResult()
        return (int(curve is not None and self.module == module and curve.running(self._core.now_s)),)

    @answers("BiasSpectr.Start", "ZSpectr.Start")
    def _start(self, name: str, get_data: int, base_name: str) -> Answer:
        self.start(self._module(name), base_name)
        curve, ended = self.running, self.ended
        if not get_data or curve is None:
            return [], np.zeros((0, 0)), []

        def ready(now_s: float) -> Results | None:
            if self.ended == ended:
                return None
            # (! stopped-spectrum)
            values = curve.values.copy()
            values[self._measured(curve) :] = np.nan
            if as_reported.BACKWARD_BY_TIME in self._reported:
                back = [k for k, name in enumerate(curve.names) if name.endswith(" Retrace")]
                values[:, back] = values[::-1, back]
            return spectrum_columns(curve), values.T, [*curve.position_m, float(curve.values[0, 0])]

        return DeferredResult(ready)

    @answers("BiasSpectr.Stop", "ZSpectr.Stop")
    def _stop(self, name: str) -> Answer:
        self._module(name)
        if self.running is not None:
            self._stopped = (self.running, self._core.now_s)
            self._core.rig.stop_spectrum(self._core.now_s)
            self.running = None
            self.ended += 1
        return ()

    def _measured(self, curve: SpectrumActivity) -> int:
        stopped, at_s = self._stopped
        points = len(curve.values)
        if stopped is not curve:
            return points
        return int(points * (at_s - curve.start_s) / (curve.end_s - curve.start_s))

    @answers("BiasSpectr.PropsSet")
    def _set_bias_properties(
        self, save_all: int, sweeps: int, backward: int, points: int, z_off_m: float, autosave: int, dialog: int
    ) -> Answer:
        timing = self._core.registers.get("BiasSpectr.Timing")
        if not math.isnan(z_off_m) and z_off_m != timing[1]:  # also an entry of TimingSet
            self._core.registers.put("BiasSpectr.Timing", timing[0], z_off_m, *timing[2:])
        return self._set_properties("BiasSpectr", points, sweeps, (backward, autosave, save_all, dialog))

    @answers("ZSpectr.PropsSet")
    def _set_z_properties(
        self, backward: int, points: int, sweeps: int, autosave: int, dialog: int, save_all: int
    ) -> Answer:
        return self._set_properties("ZSpectr", points, sweeps, (backward, autosave, save_all, dialog))

    def _set_properties(self, module: str, points: int, sweeps: int, switches: tuple[int, int, int, int]) -> Answer:
        sweep = self.sweeps[self._module(module)]
        if not (points == 0 or 2 <= points <= _MOST_POINTS) or sweeps < 0:
            raise FunctionRefused(f"a spectrum of {points} points, {sweeps} sweeps")
        before = (sweep.backward, sweep.saves, sweep.saves_all, sweep.dialog)
        now = [chosen(switch, was, 1, 0) for switch, was in zip(switches, before, strict=True)]
        sweep.backward, sweep.saves, sweep.saves_all, sweep.dialog = map(bool, now)
        sweep.points, sweep.sweeps = points or sweep.points, sweeps or sweep.sweeps
        return ()

    @answers("BiasSpectr.PropsGet", "ZSpectr.PropsGet")
    def _properties(self, name: str) -> Answer:
        found = self._properties_of(self._module(name))
        return OldLayout(found) if as_reported.CURVE_LAYOUT in self._reported else found

    def _properties_of(self, module: str) -> Results:
        sweep, channels = self.sweeps[module], self._channel_names(module)
        backward, saves, saves_all, dialog = map(int, (sweep.backward, sweep.saves, sweep.saves_all, sweep.dialog))
        fixed = ["X (m)", "Y (m)"]
        settings = self._core.rig.world.settings
        if module == "BiasSpectr":
            points = sweep.points or settings.iv.points
            return saves_all, sweep.sweeps, backward, points, channels, ["Sweep Start (V)"], fixed, saves, dialog
        points = sweep.points or settings.force.points
        return backward, points, channels, ["Sweep Start (m)"], fixed, sweep.sweeps, saves, dialog, saves_all

    @answers("ZSpectr.RangeSet")
    def _set_range(self, offset_m: float, way_m: float) -> Answer:
        way_m = abs(way_m) if as_reported.Z_SWEEP_TOWARDS in self._reported else way_m
        self._core.registers.set("ZSpectr.RangeSet", (offset_m, way_m))
        return ()

    @answers("BiasSpectr.LimitsSet")
    def _set_limits(self, first_v: float, last_v: float) -> Answer:
        self.sweeps["BiasSpectr"].limits = (first_v, last_v)
        return ()

    @answers("BiasSpectr.LimitsGet")
    def _limits(self) -> Answer:
        range_v = self._core.rig.world.settings.iv.range_v
        return self.sweeps["BiasSpectr"].limits or (-range_v, range_v)

    @answers("BiasSpectr.ChsSet", "ZSpectr.ChsSet")
    def _set_channels(self, name: str, indexes: list[int]) -> Answer:
        module = self._module(name)
        if not indexes or not all(0 <= index < len(self._signals.names) for index in indexes):
            raise FunctionRefused("there are no such channels")
        self.sweeps[module].channels = list(dict.fromkeys(indexes))
        return ()

    @answers("BiasSpectr.ChsGet", "ZSpectr.ChsGet")
    def _get_channels(self, name: str) -> Answer:
        module = self._module(name)
        return self._channels(module), self._channel_names(module)

    def _channels(self, module: str) -> list[int]:
        recorded = self.sweeps[module].channels
        if recorded is not None:
            return recorded
        senses_shift = module == "BiasSpectr" and self._core.measures_frequency_shift
        return [*_CHANNELS[module], *([CHANNELS["Frequency Shift"]] if senses_shift else [])]

    def _channel_names(self, module: str) -> list[str]:
        return [self._signals.names[index] for index in self._channels(module)]
