"""What each function of the protocol does at the emulated controller, and replies."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from afspm.emulators.nanonis.panel import MODULES, Panel, curve_columns
from afspm.emulators.running import RunningSpectrum

Results = tuple[Any, ...]


class Nope(Exception):
    """The controller can't, and says why."""


@dataclass(frozen=True)
class Later:
    """The reply comes when something has happened.

    Attributes:
        ready: gives the results once it has.
        until_s: or at that time, experiment seconds, with `timed_out`.
    """

    ready: Callable[[float], Results | None]
    until_s: float = math.inf
    timed_out: Results = ()


Answer = Results | Later
Handler = Callable[..., Answer]
HANDLERS: Final[dict[str, Handler]] = {}
_REGISTERS_AT_FIRST: Final[dict[str, Results]] = {
    "ZCtrl.SwitchOffDelay": (0.05,),
    "ZCtrl.ZPos": (0.0,),
    "BiasSpectr.Limits": (-1.5, 1.5),
    "BiasSpectr.Timing": (0.05, 0.0, 0.005, math.inf, 0.002, 0.001, 0.005, 0.2),
    "BiasSpectr.AdvProps": (1, 1, 0, 0),
    "ZSpectr.Range": (0.0, 120e-9),
    "Bias.Calibr": (1.0, 0.0),
    "Piezo.Sens": (3.8e-9, 3.8e-9, 0.9e-9),
    "TipShaper.Props": (0.1, 0, 0.0, -1e-9, 0.1, 0.0, 0.1, 1e-9, 0.1, 0.1, 1),
    "Util.RTFreq": (20e3,),
    "Util.AcqPeriod": (0.02,),
    "Util.RTOversampl": (10,),
    "FolMe.Oversampl": (10, 0.01),
    "SafeTip.Props": (0, 1, 1e-9),
}


def answers(*names: str) -> Callable[[Handler], Handler]:
    """Marks what answers to these functions; a second argument `name` is told which it was."""

    def marked(handler: Handler) -> Handler:
        HANDLERS.update(dict.fromkeys(names, handler))
        return handler

    return marked


def answer(panel: Panel, name: str, arguments: list[Any], zeros: Results) -> Answer:
    """What is done and replied.

    Args:
        zeros: results where nothing else is known.

    Raises:
        Nope, RigBusy.
    """
    handler = HANDLERS.get(name)
    if handler is not None:
        named = "name" in inspect.signature(handler).parameters
        return handler(panel, *([name] if named else []), *arguments)
    register = name.removesuffix("Set").removesuffix("Get")
    if name.endswith("Set"):
        panel.registers[register] = tuple(arguments)
        return ()
    if name.endswith("Get"):
        kept = panel.registers.get(register, _REGISTERS_AT_FIRST.get(register, ()))
        return kept if len(kept) == len(zeros) else zeros
    return zeros


def _ms(panel: Panel, timeout_ms: int) -> float:
    return math.inf if timeout_ms < 0 else panel.clock.now_s() + timeout_ms / 1000


def _chosen(number: int, *choices: Any) -> Any:
    """What a number stands for; as a rule 0 is what it is already."""
    if not 0 <= number < len(choices):
        raise Nope(f"{number} is none of the choices")
    return choices[number]


def _until_free(panel: Panel, wait: int, timeout_ms: int = -1) -> Answer:
    """At once, or once the instrument has done what it was told."""
    if not wait:
        return ()
    return Later(lambda now_s: None if panel.rig.busy(now_s) else (), _ms(panel, timeout_ms))


# --- scans ---


@answers("Scan.Action")
def _action(panel: Panel, action: int, direction: int) -> Answer:
    now_s, scan = panel.clock.now_s(), panel.rig.scan
    if action == 0:
        if panel.scanning is not None:  # it begins anew
            panel.rig.stop_scan()
            panel.advance(now_s)
        panel.start_scan(bool(direction))
    elif action == 1:
        panel.rig.stop_scan()
    elif action == 2 and scan is not None:
        scan.pause(now_s)
    elif action == 3 and scan is not None:
        scan.resume(now_s)
    elif action not in (2, 3, 4, 5, 6):
        raise Nope(f"{action} is no action")
    return ()


