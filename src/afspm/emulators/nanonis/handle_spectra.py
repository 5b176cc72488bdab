"""Spectra."""

from __future__ import annotations

import numpy as np

from afspm.emulators.activities import SimulatedSpectrum
from afspm.emulators.nanonis.dispatch import Answer, DeferredResult, FunctionRefused, Results, answers, chosen
from afspm.emulators.nanonis.panel import MODULES, MOST_POINTS, NanonisState, curve_columns


@answers("BiasSpectr.Open", "ZSpectr.Open")
def _open(panel: NanonisState, name: str) -> Answer:
    panel.opened.add(name.partition(".")[0])
    return ()


def _module(panel: NanonisState, name: str) -> str:
    module = name.split(".")[0]
    if module not in panel.opened:
        raise FunctionRefused(f"the module {module} is not open")
    return module


@answers("BiasSpectr.StatusGet", "ZSpectr.StatusGet")
def _curve_status(panel: NanonisState, name: str) -> Answer:
    kind = MODULES[_module(panel, name)]
    curve = panel.curve
    return (int(curve is not None and curve.kind == kind and curve.running(panel.clock.now_s())),)


@answers("BiasSpectr.Start", "ZSpectr.Start")
def _start_curve(panel: NanonisState, name: str, get_data: int, base_name: str) -> Answer:
    panel.start_curve(_module(panel, name), base_name)
    curve, ended = panel.curve, panel.curves_ended
    if not get_data or curve is None:
        return [], np.zeros((0, 0)), []
    return DeferredResult(lambda _: _curve_data(curve) if panel.curves_ended > ended else None)


def _curve_data(curve: SimulatedSpectrum) -> Results:
    """A row for each channel; then the fixed parameters, and what else was set."""
    return curve_columns(curve), curve.values.T, [*curve.position_m, float(curve.values[0, 0])]


@answers("BiasSpectr.Stop", "ZSpectr.Stop")
def _stop_curve(panel: NanonisState, name: str) -> Answer:
    _module(panel, name)
    panel.stop_curve()
    return ()


@answers("BiasSpectr.PropsSet")
def _bias_props_set(
    panel: NanonisState,
    save_all: int,
    sweeps: int,
    backward: int,
    points: int,
    z_off_m: float,
    autosave: int,
    dialog: int,
) -> Answer:
    return _props_set(panel, "BiasSpectr", points, sweeps, (backward, autosave, save_all, dialog))


@answers("ZSpectr.PropsSet")
def _z_props_set(
    panel: NanonisState, backward: int, points: int, sweeps: int, autosave: int, dialog: int, save_all: int
) -> Answer:
    return _props_set(panel, "ZSpectr", points, sweeps, (backward, autosave, save_all, dialog))


def _props_set(
    panel: NanonisState, module: str, points: int, sweeps: int, switches: tuple[int, int, int, int]
) -> Answer:
    sweep = panel.sweeps[_module(panel, module)]
    if not (points == 0 or 2 <= points <= MOST_POINTS) or sweeps < 0:
        raise FunctionRefused(f"a spectrum of {points} points, {sweeps} sweeps")
    before = (sweep.backward, sweep.saves, sweep.saves_all, sweep.dialog)
    on = True
    now = [chosen(switch, was, on, not on) for switch, was in zip(switches, before, strict=True)]
    sweep.backward, sweep.saves, sweep.saves_all, sweep.dialog = now
    sweep.points, sweep.sweeps = points or sweep.points, sweeps or sweep.sweeps
    return ()


@answers("BiasSpectr.PropsGet", "ZSpectr.PropsGet")
def _curve_props_get(panel: NanonisState, name: str) -> Answer:
    module = _module(panel, name)
    sweep, channels = panel.sweeps[module], _channel_names(panel, module)
    switches = (sweep.backward, sweep.saves, sweep.saves_all, sweep.dialog)
    backward, saves, saves_all, dialog = map(int, switches)
    fixed = ["X (m)", "Y (m)"]
    if module == "BiasSpectr":
        points = sweep.points or panel.rig.world.settings.iv.points
        return saves_all, sweep.sweeps, backward, points, channels, ["Sweep Start (V)"], fixed, saves, dialog
    points = sweep.points or panel.rig.world.settings.force.points
    return backward, points, channels, ["Sweep Start (m)"], fixed, sweep.sweeps, saves, dialog, saves_all


@answers("BiasSpectr.LimitsSet")
def _limits_set(panel: NanonisState, first_v: float, last_v: float) -> Answer:
    panel.sweeps["BiasSpectr"].limits = (first_v, last_v)
    return ()


@answers("BiasSpectr.LimitsGet")
def _limits_get(panel: NanonisState) -> Answer:
    range_v = panel.rig.world.settings.iv.range_v
    return panel.sweeps["BiasSpectr"].limits or (-range_v, range_v)


@answers("BiasSpectr.ChsSet", "ZSpectr.ChsSet")
def _curve_channels_set(panel: NanonisState, name: str, indexes: list[int]) -> Answer:
    module = _module(panel, name)
    if not indexes or not all(0 <= index < len(panel.signals) for index in indexes):
        raise FunctionRefused("there are no such channels")
    panel.sweeps[module].channels = list(dict.fromkeys(indexes))
    return ()


@answers("BiasSpectr.ChsGet", "ZSpectr.ChsGet")
def _curve_channels(panel: NanonisState, name: str) -> Answer:
    module = _module(panel, name)
    return panel.curve_channels(module), _channel_names(panel, module)


def _channel_names(panel: NanonisState, module: str) -> list[str]:
    return [panel.signals[index] for index in panel.curve_channels(module)]
