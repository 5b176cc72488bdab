"""Spectra."""

from __future__ import annotations

from typing import Any

import numpy as np

from afspm.emulators.nanonis.answers import Answer, Later, Nope, Results, answers, chosen
from afspm.emulators.nanonis.panel import MODULES, Panel, curve_columns
from afspm.emulators.running import RunningSpectrum


@answers("BiasSpectr.Open", "ZSpectr.Open")
def _open(panel: Panel, name: str) -> Answer:
    panel.registers[name] = (1,)
    return ()


def _module(panel: Panel, name: str) -> str:
    module = name.split(".")[0]
    if f"{module}.Open" not in panel.registers:
        raise Nope(f"the module {module} is not open")
    return module


@answers("BiasSpectr.StatusGet", "ZSpectr.StatusGet")
def _curve_status(panel: Panel, name: str) -> Answer:
    kind = MODULES[_module(panel, name)]
    curve = panel.curve
    return (int(curve is not None and curve.kind == kind and curve.running(panel.clock.now_s())),)


@answers("BiasSpectr.Start", "ZSpectr.Start")
def _start_curve(panel: Panel, name: str, get_data: int, base_name: str) -> Answer:
    panel.start_curve(_module(panel, name), base_name)
    curve, ended = panel.curve, panel.curves_ended
    if not get_data or curve is None:
        return [], np.zeros((0, 0)), []
    return Later(lambda _: _curve_data(curve) if panel.curves_ended > ended else None)


def _curve_data(curve: RunningSpectrum) -> Results:
    """A row for each channel."""
    return curve_columns(curve), curve.values.T, [*curve.position_m]


@answers("BiasSpectr.Stop", "ZSpectr.Stop")
def _stop_curve(panel: Panel, name: str) -> Answer:
    _module(panel, name)
    panel.stop_curve()
    return ()


@answers("BiasSpectr.PropsSet", "ZSpectr.PropsSet")
def _curve_props_set(panel: Panel, name: str, *props: Any) -> Answer:
    module = _module(panel, name)
    autosave = props[5] if module == "BiasSpectr" else props[3]
    panel.autosave_curves[module] = bool(chosen(autosave, panel.autosave_curves[module], 1, 0))
    panel.registers[f"{module}.Props"] = props
    return ()


@answers("BiasSpectr.PropsGet", "ZSpectr.PropsGet")
def _curve_props_get(panel: Panel, name: str) -> Answer:
    fixed, parameters = ["X (m)", "Y (m)"], ["Sweep Start (V)"]
    channels = ["Current (A)"]
    if _module(panel, name) == "BiasSpectr":
        return 0, 1, 1, 256, channels, parameters, fixed
    return 1, 512, parameters, fixed, 1, 0


@answers("BiasSpectr.ChsGet", "ZSpectr.ChsGet")
def _curve_channels(panel: Panel, name: str) -> Answer:
    indexes = panel.registers.get(f"{_module(panel, name)}.Chs", ([0],))[0]
    return indexes, [panel.signals[index] for index in indexes]