@answers("Scan.StatusGet")
def _scan_status(panel: Panel) -> Answer:
    running = panel.scanning is not None and panel.scanning.scan.running(panel.clock.now_s())
    return (int(running),)


@answers("Scan.WaitEndOfScan")
def _wait_end_of_scan(panel: Panel, timeout_ms: int) -> Answer:
    """Of the next end: one that has been is none."""
    ends = panel.ends
    return Later(lambda _: (0, panel.last_path) if panel.ends > ends else None, _ms(panel, timeout_ms), (1, ""))


@answers("Scan.FrameSet")
def _frame_set(panel: Panel, x: float, y: float, width: float, height: float, angle_deg: float) -> Answer:
    if not (min(width, height) > 0.0 and all(map(math.isfinite, (x, y, width, height, angle_deg)))):
        raise Nope("the frame is empty")
    panel.set_frame(x, y, width, height, angle_deg)
    return ()


@answers("Scan.FrameGet")
def _frame_get(panel: Panel) -> Answer:
    return panel.frame


@answers("Scan.BufferSet")
def _buffer_set(panel: Panel, channels: list[int], pixels: int, lines: int) -> Answer:
    if not all(0 <= channel < 128 for channel in channels) or pixels < 1 or lines < 0:
        raise Nope("no such channel or number of pixels")
    panel.set_buffer(channels, pixels, lines)
    return ()


@answers("Scan.BufferGet")
def _buffer_get(panel: Panel) -> Answer:
    return panel.channels, panel.pixels, panel.lines


@answers("Scan.SpeedSet")
def _speed_set(panel: Panel, *speed: Any) -> Answer:
    """1 keeps the speed and 2 the time; which of both is kept says which of both counts now."""
    forward, backward, forward_s, backward_s, keep, ratio = speed
    keeps_time = panel.speed[4] if keep == 0 else keep - 1
    width = panel.frame[2]
    if min(forward, backward, forward_s, backward_s) <= 0.0 or keep > 2:
        raise Nope("no such speed")
    if keeps_time:
        forward, backward = width / forward_s, width / backward_s
    else:
        forward_s, backward_s = width / forward, width / backward
    panel.speed = (forward, backward, forward_s, backward_s, keeps_time, ratio)
    return ()


@answers("Scan.SpeedGet")
def _speed_get(panel: Panel) -> Answer:
    return panel.speed


@answers("Scan.PropsSet")
def _props_set(
    panel: Panel, continuous: int, bouncy: int, autosave: int, series: str, comment: str, *rest: Any
) -> Answer:
    panel.continuous = bool(_chosen(continuous, panel.continuous, 1, 0))
    panel.bouncy = bool(_chosen(bouncy, panel.bouncy, 1, 0))
    panel.autosave = _chosen(autosave, panel.autosave, "all", "next", "off")
    panel.series, panel.comment = series or panel.series, comment
    if rest:
        panel.modules = rest[0]
    return ()


@answers("Scan.PropsGet")
def _props_get(panel: Panel) -> Answer:
    counts = [1] * len(panel.modules)
    table = [["Setpoint"] for _ in panel.modules]
    autosave = {"all": 0, "next": 1, "off": 2}[panel.autosave]
    flags = int(panel.continuous), int(panel.bouncy), autosave
    return *flags, panel.series, panel.comment, panel.modules, counts, table, 3


@answers("Scan.FrameDataGrab")
def _frame_data_grab(panel: Panel, channel: int, forward: int) -> Answer:
    last = panel.last
    if channel not in (last.channels if last else panel.channels):
        raise Nope("the channel is not among the acquired ones")
    now_s = panel.clock.now_s()
    if last is None or last.scan.drawing:
        raw, upwards = np.full((panel.lines, panel.pixels), np.nan), True
    else:
        *_, there, back = panel.images(last, now_s)[channel]
        raw, upwards = (there if forward else back[:, ::-1]), last.scan.upwards
    rows = raw if panel.rows_as_recorded and upwards else raw[::-1]
    return panel.signals[channel], rows, int(upwards)


