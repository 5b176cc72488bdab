"""Checks of the scan frame: its publication at the start, changes of it, and moves of the probe."""

from __future__ import annotations

import math

from afspm.model import ControlRequest, Feedback, ProbePosition, Region, RegionChange, ScanParameters, ScopeState, names
from afspm.model.scan import ShapeChange
from afspm.testing.conformance import Failed, Skipped, expect, near
from afspm.testing.translators.client import Observation, describe_all, states
from afspm.testing.translators.measuring import CheckMeasurements, FrameSetting, difference, number
from afspm.testing.translators.translator_suite import check


@check("published/in-force", "the settings in force are published at the start, the state last")
def published_in_force(kit: CheckMeasurements) -> None:
    observed = kit.client.at_start
    wanted: list[tuple[type, tuple[str, ...]]] = [
        (ScanParameters, (names.SCAN_SIZE_X, names.SCAN_SIZE_Y)),
        (Feedback, (names.ZCTRL_SETPOINT,)),
        (ProbePosition, (names.PROBE_POS_X, names.PROBE_POS_Y)),
    ]
    state_at = max(i for i, one in enumerate(observed) if one.state is not None)
    for kind, needs in wanted:
        at = max((i for i, one in enumerate(observed) if isinstance(one.thing, kind)), default=None)
        if kit.support.has(*needs):
            expect(at is not None, f"a {kind.__name__} at the start", describe_all(observed))
        if at is not None:
            expect(at < state_at, f"ScopeStateMsg after {kind.__name__}", describe_all(observed))


@check("published/free", "the microscope is free before anything is asked of it")
def free(kit: CheckMeasurements) -> None:
    states = [one.state for one in kit.client.at_start if one.state is not None]
    expect(states[-1] is ScopeState.FREE, "SS_FREE", describe_all(kit.client.at_start))


@check("published/frame", "the ScanParameters2d agree with the parameters", needs=(names.SCAN_SIZE_X,))
def frame(kit: CheckMeasurements) -> None:
    parameters = next(
        (one.thing for one in reversed(kit.client.at_start) if isinstance(one.thing, ScanParameters)), None
    )
    if parameters is None or not isinstance(parameters.region, Region):
        raise Failed("ScanParameters2d with a region", describe_all(kit.client.at_start))
    (left, low), (width, height) = parameters.region.top_left_m, parameters.region.size_m
    told_m = {
        names.SCAN_TOP_LEFT_X: left,
        names.SCAN_TOP_LEFT_Y: low,
        names.SCAN_SIZE_X: width,
        names.SCAN_SIZE_Y: height,
    }
    for name, in_message_m in told_m.items():
        if kit.support.has(name):
            value_m = number(kit.client.get(name), "m")
            alike = near(value_m, in_message_m, absolute=1e-3 * width)
            expect(alike, f"{name} as in ScanParameters2d, {in_message_m:.6g} m", f"{value_m:.6g} m")


_SIZES = (names.SCAN_SIZE_X, names.SCAN_SIZE_Y)


def ask_for(kit: CheckMeasurements, wanted: ScanParameters, *, awaiting: ScopeState | None = None) -> list[Observation]:
    """Set scan parameters; return the resulting publications, among them the state that is awaited."""
    kit.client.come_to_rest()
    mark = kit.client.observations.mark()
    kit.client.asked(ControlRequest.SET_SCAN_PARAMS, wanted, "setting a frame")
    return kit.client.settled(mark, awaiting=awaiting)


def current_frame(kit: CheckMeasurements) -> FrameSetting:
    """Return the last published frame."""
    newest = kit.client.observations.newest(ScanParameters)
    if (setting := _setting(newest)) is None:
        raise Failed("ScanParameters2d with region and shape", str(newest))
    return setting


def _setting(published: ScanParameters | None) -> FrameSetting | None:
    if published is None or not isinstance(published.region, Region) or not isinstance(published.shape, tuple):
        return None
    return FrameSetting(published.region, published.shape)


def require_in_force(kit: CheckMeasurements, frame: FrameSetting) -> None:
    """Raise Failed unless `frame` is the last published frame."""

    def is_set(parameters: ScanParameters) -> bool:
        setting = _setting(parameters)
        return setting is not None and setting.shape == frame.shape and not difference(frame.region, setting.region)

    kit.client.awaited_newest(ScanParameters, is_set)
    published = current_frame(kit)
    wrong = difference(frame.region, published.region)
    if wrong:
        raise Failed("ScanParameters2d of the frame that was set", wrong)
    expect(published.shape == frame.shape, f"ScanParameters2d of {frame.shape} pixels", f"{published.shape}")


