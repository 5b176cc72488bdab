"""Spectra."""

from __future__ import annotations

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


@answers("BiasSpectr.PropsSet")
def _bias_props_set(
    panel: Panel, save_all: int, sweeps: int, backward: int, points: int, z_off_m: float, autosave: int, dialog: int
) -> Answer:
    return _props_set(panel, "BiasSpectr", backward, points, autosave)


@answers("ZSpectr.PropsSet")
def _z_props_set(
    panel: Panel, backward: int, points: int, sweeps: int, autosave: int, dialog: int, save_all: int
) -> Answer:
    return _props_set(panel, "ZSpectr", backward, points, autosave)


def _props_set(panel: Panel, module: str, backward: int, points: int, autosave: int) -> Answer:
    sweep = panel.sweeps[_module(panel, module)]
    on = 1
    changed = (chosen(backward, sweep.backward, on, 0), chosen(autosave, sweep.saves, on, 0))
    if points < 0 or points == 1:
        raise Nope(f"a spectrum of {points} points")
    sweep.backward, sweep.saves = map(bool, changed)
    sweep.points = points or sweep.points
    return ()


@answers("BiasSpectr.PropsGet", "ZSpectr.PropsGet")
def _curve_props_get(panel: Panel, name: str) -> Answer:
    module = _module(panel, name)
    sweep = panel.sweeps[module]
    fixed, parameters, channels = ["X (m)", "Y (m)"], ["Sweep Start (V)"], ["Current (A)"]
    if module == "BiasSpectr":
        points = sweep.points or panel.rig.world.settings.iv.points
        return 0, 1, int(sweep.backward), points, channels, parameters, fixed
    points = sweep.points or panel.rig.world.settings.force.points
    return int(sweep.backward), points, parameters, fixed, 1, 0


@answers("BiasSpectr.LimitsSet")
def _limits_set(panel: Panel, first_v: float, last_v: float) -> Answer:
    panel.sweeps["BiasSpectr"].limits = (first_v, last_v)
    return ()


@answers("BiasSpectr.LimitsGet")
def _limits_get(panel: Panel) -> Answer:
    range_v = panel.rig.world.settings.iv.range_v
    return panel.sweeps["BiasSpectr"].limits or (-range_v, range_v)


@answers("BiasSpectr.ChsGet", "ZSpectr.ChsGet")
def _curve_channels(panel: Panel, name: str) -> Answer:
    indexes = panel.registers.get(f"{_module(panel, name)}.Chs", ([0],))[0]
    return indexes, [panel.signals[index] for index in indexes]
