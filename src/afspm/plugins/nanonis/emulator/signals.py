"""Signals of the Nanonis software: names, units, present values, the Signals Manager and the TCP Logger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from afspm.emulation import RETRACE, SpectrumActivity
from afspm.plugins.nanonis.emulator.as_reported import QPLUS_NAMES
from afspm.plugins.nanonis.emulator.core import NanonisCore
from afspm.plugins.nanonis.emulator.dispatch import Answer, FunctionRefused, answers
from afspm.plugins.nanonis.emulator.logger import LARGEST_OVERSAMPLING, TcpLogger

CHANNELS: Final = {"Current": 0, "Height": 14, "Phase": 16, "Amplitude": 17, "Frequency Shift": 18}
"""Index of the signal by simulated channel."""
NAMES: Final = {"Height": "Z", "Frequency Shift": "OC M1 Freq. Shift"}
_CURRENT, _BIAS = CHANNELS["Current"], 24
_OF_QPLUS: Final = {"Amplitude": "OC D1 Amplitude", "Phase": "OC D1 Phase"}
_UNITS: Final = {"Current": "A", "Height": "m", "Phase": "deg", "Amplitude": "V", "Frequency Shift": "Hz"}
_OF_SPECTRA: Final = {"Deflection": (20, "m"), "Force": (21, "N"), "dI/dV": (22, "S")}
"""Signals of spectra only: index and unit."""
_SWEPT: Final = {"Bias": "Bias calc", "Z": "Z rel"}
_SLOTS: Final = 24
_GAINS: Final = [f"LN 10^{decade}" for decade in range(3, 12)]
_BIAS_RANGES: Final = ["10 V", "1 V"]
_ADDITIONAL: Final = ["Counter 1 (Hz)", "Counter 2 (Hz)"]


class Signals:
    """The signals, and the functions for signals, current, bias range, PLL and TCP Logger.

    Attributes:
        names: names with units of the 128 signals.
        called: names in the software of the simulated channels, where they differ.
        slots: indexes of the signals in the 24 slots of the Signals Manager.
    """

    def __init__(self, core: NanonisCore) -> None:
        self._core, self._registers = core, core.registers
        self.called = {**NAMES, **(_OF_QPLUS if QPLUS_NAMES in core.reported else {})}
        self.names = _signal_names(self.called)
        used = [*CHANNELS.values(), _BIAS]
        self.slots = [*used, *(index for index in range(len(self.names)) if index not in used)][:_SLOTS]
        self.logger = TcpLogger()
        if core.measures_frequency_shift:
            sensor = core.rig.world.settings.feedback.sensor
            self._registers.set("PLL.CenterFreqSet", [1, sensor.resonance_hz])
            self._registers.set("PLL.AmpCtrlSetpntSet", [1, sensor.oscillation_m])

    def values(self, indexes: Sequence[int], now_s: float) -> list[float]:
        """Return the values of signals at one time; unused signals are zero."""
        rig = self._core.rig
        shown = rig.signals(now_s)
        values = {CHANNELS[name]: value for name, value in shown.items() if name in CHANNELS}
        values |= {CHANNELS["Height"]: self._z_m(shown["Height"]), _BIAS: rig.setup.bias_v}
        return [values.get(index, 0.0) for index in indexes]

    def z_m(self, now_s: float) -> float:
        """Return the height of the tip in m."""
        return self._z_m(self._core.rig.signals(now_s)["Height"])

    def _z_m(self, shown_m: float) -> float:
        # A withdrawn tip is at the upper end of the range.
        return shown_m if self._core.rig.engaged else self._core.range_m[2] / 2 + shown_m

    # --- the Signals Manager ---

    @answers("Signals.NamesGet", "Signals.MeasNamesGet")
    def _names(self) -> Answer:
        return (self.names,)

    @answers("Signals.ValGet")
    def _value(self, index: int, wait: int) -> Answer:
        self._check(index)
        return tuple(self.values([index], self._core.now_s))

    @answers("Signals.ValsGet")
    def _values(self, indexes: list[int], wait: int) -> Answer:
        self._check(*indexes)
        return (self.values(indexes, self._core.now_s),)

    @answers("Signals.InSlotSet")
    def _set_slot(self, slot: int, index: int) -> Answer:
        self._check(index)
        if not 0 <= slot < len(self.slots):
            raise FunctionRefused(f"there is no slot {slot}")
        self.slots[slot] = index
        return ()

    @answers("Signals.InSlotsGet")
    def _slots(self) -> Answer:
        return [self.names[index] for index in self.slots], self.slots

    @answers("Signals.RangeGet")
    def _range(self, index: int) -> Answer:
        self._check(index)
        return 10.0, -10.0

    @answers("Signals.CalibrGet")
    def _calibration(self, index: int) -> Answer:
        self._check(index)
        return 1.0, 0.0

    @answers("Signals.AddRTGet")
    def _additional(self) -> Answer:
        first, second = (*self._registers.get("Signals.AddRT"), 0, 1)[:2]
        return _ADDITIONAL, _ADDITIONAL[first], _ADDITIONAL[second]

    @answers("Signals.AddRTSet")
    def _set_additional(self, first: int, second: int) -> Answer:
        if not (0 <= first < len(_ADDITIONAL) and 0 <= second < len(_ADDITIONAL)):
            raise FunctionRefused("there are no such signals")
        self._registers.put("Signals.AddRT", first, second)
        return ()

    def _check(self, *indexes: int) -> None:
        for index in indexes:
            if not 0 <= index < len(self.names):
                raise FunctionRefused(f"there is no signal {index}")

    # --- current, bias range and frequency shift ---

    @answers("Current.Get", "SafeTip.SignalGet")
    def _current(self) -> Answer:
        return tuple(self.values([_CURRENT], self._core.now_s))

    @answers("Current.GainSet")
    def _set_gain(self, gain: int, filter_: int) -> Answer:
        no_change = -1
        if not no_change <= gain < len(_GAINS):
            raise FunctionRefused(f"there is no gain {gain}")
        if gain != no_change:
            self._registers.put("Current.Gain", gain)
        return ()

    @answers("Current.GainsGet")
    def _gains(self) -> Answer:
        return _GAINS, self._registers.get("Current.Gain")[0], [], 0

    @answers("Bias.RangeGet")
    def _bias_ranges(self) -> Answer:
        return _BIAS_RANGES, (*self._registers.get("Bias.Range"), 0)[0]

    @answers("Bias.RangeSet")
    def _set_bias_range(self, index: int) -> Answer:
        if index >= len(_BIAS_RANGES):
            raise FunctionRefused(f"there is no range {index}")
        self._registers.put("Bias.Range", index)
        return ()

    @answers("PLL.FreqShiftGet")
    def _frequency_shift(self, modulator: int) -> Answer:
        # Only the first modulator measures; the others return stored values.
        if modulator == 1 and self._core.measures_frequency_shift:
            return tuple(self.values([CHANNELS["Frequency Shift"]], self._core.now_s))
        return self._registers.got("PLL.FreqShiftGet", [modulator])

    @answers("PLL.AmpCtrlGainGet", "PLL.PhasCtrlGainGet")
    def _gain(self, name: str, modulator: int) -> Answer:
        # I = P / T follows from P and T, and can't be set.
        proportional, time_s, _ = self._registers.got(name, [modulator])
        return proportional, time_s, proportional / time_s if time_s else 0.0

    @answers("PLL.FreqShiftAutoCenter")
    def _center_frequency(self, modulator: int) -> Answer:
        (shift_hz,) = self._registers.got("PLL.FreqShiftGet", [modulator])
        (center_hz,) = self._registers.got("PLL.CenterFreqGet", [modulator])
        self._registers.set("PLL.CenterFreqSet", [modulator, center_hz + shift_hz])
        self._registers.set("PLL.FreqShiftSet", [modulator, 0.0])
        return ()

    # --- the TCP Logger ---

    @answers("TCPLog.ChsSet")
    def _set_logged(self, slots: list[int]) -> Answer:
        if not slots or not all(0 <= slot < len(self.slots) for slot in slots):
            raise FunctionRefused("channels are slots of the Signals Manager, 0 to 23")
        self.logger.slots = slots
        return ()

    @answers("TCPLog.OversamplSet")
    def _set_oversampling(self, oversampling: int) -> Answer:
        if not 0 <= oversampling <= LARGEST_OVERSAMPLING:
            raise FunctionRefused(f"the oversampling is 0 to {LARGEST_OVERSAMPLING}")
        self.logger.oversampling = max(1, oversampling)
        return ()

    @answers("TCPLog.Start")
    def _start_log(self) -> Answer:
        if not self.logger.slots:
            raise FunctionRefused("no channels are selected")
        self.logger.start(self._core.now_s)
        return ()

    @answers("TCPLog.Stop")
    def _stop_log(self) -> Answer:
        self.logger.stop()
        return ()

    @answers("TCPLog.StatusGet")
    def _log_status(self) -> Answer:
        return (self.logger.status(),)


def spectrum_columns(curve: SpectrumActivity) -> list[str]:
    """Return the column names as in Nanonis' files ("Current [bwd] (A)"), with the swept signal first."""
    columns: list[str] = []
    for name, unit in zip(curve.names, curve.units, strict=True):
        forward = name.removesuffix(RETRACE)
        called = NAMES.get(forward, forward) if columns else _SWEPT.get(forward, forward)
        columns.append(f"{called}{'' if forward == name else ' [bwd]'} ({unit})")
    return columns


def name_and_unit(signal: str) -> tuple[str, str]:
    """Split "Current (A)" into name and unit."""
    name, _, unit = signal.removesuffix(")").rpartition(" (")
    return name, unit


def spectrum_signal(column: str) -> int | None:
    """Return the signal index of a simulated spectrum's column; None without a signal."""
    name = column.removesuffix(RETRACE)
    return CHANNELS.get(name) if name in CHANNELS else _OF_SPECTRA.get(name, (None,))[0]


def _signal_names(called: Mapping[str, str]) -> list[str]:
    signals = [f"Input {number + 1} (V)" for number in range(128)]
    for name, index in CHANNELS.items():
        signals[index] = f"{called.get(name, name)} ({_UNITS[name]})"
    for name, (index, unit) in _OF_SPECTRA.items():
        signals[index] = f"{name} ({unit})"
    signals[_BIAS] = "Bias (V)"
    return signals
