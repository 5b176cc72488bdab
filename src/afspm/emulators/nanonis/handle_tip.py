"""The tip: where it is, the z controller, the bias, and what is done to it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from afspm.emulators.nanonis.dispatch import Answer, FunctionRefused, answers, chosen, until_free
from afspm.emulators.nanonis.panel import NanonisState

_STEEPEST_DEG: Final = 45.0
_TRACKED_S: Final = 60.0


@answers("FolMe.XYPosSet")
def _position_set(panel: NanonisState, x: float, y: float, wait: int) -> Answer:
    if panel.scanning is not None:
        raise FunctionRefused("the tip can't be moved while it scans")
    panel.rig.move_speed_m_s = panel.own_speed_m_s if panel.own_speed else panel.speed[0]
    reach_x, reach_y = panel.range_m[0] / 2, panel.range_m[1] / 2
    panel.rig.move_probe((float(np.clip(x, -reach_x, reach_x)), float(np.clip(y, -reach_y, reach_y))))
    return until_free(panel, wait)


@answers("FolMe.XYPosGet")
def _position_get(panel: NanonisState, wait: int) -> Answer:
    return panel.rig.probe_at(panel.clock.now_s())


@answers("FolMe.SpeedSet")
def _move_speed_set(panel: NanonisState, speed_m_s: float, own: int) -> Answer:
    if speed_m_s <= 0.0:
        raise FunctionRefused("no such speed")
    panel.own_speed_m_s, panel.own_speed = speed_m_s, bool(own)
    return ()


@answers("FolMe.SpeedGet")
def _move_speed_get(panel: NanonisState) -> Answer:
    return panel.own_speed_m_s, int(panel.own_speed)


@answers("FolMe.Stop")
def _stop_move(panel: NanonisState) -> Answer:
    panel.rig.stop_move()
    return ()


@answers("ZCtrl.OnOffSet")
def _z_on_off_set(panel: NanonisState, on: int) -> Answer:
    delay_s = panel.registers.get("ZCtrl.SwitchOffDelay")[0]
    panel.set_z_controller(panel.clock.now_s(), on=bool(on), off_delay_s=delay_s)
    return ()


@answers("ZCtrl.OnOffGet")
def _z_on_off_get(panel: NanonisState) -> Answer:
    return (int(panel.z_is_on(panel.clock.now_s())),)


@answers("ZCtrl.StatusGet")
def _z_status(panel: NanonisState) -> Answer:
    return (panel.z_status(panel.clock.now_s()),)


@answers("ZCtrl.ZPosSet")
def _z_position_set(panel: NanonisState, z_m: float) -> Answer:
    if panel.z_controller == "on":
        raise FunctionRefused("the Z-Controller is on")
    panel.rig.hold(z_m)
    return ()


@answers("ZCtrl.ZPosGet")
def _z_position_get(panel: NanonisState) -> Answer:
    return (panel.z_m(panel.clock.now_s()),)


@answers("ZCtrl.Home")
def _home(panel: NanonisState) -> Answer:
    """(!) Whether the real one refuses that while its controller is on is not known: here it is switched off."""
    relative, home_m = (*panel.registers.get("ZCtrl.HomeProps"), 0, 0.0)[:2]
    z_m = panel.z_m(panel.clock.now_s())
    panel.set_z_controller(panel.clock.now_s(), on=False)
    panel.rig.hold(home_m + (z_m if relative else 0.0))
    return ()


@answers("ZCtrl.SetpntSet")
def _setpoint_set(panel: NanonisState, setpoint: float) -> Answer:
    panel.rig.feedback = replace(panel.rig.feedback, setpoint=setpoint)
    return ()


@answers("ZCtrl.SetpntGet")
def _setpoint_get(panel: NanonisState) -> Answer:
    return (panel.rig.feedback.setpoint or 0.0,)


@answers("ZCtrl.GainSet")
def _gain_set(panel: NanonisState, proportional: float, time_s: float, integral: float) -> Answer:
    """I = P / T: P and T count."""
    integral = proportional / time_s if time_s > 0.0 else integral
    panel.rig.feedback = replace(panel.rig.feedback, proportional_gain=proportional, integral_gain=integral)
    return ()


@answers("ZCtrl.GainGet")
def _gain_get(panel: NanonisState) -> Answer:
    proportional, integral = panel.rig.feedback.proportional_gain or 0.0, panel.rig.feedback.integral_gain or 0.0
    return proportional, proportional / integral if integral else math.inf, integral


@answers("ZCtrl.CtrlListGet")
def _z_controllers(panel: NanonisState) -> Answer:
    return [panel.z_controller_name[0]], 0


@answers("ZCtrl.Withdraw")
def _withdraw(panel: NanonisState, wait: int, timeout_ms: int) -> Answer:
    """An auto-approach that goes on meanwhile brings the tip back."""
    if _approaches(panel):
        return until_free(panel, wait, timeout_ms)
    panel.rig.withdraw()
    panel.z_controller = "off"
    panel.rig.feedback = replace(panel.rig.feedback, on=False)
    return until_free(panel, wait, timeout_ms)


@answers("AutoApproach.OnOffSet")
def _approach_set(panel: NanonisState, on: int) -> Answer:
    if on:
        panel.rig.engage()
        panel.set_z_controller(panel.clock.now_s(), on=True)
    elif _approaches(panel):
        panel.rig.withdraw()
    return ()


@answers("AutoApproach.OnOffGet")
def _approach_get(panel: NanonisState) -> Answer:
    return (int(_approaches(panel)),)


def _approaches(panel: NanonisState) -> bool:
    return panel.rig.engaged and panel.rig.doing(panel.clock.now_s()) == "approach"


@answers("Bias.Set")
def _bias_set(panel: NanonisState, bias_v: float) -> Answer:
    if not abs(bias_v) <= 10.0:
        raise FunctionRefused("the bias is limited to 10 V")
    panel.rig.bias_v = bias_v
    return ()


@answers("Bias.Get")
def _bias_get(panel: NanonisState) -> Answer:
    return (panel.rig.bias_v,)


@answers("Bias.Pulse")
def _pulse(panel: NanonisState, wait: int, width_s: float, bias_v: float, hold: int, absolute: int) -> Answer:
    relative = 1
    panel.rig.pulse(bias_v + (panel.rig.bias_v if absolute == relative else 0.0), width_s)
    panel.pulse_holds = hold == 1 if hold else panel.pulse_holds
    return until_free(panel, wait)


@answers("TipShaper.Start")
def _shape(panel: NanonisState, wait: int, timeout_ms: int) -> Answer:
    props = panel.registers.get("TipShaper.Props")
    lift_m, lift_s, restore = props[3], props[4], props[10]
    if lift_m < 0.0:
        panel.rig.crash(-lift_m, -lift_m / max(lift_s, 1e-6))
    else:
        panel.rig.occupy("shaper", lift_s)
    if not restore:
        panel.set_z_controller(panel.clock.now_s(), on=False)
    return until_free(panel, wait, timeout_ms)


@answers("Piezo.TiltSet")
def _tilt_set(panel: NanonisState, x_deg: float, y_deg: float) -> Answer:
    if not max(abs(x_deg), abs(y_deg)) < _STEEPEST_DEG:
        raise FunctionRefused("that is no tilt")
    panel.registers.put("Piezo.Tilt", x_deg, y_deg)
    panel.rig.slope = (math.tan(math.radians(x_deg)), math.tan(math.radians(y_deg)))
    return ()


@answers("Piezo.RangeGet")
def _range(panel: NanonisState) -> Answer:
    return panel.range_m


@answers("Piezo.RangeSet")
def _range_set(panel: NanonisState, *range_m: float) -> Answer:
    if not min(range_m) > 0.0:
        raise FunctionRefused("that is no range")
    panel.range_m = (range_m[0], range_m[1], range_m[2])
    return ()


@answers("Piezo.DriftCompSet")
def _drift_set(panel: NanonisState, on: int, *rest: float) -> Answer:
    was_on, *_ = (*panel.registers.get("Piezo.DriftComp"), 0)
    x, y, z, *limit = rest
    now_on = chosen(on, was_on, 1, 0)
    panel.rig.follow((x, y) if now_on else (0.0, 0.0))
    panel.registers.put("Piezo.DriftComp", now_on, x, y, z, limit[0] if limit else 10.0)
    return ()


@answers("Piezo.DriftCompGet")
def _drift_get(panel: NanonisState) -> Answer:
    on, x, y, z, limit = panel.registers.get("Piezo.DriftComp") or (0, 0.0, 0.0, 0.0, 10.0)
    return on, x, y, z, 0, 0, 0, limit


@answers("AtomTrack.QuickCompStart", "AtomTrack.DriftComp")
def _compensate(panel: NanonisState, *which: int) -> Answer:
    """Compensate the drift that tracking the atom under the tip would have found; a tilt there is none of."""
    drift = 1
    if which in ((), (drift,)):
        world, now_s = panel.rig.world, panel.clock.now_s()
        times_s = np.array([now_s - _TRACKED_S, now_s])
        atom_m = world.sample.to_sample(panel.rig.probe_at(now_s), now_s)
        tracked_m = np.column_stack([world.sample.to_tip([atom_m, atom_m], times_s), world.drift_m(times_s)[:, 2]])
        x, y, z = ((tracked_m[1] - tracked_m[0]) / _TRACKED_S).tolist()
        return _drift_set(panel, 1, x, y, z)
    return ()


@answers("Motor.StartMove")
def _motor(panel: NanonisState, direction: int, steps: int, group: int, wait: int) -> Answer:
    """(!) Whether the real one refuses that during a scan or a withdrawal is not known; here it does."""
    if direction > 5:
        raise FunctionRefused(f"{direction} is no direction")
    panel.start_motor(direction // 2, -steps if direction % 2 else steps)
    return until_free(panel, wait)


@answers("Motor.StopMove")
def _stop_motor(panel: NanonisState) -> Answer:
    panel.stop_motor(panel.clock.now_s())
    return ()


@answers("Motor.PosGet")
def _motor_position(panel: NanonisState, group: int, timeout_ms: int) -> Answer:
    return panel.motor_at_m(panel.clock.now_s())


@answers("AutoApproach.Open")
def _open_approach(panel: NanonisState) -> Answer:
    return ()
