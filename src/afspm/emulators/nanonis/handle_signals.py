"""Signals, and the software itself."""

from __future__ import annotations

from typing import Final

from afspm.emulators.nanonis.dispatch import Answer, FunctionRefused, answers
from afspm.emulators.nanonis.logger import LARGEST_OVERSAMPLING
from afspm.emulators.nanonis.panel import CURRENT, NanonisState

_GAINS: Final = [f"LN 10^{decade}" for decade in range(3, 12)]
_BIAS_RANGES: Final = ["10 V", "1 V"]
_ADDITIONAL: Final = ["Counter 1 (Hz)", "Counter 2 (Hz)"]


@answers("Signals.NamesGet")
def _signal_names(panel: NanonisState) -> Answer:
    return (panel.signals,)


def _known(panel: NanonisState, *indexes: int) -> None:
    for index in indexes:
        if not 0 <= index < len(panel.signals):
            raise FunctionRefused(f"there is no signal {index}")


@answers("Signals.ValGet")
def _signal_value(panel: NanonisState, index: int, wait: int) -> Answer:
    _known(panel, index)
    return tuple(panel.signal_values([index], panel.clock.now_s()))


@answers("Signals.ValsGet")
def _signal_values(panel: NanonisState, indexes: list[int], wait: int) -> Answer:
    _known(panel, *indexes)
    return (panel.signal_values(indexes, panel.clock.now_s()),)


@answers("Signals.MeasNamesGet")
def _measured_names(panel: NanonisState) -> Answer:
    return (panel.signals,)


@answers("Signals.InSlotSet")
def _slot_set(panel: NanonisState, slot: int, index: int) -> Answer:
    _known(panel, index)
    if not 0 <= slot < len(panel.slots):
        raise FunctionRefused(f"there is no slot {slot}")
    panel.slots[slot] = index
    return ()


@answers("Signals.InSlotsGet")
def _slots(panel: NanonisState) -> Answer:
    return [panel.signals[index] for index in panel.slots], panel.slots


@answers("Signals.RangeGet")
def _signal_range(panel: NanonisState, index: int) -> Answer:
    _known(panel, index)
    return 10.0, -10.0


@answers("Signals.CalibrGet")
def _signal_calibration(panel: NanonisState, index: int) -> Answer:
    _known(panel, index)
    return 1.0, 0.0


@answers("Current.Get", "SafeTip.SignalGet")
def _current(panel: NanonisState) -> Answer:
    return tuple(panel.signal_values([CURRENT], panel.clock.now_s()))


@answers("Current.GainSet")
def _gain_set(panel: NanonisState, gain: int, filter_: int) -> Answer:
    no_change = -1
    if not no_change <= gain < len(_GAINS):
        raise FunctionRefused(f"there is no gain {gain}")
    if gain != no_change:
        panel.registers.put("Current.Gain", gain)
    return ()


@answers("Current.GainsGet")
def _gains(panel: NanonisState) -> Answer:
    return _GAINS, panel.registers.get("Current.Gain")[0], [], 0


@answers("Bias.RangeGet")
def _bias_ranges(panel: NanonisState) -> Answer:
    return _BIAS_RANGES, (*panel.registers.get("Bias.Range"), 0)[0]


@answers("Bias.RangeSet")
def _bias_range_set(panel: NanonisState, index: int) -> Answer:
    if index >= len(_BIAS_RANGES):
        raise FunctionRefused(f"there is no range {index}")
    panel.registers.put("Bias.Range", index)
    return ()


@answers("Util.SessionPathSet")
def _session_path_set(panel: NanonisState, path: str, save_settings: int) -> Answer:
    panel.set_session_path(path)
    return ()


@answers("Signals.AddRTGet")
def _additional(panel: NanonisState) -> Answer:
    first, second = (*panel.registers.get("Signals.AddRT"), 0, 1)[:2]
    return _ADDITIONAL, _ADDITIONAL[first], _ADDITIONAL[second]


@answers("Signals.AddRTSet")
def _additional_set(panel: NanonisState, first: int, second: int) -> Answer:
    if not (0 <= first < len(_ADDITIONAL) and 0 <= second < len(_ADDITIONAL)):
        raise FunctionRefused("there are no such signals")
    panel.registers.put("Signals.AddRT", first, second)
    return ()


@answers("TCPLog.ChsSet")
def _logged_set(panel: NanonisState, slots: list[int]) -> Answer:
    if not slots or not all(0 <= slot < len(panel.slots) for slot in slots):
        raise FunctionRefused("channels are slots of the Signals Manager, 0 to 23")
    panel.logger.slots = slots
    return ()


@answers("TCPLog.OversamplSet")
def _log_oversampling_set(panel: NanonisState, oversampling: int) -> Answer:
    if not 0 <= oversampling <= LARGEST_OVERSAMPLING:
        raise FunctionRefused(f"the oversampling is 0 to {LARGEST_OVERSAMPLING}")
    panel.logger.oversampling = max(1, oversampling)
    return ()


@answers("TCPLog.Start")
def _start_log(panel: NanonisState) -> Answer:
    if not panel.logger.slots:
        raise FunctionRefused("no channels are selected")
    panel.logger.start(panel.clock.now_s())
    return ()


@answers("TCPLog.Stop")
def _stop_log(panel: NanonisState) -> Answer:
    panel.logger.stop()
    return ()


@answers("TCPLog.StatusGet")
def _log_status(panel: NanonisState) -> Answer:
    return (panel.logger.status(),)


@answers("PLL.FreqShiftGet")
def _frequency_shift(panel: NanonisState, modulator: int) -> Answer:
    """Return the measured shift of the first modulator, or the stored value of the others."""
    measured = panel.frequency_shift_hz(panel.clock.now_s()) if modulator == 1 else None
    return panel.registers.got("PLL.FreqShiftGet", [modulator]) if measured is None else (measured,)


@answers("PLL.FreqShiftAutoCenter")
def _center(panel: NanonisState, modulator: int) -> Answer:
    """The centre is where the frequency has shifted to."""
    (shift_hz,) = panel.registers.got("PLL.FreqShiftGet", [modulator])
    (center_hz,) = panel.registers.got("PLL.CenterFreqGet", [modulator])
    panel.registers.set("PLL.CenterFreqSet", [modulator, center_hz + shift_hz])
    panel.registers.set("PLL.FreqShiftSet", [modulator, 0.0])
    return ()


@answers("Util.Lock", "Util.UnLock")
def _lock(panel: NanonisState) -> Answer:
    return ()


@answers("Util.SessionPathGet")
def _session_path(panel: NanonisState) -> Answer:
    return (panel.session_path,)


@answers("Util.VersionGet")
def _version(panel: NanonisState) -> Answer:
    return "Nanonis SPM Control Software", "Generic 5", panel.release, panel.release
