"""Signals, and the software itself."""

from __future__ import annotations

from afspm.emulators.nanonis.answers import Answer, Nope, answers
from afspm.emulators.nanonis.panel import Panel


@answers("Signals.NamesGet")
def _signal_names(panel: Panel) -> Answer:
    return (panel.signals,)


def _signal(panel: Panel, index: int) -> float:
    if not 0 <= index < len(panel.signals):
        raise Nope(f"there is no signal {index}")
    return panel.rig.bias_v if panel.signals[index] == "Bias (V)" else 0.0


@answers("Signals.ValGet")
def _signal_value(panel: Panel, index: int, wait: int) -> Answer:
    return (_signal(panel, index),)


@answers("Signals.ValsGet")
def _signal_values(panel: Panel, indexes: list[int], wait: int) -> Answer:
    return ([_signal(panel, index) for index in indexes],)


@answers("Signals.RangeGet")
def _signal_range(panel: Panel, index: int) -> Answer:
    return 10.0, -10.0


@answers("Signals.CalibrGet")
def _signal_calibration(panel: Panel, index: int) -> Answer:
    return 1.0, 0.0


@answers("Current.Get")
def _current(panel: Panel) -> Answer:
    return (0.0,)


@answers("Util.SessionPathGet")
def _session_path(panel: Panel) -> Answer:
    return (panel.session_path,)


@answers("Util.VersionGet")
def _version(panel: Panel) -> Answer:
    return "Nanonis SPM Control Software", "Generic 5", panel.release, panel.release
