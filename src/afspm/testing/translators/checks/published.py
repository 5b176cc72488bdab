"""What is told at the beginning, to who has just come."""

from __future__ import annotations

from afspm.model import Feedback, ProbePosition, Region, ScanParameters, ScopeState, names
from afspm.testing.translators.registry import check
from afspm.testing.translators.story import told
from afspm.testing.translators.taking import Taking, number
from afspm.testing.translators.verdicts import Failed, expect, near


@check("published/in-force", "what is in force is published at the start, the state last")
def in_force(kit: Taking) -> None:
    heard = kit.bench.at_start
    wanted: list[tuple[type, tuple[str, ...]]] = [
        (ScanParameters, (names.SCAN_SIZE_X, names.SCAN_SIZE_Y)),
        (Feedback, (names.ZCTRL_SETPOINT,)),
        (ProbePosition, (names.PROBE_POS_X, names.PROBE_POS_Y)),
    ]
    state_at = max(i for i, one in enumerate(heard) if one.state is not None)
    for kind, needs in wanted:
        at = max((i for i, one in enumerate(heard) if isinstance(one.thing, kind)), default=None)
        if kit.support.has(*needs):
            expect(at is not None, f"a {kind.__name__} at the start", told(heard))
        if at is not None:
            expect(at < state_at, f"ScopeStateMsg after {kind.__name__}", told(heard))


@check("published/free", "the microscope is free before anything is asked of it")
def free(kit: Taking) -> None:
    states = [one.state for one in kit.bench.at_start if one.state is not None]
    expect(states[-1] is ScopeState.FREE, "SS_FREE", told(kit.bench.at_start))


@check("published/frame", "the ScanParameters2d are what the parameters say", needs=(names.SCAN_SIZE_X,))
def frame(kit: Taking) -> None:
    parameters = next(
        (one.thing for one in reversed(kit.bench.at_start) if isinstance(one.thing, ScanParameters)), None
    )
    if parameters is None or not isinstance(parameters.region, Region):
        raise Failed("ScanParameters2d with a region", told(kit.bench.at_start))
    (left, low), (width, height) = parameters.region.top_left_m, parameters.region.size_m
    told_m = {
        names.SCAN_TOP_LEFT_X: left,
        names.SCAN_TOP_LEFT_Y: low,
        names.SCAN_SIZE_X: width,
        names.SCAN_SIZE_Y: height,
    }
    for name, in_message_m in told_m.items():
        if kit.support.has(name):
            value_m = number(kit.bench.get(name), "m")
            alike = near(value_m, in_message_m, absolute=1e-3 * width)
            expect(alike, f"{name} as in ScanParameters2d, {in_message_m:.6g} m", f"{value_m:.6g} m")