@answers("Scan.XYPosGet")
def _scan_position(panel: Panel, wait: int) -> Answer:
    return panel.rig.probe_at(panel.clock.now_s())


@answers("Scan.Save")
def _save(panel: Panel, wait: int, timeout_ms: int) -> Answer:
    if panel.last is None:
        raise Nope("there is no scan to save")
    panel.save_scan(panel.last, panel.clock.now_s())
    return (0,)


# --- the tip ---


@answers("FolMe.XYPosSet")
def _position_set(panel: Panel, x: float, y: float, wait: int) -> Answer:
    if panel.scanning is not None:
        raise Nope("the tip can't be moved while it scans")
    panel.rig.move_speed_m_s = panel.own_speed_m_s if panel.own_speed else panel.speed[0]
    reach_x, reach_y = panel.range_m[0] / 2, panel.range_m[1] / 2
    panel.rig.move_probe((float(np.clip(x, -reach_x, reach_x)), float(np.clip(y, -reach_y, reach_y))))
    return _until_free(panel, wait)


@answers("FolMe.XYPosGet")
def _position_get(panel: Panel, wait: int) -> Answer:
    return panel.rig.probe_at(panel.clock.now_s())


@answers("FolMe.SpeedSet")
def _move_speed_set(panel: Panel, speed_m_s: float, own: int) -> Answer:
    if speed_m_s <= 0.0:
        raise Nope("no such speed")
    panel.own_speed_m_s, panel.own_speed = speed_m_s, bool(own)
    return ()


@answers("FolMe.SpeedGet")
def _move_speed_get(panel: Panel) -> Answer:
    return panel.own_speed_m_s, int(panel.own_speed)


@answers("FolMe.Stop")
def _stop_move(panel: Panel) -> Answer:
    panel.rig.stop_move()
    return ()


@answers("ZCtrl.OnOffSet")
def _z_on_off_set(panel: Panel, on: int) -> Answer:
    delay_s = panel.registers.get("ZCtrl.SwitchOffDelay", _REGISTERS_AT_FIRST["ZCtrl.SwitchOffDelay"])[0]
    panel.set_z_controller(panel.clock.now_s(), on=bool(on), off_delay_s=delay_s)
    return ()


@answers("ZCtrl.OnOffGet")
def _z_on_off_get(panel: Panel) -> Answer:
    return (int(panel.z_is_on(panel.clock.now_s())),)


@answers("ZCtrl.StatusGet")
def _z_status(panel: Panel) -> Answer:
    return (panel.z_status(panel.clock.now_s()),)


@answers("ZCtrl.ZPosSet")
def _z_position_set(panel: Panel, z_m: float) -> Answer:
    if panel.z_controller == "on":
        raise Nope("the Z-Controller is on")
    panel.registers["ZCtrl.ZPos"] = (z_m,)
    return ()


@answers("ZCtrl.SetpntSet")
def _setpoint_set(panel: Panel, setpoint: float) -> Answer:
    panel.rig.feedback = replace(panel.rig.feedback, setpoint=setpoint)
    return ()


@answers("ZCtrl.SetpntGet")
def _setpoint_get(panel: Panel) -> Answer:
    return (panel.rig.feedback.setpoint or 0.0,)


@answers("ZCtrl.GainSet")
def _gain_set(panel: Panel, proportional: float, time_s: float, integral: float) -> Answer:
    """I = P / T: P and T count."""
    integral = proportional / time_s if time_s > 0.0 else integral
    panel.rig.feedback = replace(panel.rig.feedback, proportional_gain=proportional, integral_gain=integral)
    return ()


@answers("ZCtrl.GainGet")
def _gain_get(panel: Panel) -> Answer:
    proportional, integral = panel.rig.feedback.proportional_gain or 0.0, panel.rig.feedback.integral_gain or 0.0
    return proportional, proportional / integral if integral else math.inf, integral


