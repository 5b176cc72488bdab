"""The tip: position, z controller, bias, piezos, tip shaper and coarse motor."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from afspm.plugins.nanonis.emulator import as_reported
from afspm.plugins.nanonis.emulator.core import GAIN_M, OUTPUT_V, NanonisCore
from afspm.plugins.nanonis.emulator.dispatch import Answer, FunctionRefused, answers, chosen
from afspm.plugins.nanonis.emulator.scans import ScanModule
from afspm.plugins.nanonis.emulator.signals import Signals

_Z_AVERAGED: Final = 20
_STEEPEST_DEG: Final = 45.0
_TRACKED_S: Final = 60.0
_STEP_M: Final = 100e-9


class ZController:
    """The z controller and the auto-approach.

    Attributes:
        state: "off", "on", or "safe" after the safe tip has withdrawn the tip.
        pulse_holds: True if a bias pulse puts the controller on hold.
    """

    def __init__(self, core: NanonisCore, scans: ScanModule, signals: Signals) -> None:
        self._core, self._scans, self._signals = core, scans, signals
        self.state = "on" if core.rig.setup.feedback.on else "off"
        self.pulse_holds = True
        self._follows_s = 0.0

    def go_wrong(self, now_s: float) -> None:
        """Let the safe tip withdraw the tip if such a fault is due."""
        faults, rig = self._core.faults, self._core.rig
        if faults.strikes("safe-tip", now_s):
            rig.withdraw(now_s)
            self.state = "safe"
        if self._scans.running is not None and faults.strikes("safe-tip-unnoticed", now_s):
            rig.engaged = False
            self.state = "safe"

    def switch(self, now_s: float, *, on: bool, off_delay_s: float = 0.0) -> None:
        """Switch at once; after switching off, report "switching off" for `off_delay_s`.

        Switching on brings back a withdrawn tip.
        """
        rig = self._core.rig
        self.state = "on" if on else "off"
        self._follows_s = now_s + (0.0 if on else off_delay_s)
        lift_m = (*self._core.registers.get("ZCtrl.TipLift"), 0.0)[0]
        lifts = not on and rig.setup.feedback.on and rig.engaged and self._scans.running is None
        z_m = float(np.mean([self._signals.z_m(now_s) for _ in range(_Z_AVERAGED)])) if lifts and lift_m else 0.0
        rig.switch_feedback(now_s, on=on)
        if z_m:
            rig.hold(z_m + lift_m, now_s)
        if on and not rig.approaches(now_s):
            rig.reach()

    def _status(self, now_s: float) -> int:
        # The protocol's codes: off 1, on 2, hold 3, switching off 4, safe tip 5, withdrawing 6.
        doing = self._core.rig.doing(now_s)
        if doing == "approach" and not self._core.rig.engaged and not self._core.rig.approaches(now_s):
            return 6
        if self.state == "on" and (doing in ("crash", "shaper") or (doing == "pulse" and self.pulse_holds)):
            return 3
        if self.state == "off" and now_s < self._follows_s:
            return 4
        # in a spectrum it follows `feedback.hold_reads` (! hold-in-spectrum)
        if self.state == "on" and not self._core.rig.feedback_reads(now_s):
            return 3
        if as_reported.UNKNOWN_STATUS in self._core.reported and self.state == "on":
            return as_reported.UNKNOWN_Z_STATUS
        return {"off": 1, "on": 2, "safe": 5}[self.state]

    @answers("ZCtrl.StatusGet")
    def _get_status(self) -> Answer:
        return (self._status(self._core.now_s),)

    @answers("ZCtrl.OnOffSet")
    def _set_on(self, on: int) -> Answer:
        self.switch(self._core.now_s, on=bool(on), off_delay_s=self._core.registers.get("ZCtrl.SwitchOffDelay")[0])
        return ()

    @answers("ZCtrl.OnOffGet")
    def _get_on(self) -> Answer:
        # The state of the real-time controller, which is still on while switching off.
        return (int(self._status(self._core.now_s) in (2, 4, as_reported.UNKNOWN_Z_STATUS)),)

    @answers("ZCtrl.ZPosSet")
    def _set_position(self, z_m: float) -> Answer:
        if self.state == "on":
            raise FunctionRefused("the Z-Controller is on")
        self._core.rig.hold(z_m, self._core.now_s)
        return ()

    @answers("ZCtrl.ZPosGet")
    def _get_position(self) -> Answer:
        return (self._signals.z_m(self._core.now_s),)

    @answers("ZCtrl.Home")
    def _home(self) -> Answer:
        # (! home-with-feedback)
        relative, home_m = (*self._core.registers.get("ZCtrl.HomeProps"), 0, 0.0)[:2]
        z_m = self._signals.z_m(self._core.now_s)
        self.switch(self._core.now_s, on=False)
        self._core.rig.hold(home_m + (z_m if relative else 0.0), self._core.now_s)
        return ()

    @answers("ZCtrl.SetpntSet")
    def _set_setpoint(self, setpoint: float) -> Answer:
        self._core.rig.setup.feedback = replace(self._core.rig.setup.feedback, setpoint=setpoint)
        return ()

    @answers("ZCtrl.SetpntGet")
    def _get_setpoint(self) -> Answer:
        return (self._core.rig.setup.feedback.setpoint or 0.0,)

    @answers("ZCtrl.GainSet")
    def _set_gain(self, proportional: float, time_s: float, integral: float) -> Answer:
        # I = P / T; an I in the request counts only without T.
        integral = proportional / time_s if time_s > 0.0 else integral
        rig = self._core.rig
        p, i = proportional / GAIN_M, integral / GAIN_M
        rig.setup.feedback = replace(rig.setup.feedback, proportional_gain=p, integral_gain=i)
        return ()

    @answers("ZCtrl.GainGet")
    def _get_gain(self) -> Answer:
        feedback = self._core.rig.setup.feedback
        proportional, integral = (
            GAIN_M * (gain or 0.0) for gain in (feedback.proportional_gain, feedback.integral_gain)
        )
        return proportional, proportional / integral if integral else math.inf, integral

    @answers("ZCtrl.CtrlListGet")
    def _list(self) -> Answer:
        return [self._core.z_controller_name[0]], 0

    @answers("ZCtrl.Withdraw")
    def _withdraw(self, wait: int, timeout_ms: int) -> Answer:
        # An auto-approach that goes on brings the tip back, as in the real software.
        if not self._approaches():
            rig = self._core.rig
            rig.withdraw(self._core.now_s)
            self.state = "off"
            rig.switch_feedback(self._core.now_s, on=False)
        return self._core.until_free(wait, timeout_ms)

    @answers("AutoApproach.Open")
    def _open_approach(self) -> Answer:
        return ()

    @answers("AutoApproach.OnOffSet")
    def _set_approach(self, on: int) -> Answer:
        if on:
            self._core.rig.approach(self._core.now_s)
            self.switch(self._core.now_s, on=True)
        elif self._approaches():
            self._core.rig.withdraw(self._core.now_s)
        return ()

    @answers("AutoApproach.OnOffGet")
    def _get_approach(self) -> Answer:
        return (int(self._approaches()),)

    def _approaches(self) -> bool:
        return self._core.rig.approaches(self._core.now_s)


class TipModules:
    """The functions for position, bias, tip shaper, piezos, atom tracking and coarse motor."""

    def __init__(self, core: NanonisCore, scans: ScanModule, z_controller: ZController) -> None:
        self._core, self._scans, self._z_controller = core, scans, z_controller
        self._has_own_speed, self._own_speed_m_s = True, core.rig.setup.move_speed_m_s
        self._motor_m, self._motor_walk = (0.0, 0.0, 0.0), (0, 0, 0.0)
        self._shapes_at_s = math.inf

    # --- position ---

    @answers("FolMe.XYPosSet")
    def _set_position(self, x: float, y: float, wait: int) -> Answer:
        if self._scans.running is not None:
            raise FunctionRefused("the tip can't be moved while it scans")
        rig = self._core.rig
        rig.setup.move_speed_m_s = self._own_speed_m_s if self._has_own_speed else self._scans.speed[0]
        if not self._core.takes_all:
            reach_x, reach_y = self._core.reach_m
            x, y = float(np.clip(x, -reach_x, reach_x)), float(np.clip(y, -reach_y, reach_y))
        rig.move_probe((x, y), self._core.now_s)
        return self._core.until_free(wait)

    @answers("FolMe.XYPosGet")
    def _get_position(self, wait: int) -> Answer:
        return self._core.rig.probe_at(self._core.now_s)

    @answers("FolMe.SpeedSet")
    def _set_speed(self, speed_m_s: float, own: int) -> Answer:
        if speed_m_s <= 0.0:
            raise FunctionRefused("no such speed")
        self._own_speed_m_s, self._has_own_speed = speed_m_s, bool(own)
        return ()

    @answers("FolMe.SpeedGet")
    def _get_speed(self) -> Answer:
        return self._own_speed_m_s, int(self._has_own_speed)

    @answers("FolMe.Stop")
    def _stop(self) -> Answer:
        self._core.rig.stop_move(self._core.now_s)
        return ()

    # --- bias and tip shaper ---

    @answers("Bias.Set")
    def _set_bias(self, bias_v: float) -> Answer:
        if not abs(bias_v) <= 10.0 and not self._core.takes_all:
            raise FunctionRefused("the bias is limited to 10 V")
        self._core.rig.setup.bias_v = bias_v
        return ()

    @answers("Bias.Get")
    def _get_bias(self) -> Answer:
        return (self._core.rig.setup.bias_v,)

    @answers("Bias.Pulse")
    def _pulse(self, wait: int, width_s: float, bias_v: float, hold: int, absolute: int) -> Answer:
        relative = 1
        self._core.rig.pulse(
            bias_v + (self._core.rig.setup.bias_v if absolute == relative else 0.0), width_s, self._core.now_s
        )
        if hold:
            self._z_controller.pulse_holds = hold == 1
        return self._core.until_free(wait or self._blocks())

    @answers("TipShaper.Start")
    def _shape(self, wait: int, timeout_ms: int) -> Answer:
        if as_reported.SLOW_SHAPER in self._core.reported:
            late_s = as_reported.SHAPER_BEGINS_LATE_S
            self._core.rig.occupy("shaper", late_s, self._core.now_s)
            self._shapes_at_s = self._core.now_s + late_s
            return self._core.until_free(wait or self._blocks(), timeout_ms)
        self._shape_now()
        return self._core.until_free(wait or self._blocks(), timeout_ms)

    def advance(self, now_s: float) -> None:
        """Begin a shaping of the tip that is due."""
        if now_s >= self._shapes_at_s:
            self._shapes_at_s = math.inf
            self._shape_now()

    def _shape_now(self) -> None:
        props = self._core.registers.get("TipShaper.Props")
        lift_m, lift_s, restore = props[3], props[4], props[10]
        if lift_m < 0.0:
            self._core.rig.crash(-lift_m, -lift_m / max(lift_s, 1e-6), self._core.now_s)
        else:
            self._core.rig.occupy("shaper", lift_s, self._core.now_s)
        if not restore:
            self._z_controller.switch(self._core.now_s, on=False)

    def _blocks(self) -> int:
        core = self._core
        return int(as_reported.BLOCKING_PULSE in core.reported or core.faults.lasts("blocks", core.now_s))

    # --- piezos and drift compensation ---

    @answers("Piezo.TiltSet")
    def _set_tilt(self, x_deg: float, y_deg: float) -> Answer:
        if not max(abs(x_deg), abs(y_deg)) < _STEEPEST_DEG and not self._core.takes_all:
            raise FunctionRefused("that is not a tilt")
        self._core.registers.put("Piezo.Tilt", x_deg, y_deg)
        self._core.rig.setup.slope = (math.tan(math.radians(x_deg)), math.tan(math.radians(y_deg)))
        return ()

    @answers("Piezo.RangeGet")
    def _get_range(self) -> Answer:
        return self._core.range_m

    @answers("Piezo.CalibrGet")
    def _get_calibration(self) -> Answer:
        return tuple(range_m / (2 * OUTPUT_V) for range_m in self._core.range_m)

    @answers("Piezo.RangeSet")
    def _set_range(self, *range_m: float) -> Answer:
        if not min(range_m) > 0.0:
            raise FunctionRefused("that is not a range")
        self._core.range_m = (range_m[0], range_m[1], range_m[2])
        return ()

    @answers("Piezo.DriftCompSet")
    def _set_drift(self, on: int, *rest: float) -> Answer:
        was_on, *_ = (*self._core.registers.get("Piezo.DriftComp"), 0)
        x, y, z, *limit = rest
        now_on = chosen(on, was_on, 1, 0)
        if not now_on:
            self._core.registers.put("Piezo.DriftSaturated", 0, 0, 0)
        self._core.rig.follow((x, y) if now_on else (0.0, 0.0), self._core.now_s)
        self._core.registers.put("Piezo.DriftComp", now_on, x, y, z, limit[0] if limit else 10.0)
        return ()

    @answers("Piezo.DriftCompGet")
    def _get_drift(self) -> Answer:
        on, x, y, z, limit = self._core.registers.get("Piezo.DriftComp") or (0, 0.0, 0.0, 0.0, 10.0)
        return on, x, y, z, *(self._core.registers.get("Piezo.DriftSaturated") or (0, 0, 0)), limit

    @answers("AtomTrack.QuickCompStart", "AtomTrack.DriftComp")
    def _compensate(self, *which: int) -> Answer:
        # The drift that tracking an atom under the tip would find. There is no tilt to correct.
        drift = 1
        if which in ((), (drift,)):
            world, now_s = self._core.rig.world, self._core.now_s
            times_s = np.array([now_s - _TRACKED_S, now_s])
            atom_m = world.sample.to_sample(self._core.rig.probe_at(now_s), now_s)
            tracked_m = np.column_stack([world.sample.to_tip([atom_m, atom_m], times_s), world.drift_m(times_s)[:, 2]])
            x, y, z = ((tracked_m[1] - tracked_m[0]) / _TRACKED_S).tolist()
            return self._set_drift(1, x, y, z)
        return ()

    # --- coarse motor ---

    @answers("Motor.StartMove")
    def _start_motor(self, direction: int, steps: int, group: int, wait: int) -> Answer:
        # refused during a scan or a withdrawal (! motor-in-scan)
        if direction > 5:
            raise FunctionRefused(f"{direction} is not a direction")
        now_s = self._core.now_s
        at_m = self._motor_at_m(now_s)
        way = 1 if direction % 2 == 0 else -1
        axis = direction // 2
        along = (way if axis == 0 else 0, way if axis == 1 else 0, way if axis == 2 else 0)
        self._core.rig.step(along, steps, _STEP_M, now_s)
        self._motor_m, self._motor_walk = at_m, (direction // 2, -steps if direction % 2 else steps, now_s)
        return self._core.until_free(wait)

    @answers("Motor.StopMove")
    def _stop_motor(self) -> Answer:
        now_s = self._core.now_s
        self._motor_m, self._motor_walk = self._motor_at_m(now_s), (0, 0, now_s)
        self._core.rig.stop("stage", self._core.now_s)
        return ()

    @answers("Motor.PosGet")
    def _motor_position(self, group: int, timeout_ms: int) -> Answer:
        return self._motor_at_m(self._core.now_s)

    def _motor_at_m(self, now_s: float) -> tuple[float, float, float]:
        axis, steps, since_s = self._motor_walk
        walked = math.copysign(min(abs(steps), (now_s - since_s) / self._core.rig.coarse_step_s), steps)
        at_m = list(self._motor_m)
        at_m[axis] += int(walked) * _STEP_M
        return at_m[0], at_m[1], at_m[2]