def require_published_once(observed: list[Observation], kind: type, named: str) -> None:
    """Raise Failed unless the order is SS_MOVING, the new setting once, SS_FREE."""
    right = f"SS_MOVING, {named} once, SS_FREE"
    expect(states(observed) == ["SS_MOVING", "SS_FREE"], right, describe_all(observed))
    at = [i for i, one in enumerate(observed) if isinstance(one.thing, kind)]
    free_at = max(i for i, one in enumerate(observed) if one.state is ScopeState.FREE)
    expect(len(at) == 1 and at[0] < free_at, right, describe_all(observed))


@check("frame/set", "a frame that is set: SS_MOVING, ScanParameters2d as set, once, SS_FREE", needs=_SIZES)
def set_whole(kit: CheckMeasurements) -> None:
    ask_for(kit, kit.frames.plain.request(kit.support))
    require_in_force(kit, kit.frames.plain)
    observed = ask_for(kit, kit.frames.other.request(kit.support), awaiting=ScopeState.FREE)
    require_published_once(observed, ScanParameters, "ScanParameters2d")
    require_in_force(kit, kit.frames.other)


@check("frame/position-only", "only the fields that are present are set: the corner", needs=(names.SCAN_TOP_LEFT_X,))
def position_only(kit: CheckMeasurements) -> None:
    ask_for(kit, kit.frames.other.request(kit.support))
    left, low = kit.frames.other.region.top_left_m
    moved_m = 0.05 * kit.frames.other.region.size_m[0]
    ask_for(kit, ScanParameters(RegionChange(left_m=left - moved_m, low_m=low + moved_m)))
    center = kit.frames.other.region.center_m
    wanted = kit.frames.other.region.moved_to((center[0] - moved_m, center[1] + moved_m))
    require_in_force(kit, FrameSetting(wanted, kit.frames.other.shape))


@check("frame/shape-only", "only the fields that are present are set: the pixels", needs=(names.SCAN_RESOLUTION_X,))
def shape_only(kit: CheckMeasurements) -> None:
    ask_for(kit, kit.frames.wide.request(kit.support))
    ask_for(kit, ScanParameters(shape=ShapeChange(rows=48)))
    require_in_force(kit, FrameSetting(kit.frames.wide.region, (48, kit.frames.wide.shape[1])))


@check("frame/turned", "an angle is set as it was asked for, about the centre", needs=(names.SCAN_ANGLE,))
def turned(kit: CheckMeasurements) -> None:
    ask_for(kit, kit.frames.turned.request(kit.support))
    require_in_force(kit, kit.frames.turned)
    straight = Region(kit.frames.turned.region.center_m, kit.frames.turned.region.size_m, 0.0)
    ask_for(kit, ScanParameters(RegionChange(angle_rad=0.0)))
    require_in_force(kit, FrameSetting(straight, kit.frames.turned.shape))


@check("frame/parameters", "the parameters report the frame that was set", needs=_SIZES)
def parameters(kit: CheckMeasurements) -> None:
    ask_for(kit, kit.frames.turned.request(kit.support))
    region, (rows, columns) = kit.frames.turned.region, kit.frames.turned.shape
    (left, low), (width, height) = region.top_left_m, region.size_m
    wanted = {
        names.SCAN_TOP_LEFT_X: (left, "m"),
        names.SCAN_TOP_LEFT_Y: (low, "m"),
        names.SCAN_SIZE_X: (width, "m"),
        names.SCAN_SIZE_Y: (height, "m"),
        names.SCAN_ANGLE: (math.degrees(region.angle_rad), "deg"),
        names.SCAN_RESOLUTION_X: (columns, ""),
        names.SCAN_RESOLUTION_Y: (rows, ""),
    }
    known = {name: value for name, value in wanted.items() if kit.support.has(name)}
    if not known:
        raise Skipped("the microscope has none of the frame's parameters")
    for name, (value, unit) in known.items():
        came = number(kit.client.get(name), unit)
        alike = near(came, value, absolute=1e-3 * width if unit == "m" else 0.1 if unit == "deg" else 0.0)
        expect(alike, f"{name} = {value:.6g} {unit}".rstrip(), f"{came:.6g} {unit}".rstrip())