@answers("ZCtrl.CtrlListGet")
def _z_controllers(panel: Panel) -> Answer:
    return ["log Current"], 0


@answers("ZCtrl.Withdraw")
def _withdraw(panel: Panel, wait: int, timeout_ms: int) -> Answer:
    panel.rig.withdraw()
    panel.z_controller = "off"
    panel.rig.feedback = replace(panel.rig.feedback, on=False)
    return _until_free(panel, wait, timeout_ms)


@answers("AutoApproach.OnOffSet")
def _approach_set(panel: Panel, on: int) -> Answer:
    if on:
        panel.rig.engage()
        panel.set_z_controller(panel.clock.now_s(), on=True)
    return ()


@answers("AutoApproach.OnOffGet")
def _approach_get(panel: Panel) -> Answer:
    return (int(panel.rig.engaged and panel.rig.doing(panel.clock.now_s()) == "approach"),)


@answers("Bias.Set")
def _bias_set(panel: Panel, bias_v: float) -> Answer:
    if not abs(bias_v) <= 10.0:
        raise Nope("the bias is limited to 10 V")
    panel.rig.bias_v = bias_v
    return ()


@answers("Bias.Get")
def _bias_get(panel: Panel) -> Answer:
    return (panel.rig.bias_v,)


@answers("Bias.Pulse")
def _pulse(panel: Panel, wait: int, width_s: float, bias_v: float, hold: int, absolute: int) -> Answer:
    relative = 1
    panel.rig.pulse(bias_v + (panel.rig.bias_v if absolute == relative else 0.0), width_s)
    return _until_free(panel, wait)


@answers("TipShaper.Start")
def _shape(panel: Panel, wait: int, timeout_ms: int) -> Answer:
    props = panel.registers.get("TipShaper.Props", _REGISTERS_AT_FIRST["TipShaper.Props"])
    lift_m, lift_s = props[3:5]
    if lift_m < 0.0:
        panel.rig.crash(-lift_m, -lift_m / max(lift_s, 1e-6))
    else:
        panel.rig.occupy("shaper", lift_s)
    return _until_free(panel, wait, timeout_ms)


@answers("Piezo.TiltSet")
def _tilt_set(panel: Panel, x_deg: float, y_deg: float) -> Answer:
    panel.registers["Piezo.Tilt"] = (x_deg, y_deg)
    panel.rig.slope = (math.tan(math.radians(x_deg)), math.tan(math.radians(y_deg)))
    return ()


@answers("Piezo.RangeGet")
def _range(panel: Panel) -> Answer:
    return panel.range_m


@answers("Piezo.DriftCompSet")
def _drift_set(panel: Panel, on: int, *rest: float) -> Answer:
    was_on, *_ = panel.registers.get("drift", (0,))
    x, y, z, *limit = rest
    panel.registers["drift"] = (_chosen(on, was_on, 1, 0), x, y, z, limit[0] if limit else 10.0)
    return ()


@answers("Piezo.DriftCompGet")
def _drift_get(panel: Panel) -> Answer:
    on, x, y, z, limit = panel.registers.get("drift", (0, 0.0, 0.0, 0.0, 10.0))
    return on, x, y, z, 0, 0, 0, limit


@answers("Motor.StartMove")
def _motor(panel: Panel, direction: int, steps: int, group: int, wait: int) -> Answer:
    if direction > 5:
        raise Nope(f"{direction} is no direction")
    where = list(panel.registers.get("Motor.Pos", (0.0, 0.0, 0.0)))
    where[direction // 2] += (-1 if direction % 2 else 1) * steps * 1e-7
    panel.registers["Motor.Pos"] = tuple(where)
    panel.rig.occupy("motor", steps * 0.001)
    return _until_free(panel, wait)


# --- spectra ---


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
    panel.autosave_curves[module] = bool(_chosen(autosave, panel.autosave_curves[module], 1, 0))
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


# --- the rest ---


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
