"""The simulated run of a plan, in a separate process: `python -m afspm_agents.twin REQUEST RESULT PICTURES`.

The simulated sample is the widest of the newest height scans, or a stepped surface without such a scan; the result
names the sample. Each request is checked against the limits of the experiment and of the agent, except limits of steps,
rates and intervals, which depend on the values in force at the time of the request, where the scheduler checks them.
Nothing here reaches the microscope, or changes the run's folder. The process has no sockets and a low priority, so that
it delays neither the experiment nor `stop`.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from afspm.basics import AfspmError, Plain
from afspm.components import Levelling, levelled
from afspm.drawing import indices, png, value_range
from afspm.emulation import ScanActivity, SimulatedInstrument
from afspm.experiment.experiment import load_expanded
from afspm.model import Frame, Request, component_of, names
from afspm.record import EXPERIMENT_FILE
from afspm.scheduler import ExperimentLimits, number_of
from afspm.scheduler.safety.forbidden_states import PlanRehearsal
from afspm.scheduler.safety.grants import not_of_role
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm_agents.plan import MoveStep, Plan, ScanStep, SetStep, SpectrumStep, plan_of

LONGEST_S = 60.0
"""Real seconds after which the process is killed."""
MOST_PICTURES = 4
MOST_PIXELS = 256
"""Largest number of rows or columns of a simulated scan; its duration is computed for all rows of the plan."""
_SETTING_S = 1.0
_SPECTRUM_S = 2.0
_USUAL_SPEED_M_S = 2e-6
_QUIET = {"scar_probability": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "debris_jumps_per_s": 0.0}


def limits_of(folder: Path) -> ExperimentLimits:
    """Return the limits in the experiment file of a run."""
    with tempfile.TemporaryDirectory(prefix="afspm-twin-") as empty:  # no class is imported from the run's folder
        return load_expanded(folder / EXPERIMENT_FILE, [Path(empty)]).resolved.limits


def refusals(plan: Plan, who: str, limits: ExperimentLimits, frame: Frame) -> list[str]:
    """Return the reasons, as text, for which the limits would refuse requests of a plan."""
    found = []
    role = limits.roles.get(who) or limits.roles.get(component_of(who))
    checkers = [LimitChecker(limits.fixed)]
    if role is not None:
        checkers.append(LimitChecker(role.limits.fixed))
    rehearsal = PlanRehearsal(limits)
    for number, planned in enumerate(plan.requests(frame), 1):
        request = Request(planned.kind, planned.subject)
        refused = [one for checker in checkers if (one := checker.check(who, request, 0)) is not None]
        found += [f"request {number} ({planned.text}): {one.reason}" for one in refused]
        if why := rehearsal.refusal(request):
            found.append(f"request {number} ({planned.text}): {why}")
        if role is not None and (why := not_of_role(role, who, request)):
            found.append(f"request {number} ({planned.text}): {why}")
    return found


def simulate(plan: Plan, sample: Plain, speed_m_s: float, pictures: Path) -> Plain:
    """Simulate a plan on a sample; return its duration and damage, and write pictures of its first scans.

    Scans run at `speed_m_s` until a step sets the scan speed. Noise other than white noise is switched off.
    """
    surface = sample.get("surface") or {"kind": "steps"}
    noise = {**_QUIET, "white_m": sample["noise_m"]} if sample.get("noise_m") else _QUIET
    instrument = SimulatedInstrument({"surface": surface, "noise": noise}, 1, 0.0)
    origin = sample.get("center_m") or [0.0, 0.0]
    now_s, at_m, drawn, pressed_m = 0.0, (0.0, 0.0), 0, 0.0
    for step in plan.steps:
        match step:
            case SetStep():
                now_s += _SETTING_S
                if step.parameter == names.SCAN_SPEED and (given := number_of(step.wanted)):
                    speed_m_s = given
                elif step.parameter == names.TIP_BIAS_VOLTAGE and (given := number_of(step.wanted)) is not None:
                    instrument.setup.bias_v = given
                elif step.parameter == names.ZCTRL_SETPOINT and (given := number_of(step.wanted)) is not None:
                    instrument.setup.feedback = replace(instrument.setup.feedback, setpoint=given)
            case MoveStep() | SpectrumStep():
                to_m = step.to_m if isinstance(step, MoveStep) else step.at_m
                now_s += math.dist(at_m, to_m) / instrument.setup.move_speed_m_s
                now_s += 0.0 if isinstance(step, MoveStep) else _SPECTRUM_S
                at_m = to_m
            case ScanStep():
                scan, lasts_s = _scan(instrument, step, speed_m_s, origin, now_s)
                now_s += math.dist(at_m, step.center_m) / instrument.setup.move_speed_m_s + lasts_s
                at_m = step.center_m
                told = scan.truth.get("pressed_m")
                pressed_m = max(pressed_m, float(told) if isinstance(told, float | int) else 0.0)
                if drawn < MOST_PICTURES:
                    _draw(scan, pictures / f"{drawn}.png")
                    drawn += 1
    damage = instrument.world.truth(now_s)
    happened = damage.get("tip_changes")
    # the first entry is the tip at the start
    changes = [one for one in happened if one["cause"] != "start"] if isinstance(happened, list) else []
    return {
        "seconds": round(now_s, 1),
        "harm": {"pressed_m": pressed_m, "tip_changes": len(changes)},
        "pictures": drawn,
    }


def _scan(
    instrument: SimulatedInstrument, step: ScanStep, speed_m_s: float, origin: list[float], now_s: float
) -> tuple[ScanActivity, float]:
    rows, columns = step.shape
    line_s = 2.0 * step.size_m[0] / max(speed_m_s, 1e-12)  # trace and retrace
    setup = instrument.setup
    few = (max(2, min(rows, MOST_PIXELS)), max(2, min(columns, MOST_PIXELS)))
    region = step.target(Frame.TIP).region
    assert region is not None
    setup.region = region.moved_to((region.center_m[0] - origin[0], region.center_m[1] - origin[1]))
    setup.shape, setup.line_s = few, line_s
    scan = instrument.start_scan(now_s)
    instrument.ended(scan.end_s + 1.0)
    return scan, rows * line_s


def _draw(scan: ScanActivity, path: Path) -> None:
    channels = scan.channels()
    values = next((values for unit, values in channels.values() if unit == "m"), next(iter(channels.values()))[1])
    flat = levelled(np.asarray(values, dtype=np.float64), Levelling.PLANE)
    path.write_bytes(png(indices(flat, value_range(flat))))


def main(request: Path, result: Path, pictures: Path) -> None:
    """Simulate the plan in a request file, and write the result file."""
    asked: Plain = json.loads(request.read_text(encoding="utf-8"))
    plan, frame = plan_of(asked["plan"]), Frame[asked["frame"]]
    found: Plain = {"seconds": None, "harm": None, "pictures": 0, "refusals": [], "sample": asked["sample"].get("of")}
    try:
        found["refusals"] = refusals(plan, asked["who"], limits_of(Path(asked["folder"])), frame)
        found.update(simulate(plan, asked["sample"], asked.get("speed_m_s") or _USUAL_SPEED_M_S, pictures))
    except AfspmError as error:
        found["error"] = str(error)
    result.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    if hasattr(os, "nice"):
        os.nice(10)  # the running experiment has priority for the processor
    main(*(Path(one) for one in sys.argv[1:4]))
