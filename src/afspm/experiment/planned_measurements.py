"""The plan of a component, as far as its settings define it. The component is constructed, never started."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

from afspm.basics import entry_points
from afspm.basics.errors import AfspmError, UnitError
from afspm.basics.formatting import duration_text, lengths_text, quantity
from afspm.basics.units import convert, si
from afspm.client.parameter_text import to_parameter
from afspm.components import PlannedWork
from afspm.experiment.toml_lines import Table
from afspm.model import (
    ControlRequest,
    Parameter,
    ProbePosition,
    Region,
    Request,
    ScanParameters,
    is_of_instrument,
    names,
)
from afspm.model.bias import BiasReference
from afspm.model.geometry import XY
from afspm.model.planned_work import path_length_m
from afspm.model.sweep_plan import SweepAxis, SweepPlan
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.safety.forbidden_states import PlanRehearsal
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limits import Limit, RoleLimits


@dataclass(frozen=True)
class PlannedMeasurements:
    """Measurements of a component's plan, and the actions and parameters needed for them.

    Attributes:
        drift_doubts: warnings for an experiment that corrects drift; `where` names the setting.
        parameters: values to set, by the setting that gives them: {"zoom_parameters": (Parameter("scan-speed", …),)}.
        period_s: time between the starts of two rounds; 0: no pause.
        scan_speed_m_s: speed of the first scan, if the component is a microscope that defines the speed.
        is_listed: whether the file lists each region, so that an error has a line.
        work: returns the work at a scan speed; see `Component.planned_work`.
        sweep: the points of a sweep, whose values follow each other in a known order.
        kind: kind of the spectra; None: the kind in force.
        placed_later: scans at places that are found in the run, by the setting that gives their size; here anywhere in
            the planned regions.
        pulse_voltages: voltages of the planned pulses of the tip, in V.
        workshop_center: (x, y) in m about which the tip is treated; None: it is not treated.
        reference_scans: number of scans from which a judge of the tip learns before it judges; None: no such judge.
    """

    regions: tuple[Region, ...] = ()
    positions: tuple[XY, ...] = ()
    shape: tuple[int, int] | None = None
    needs_actions: tuple[str, ...] = ()
    needs_parameters: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[Parameter, ...]] = field(default_factory=dict)
    period_s: float = 0.0
    scan_speed_m_s: float | None = None
    is_listed: bool = False
    drift_doubts: tuple[AfspmError, ...] = ()
    work: Callable[[float | None], PlannedWork | None] | None = None
    sweep: SweepPlan | None = None
    kind: str | None = None
    placed_later: Mapping[str, ScanParameters] = field(default_factory=dict)
    pulse_voltages: tuple[float, ...] = ()
    workshop_center: XY | None = None
    reference_scans: int | None = None

    def sets(self, name: str) -> bool:
        """Return whether the plan sets this parameter."""
        return any(parameter.name == name for parameters in self.parameters.values() for parameter in parameters)

    def frame(self) -> Iterator[Parameter]:
        """Yield the parameters that the plan sets: regions and pixels, outermost probe positions, kind of spectra."""
        if self.kind is not None:
            yield Parameter(names.SPEC_KIND, self.kind)
        for region in self.regions:
            sides = zip((names.SCAN_SIZE_X, names.SCAN_SIZE_Y), region.size_m, strict=True)
            corner = zip((names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y), region.top_left_m, strict=True)
            yield from (Parameter(name, repr(float(value_m)), "m") for name, value_m in (*sides, *corner))
        for shape in (self.shape, *(scan.shape for scan in self.placed_later.values())):
            if isinstance(shape, tuple):
                rows, columns = shape
                yield Parameter(names.SCAN_RESOLUTION_X, str(columns))
                yield Parameter(names.SCAN_RESOLUTION_Y, str(rows))
        for region in (scan.region for scan in self.placed_later.values() if isinstance(scan.region, Region)):
            sides = zip((names.SCAN_SIZE_X, names.SCAN_SIZE_Y), region.size_m, strict=True)
            yield from (Parameter(name, repr(float(value_m)), "m") for name, value_m in sides)
        for name, places_m in zip(
            (names.PROBE_POS_X, names.PROBE_POS_Y), zip(*self.positions, strict=True), strict=False
        ):
            yield from (Parameter(name, repr(float(end_m)), "m") for end_m in (min(places_m), max(places_m)))

    def scans(self) -> Iterator[tuple[tuple[str | int, ...], Region, tuple[int, int]]]:
        """Yield each planned scan with its setting: path of the setting, region and (rows, columns)."""
        for number, region in enumerate(self.regions if self.shape else ()):
            yield (("regions", number) if self.is_listed else ()), region, self.shape or (1, 1)
        for setting, scan in self.placed_later.items():
            if isinstance(scan.region, Region) and isinstance(scan.shape, tuple):
                yield (setting,), scan.region, scan.shape


@dataclass(frozen=True)
class Refusal:
    """The reason why the limits refuse a part of a plan.

    Attributes:
        where: path of the setting within the component; empty if no single setting is the cause.
    """

    reason: str
    where: tuple[str | int, ...] = ()
    hint: str = ""


def plan_of(component: type, settings: Table) -> PlannedMeasurements | None:
    """Return the plan of a component with these settings; None for a class that may not be constructed here.

    Only classes declared by entry points, and classes derived from them, are constructed: their `__init__` only stores
    and checks settings. The plan of a component without measurements is empty.

    Raises:
        AfspmError: the component refuses its settings. A user's constructor may raise other errors.
    """
    if not entry_points.is_declared(component):
        return None
    made = component(**settings)
    if callable(check := getattr(made, "check", None)):
        check()  # checks that would be too slow in `__init__`
    plan = getattr(made, "plan", None)
    regions = tuple(r for r in getattr(plan, "regions", ()) if isinstance(r, Region))
    positions = tuple(getattr(made, "positions", ()))
    by_setting = {name: getattr(made, name, None) for name in _PARAMETERS}
    set_by_setting = {
        name: _as_parameters(values) for name, values in by_setting.items() if isinstance(values, Mapping)
    }
    return PlannedMeasurements(
        regions,
        positions,
        getattr(plan, "shape", None),
        tuple(getattr(made, "needs_actions", ())),
        tuple(getattr(made, "needs_parameters", ())),
        {**set_by_setting, **getattr(made, "planned_parameters", {})},
        getattr(made, "beat_s", 0.0),
        getattr(made, "scan_speed_m_s", None),
        isinstance(settings.get("regions"), list),
        tuple(getattr(made, "drift_doubts", ())),
        getattr(made, "planned_work", None),
        sweep if isinstance(sweep := getattr(made, "sweep", None), SweepPlan) else None,
        made.kind if names.SPEC_KIND in getattr(made, "needs_parameters", ()) and hasattr(made, "kind") else None,
        getattr(made, "placed_later", {}),
        tuple(getattr(made, "pulse_voltages", ())),
        getattr(made, "workshop_center", None),
        getattr(getattr(made, "judge", None), "reference_scans", None),
    )


def by_canonical_name(plan: PlannedMeasurements, bias: BiasReference) -> PlannedMeasurements:
    """Return a plan with `tip-bias-voltage` in place of `sample-bias`.

    Raises:
        InvalidValue: it sets `sample-bias`, and the reference of the bias is not known.
    """
    if not plan.sets(names.BIAS_OF_SAMPLE) and names.BIAS_OF_SAMPLE not in plan.needs_parameters:
        return plan
    found = {key: tuple(map(bias.canonical, given)) for key, given in plan.parameters.items()}
    needed = tuple(bias.canonical(Parameter(name)).name for name in plan.needs_parameters)
    sweep = plan.sweep
    if sweep is not None:
        axes = tuple(_of_panel(axis, bias) if axis.name == names.BIAS_OF_SAMPLE else axis for axis in sweep.axes)
        sweep = replace(sweep, axes=axes)
    return replace(plan, parameters=found, needs_parameters=needed, sweep=sweep)


def _of_panel(axis: SweepAxis, bias: BiasReference) -> SweepAxis:
    values = tuple(value if isinstance(value, str) else bias.sign * value for value in axis.values)
    return SweepAxis(names.TIP_BIAS_VOLTAGE, values, axis.unit)


_PARAMETERS = ("parameters", "zoom_parameters", "initial")
"""Attributes of components that hold parameters to set; settings have the same names."""


def _as_parameters(values: Mapping[str, object]) -> tuple[Parameter, ...]:
    plain = {name: value for name, value in values.items() if isinstance(value, float | int | str)}
    return tuple(to_parameter(name, value, None) for name, value in plain.items())


def refusals(name: str, planned: PlannedMeasurements, limits: ExperimentLimits) -> list[Refusal]:
    """Return the reasons of the limits to refuse the plan, each once; of a grid of regions only the first.

    The limits of the component's role count, too.
    """
    refusals = _refusals_by(name, planned, limits)
    if limits.forbid:
        refusals += _forbidden(planned, limits)
    if (role := limits.roles.get(name)) is not None:
        known = {refusal.reason for refusal in refusals}
        refusals += [refusal for refusal in _refusals_by_role(name, planned, role) if refusal.reason not in known]
    return refusals


def _refusals_by_role(name: str, planned: PlannedMeasurements, role: RoleLimits) -> Iterator[Refusal]:
    yield from _refusals_by(name, planned, role.limits)
    for action in planned.needs_actions if role.actions is not None else ():
        if action not in (role.actions or ()):
            yield Refusal(f"{action} is not among the actions of {name} ({role.source})")
    for setting, parameters in planned.parameters.items() if role.parameters_only else ():
        for parameter in parameters:
            if parameter.name not in role.limits.parameters:
                reason = f"{parameter.name} is not among the parameters of {name} ({role.source})"
                yield Refusal(reason, (setting, parameter.name))


def _forbidden(planned: PlannedMeasurements, limits: ExperimentLimits) -> list[Refusal]:
    # judged by what the plan itself sets: other values are unknown before the run
    rehearsal, refusals = PlanRehearsal(limits), dict[str, Refusal]()
    for where, request in _requests(planned):
        if why := rehearsal.refusal(request):
            refusals.setdefault(where[-1] if where else str(request.subject), Refusal(why, where))
    return list(refusals.values())


def _requests(planned: PlannedMeasurements) -> Iterator[tuple[tuple[str, ...], Request]]:
    # in the order of a run, each with the setting that it is made of
    scans = [
        Request(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, planned.shape)) for region in planned.regions
    ]
    scans += [Request(ControlRequest.SET_PROBE_POS, ProbePosition(xy_m)) for xy_m in planned.positions]
    scans += [Request(ControlRequest.ACTION, action) for action in planned.needs_actions]
    settings = {setting: parameters for setting, parameters in planned.parameters.items() if setting != "initial"}
    if planned.sweep is not None:
        sweep = planned.sweep
        settings["parameters"] = tuple(parameter for place in sweep.places() for parameter in sweep.settings(place))
    for setting, parameters in (settings or {"": ()}).items():
        for parameter in parameters:
            yield (setting, parameter.name), Request(ControlRequest.PARAM, parameter)
        yield from (((), request) for request in scans)


def _refusals_by(name: str, planned: PlannedMeasurements, limits: ExperimentLimits) -> list[Refusal]:
    # steps and rates depend on the value before, which is unknown here
    guard = LimitChecker(limits.fixed)
    refusals: dict[str, Refusal] = {}

    def check(kind: ControlRequest, subject: object, where: tuple[str | int, ...] = (), hint: str = "") -> None:
        refused = guard.check(name, Request(kind, subject, b""), 0)
        if refused is not None:
            refusals.setdefault(refused.reason, Refusal(refused.reason, where, hint))

    for setting, parameters in planned.parameters.items():
        if setting == "initial":  # values of the microscope itself; its frame is checked in parts
            guard = LimitChecker(replace(_for_all(limits.fixed), region=None))
        for parameter in parameters:
            check(ControlRequest.PARAM, parameter, (setting, parameter.name))
    for before, after in _sweep_steps(planned.sweep, limits) if planned.sweep else ():
        guard = LimitChecker(_with_steps_alone(limits)).in_force(before, 0)
        hint = 'list values between them, or leave `order` at "snake"'
        check(ControlRequest.PARAM, after, ("parameters", after.name), hint)
    guard = LimitChecker(limits.fixed)
    cure, of_parameters = _remedy(planned, limits.region), len(refusals)
    for number, region in enumerate(planned.regions):
        wanted, where = ScanParameters(region, planned.shape), ("regions", number)
        if planned.is_listed:
            check(ControlRequest.SET_SCAN_PARAMS, wanted, where, _nearest_text(region, limits.region))
        elif len(refusals) == of_parameters:  # of a grid outside, one reason is enough
            check(ControlRequest.SET_SCAN_PARAMS, wanted, hint=cure)
    for setting, scan in planned.placed_later.items():
        check(ControlRequest.SET_SCAN_PARAMS, scan, (setting,))
    for xy in planned.positions:
        check(ControlRequest.SET_PROBE_POS, ProbePosition(xy), hint=cure)
    return list(refusals.values())


def _remedy(planned: PlannedMeasurements, allowed: Region | None) -> str:
    points = [point for region in planned.regions for point in region.corners_m()] + list(planned.positions)
    if allowed is None or not points:
        return ""
    if len(planned.regions) == 1 and not planned.positions:
        return _nearest_text(planned.regions[0], allowed)
    shift = _shift_m(points, allowed, 0.0)
    if shift is None:
        return f"all of it is larger than the region allowed, {lengths_text(allowed.size_m, ' x ')}"
    x, y = (lengths_text([value]) for value in shift)
    return f"it fits if moved by ({x}, {y})"


def _nearest_text(region: Region, allowed: Region | None) -> str:
    if allowed is None:
        return ""
    nearest = nearest_region(region, allowed)
    places = (nearest.center_m, nearest.size_m)
    center, size = (f'["{lengths_text([x])}", "{lengths_text([y])}"]' for x, y in places)
    return f"the nearest that fits: center = {center}, size = {size}"


_REACH = 1e-9  # the tolerance of the limits: a point on the border counts as inside despite rounding
_MARGIN = 1e-3
"""Relative distance of a suggested region from the border, used if rounded numbers would exceed the border."""


def nearest_region(region: Region, allowed: Region) -> Region:
    """Return the nearest region of the same angle that fits, in round numbers; smaller if need be."""
    exact = _rounded(_nearest(region, allowed, 0.0))
    reach = replace(allowed, size_m=(allowed.size_m[0] * (1 + _REACH), allowed.size_m[1] * (1 + _REACH)))
    if all(reach.contains(corner) for corner in exact.corners_m()):
        return exact
    return _rounded(_nearest(region, allowed, _MARGIN))


def _rounded(region: Region) -> Region:
    # the digits of `lengths_text`; a centre of 1e-22 m from rounding is shown as zero
    width, height = (float(f"{size_m:.5g}") for size_m in region.size_m)
    x, y = (float(f"{place_m:.5g}") if abs(place_m) > 1e-6 * width else 0.0 for place_m in region.center_m)
    return replace(region, center_m=(x, y), size_m=(width, height))


def _nearest(region: Region, allowed: Region, margin: float) -> Region:
    sides = [high - low for low, high in _extent(region.corners_m(), allowed)]
    smaller = min(1.0, *((1 - margin) * size / side for size, side in zip(allowed.size_m, sides, strict=True)))
    fitting = replace(region, size_m=(region.size_m[0] * smaller, region.size_m[1] * smaller))
    shift = _shift_m(fitting.corners_m(), allowed, margin) or (0.0, 0.0)
    return fitting.moved_to((region.center_m[0] + shift[0], region.center_m[1] + shift[1]))


def _extent(points: Iterable[XY], allowed: Region) -> list[tuple[float, float]]:
    cos, sin = math.cos(allowed.angle_rad), math.sin(allowed.angle_rad)
    places = [(float(x) - allowed.center_m[0], float(y) - allowed.center_m[1]) for x, y in points]
    along = [cos * x + sin * y for x, y in places]
    across = [cos * y - sin * x for x, y in places]
    return [(min(along), max(along)), (min(across), max(across))]


def _shift_m(points: Iterable[XY], allowed: Region, margin: float) -> XY | None:
    moves = []
    for (low, high), size in zip(_extent(points, allowed), allowed.size_m, strict=True):
        if high - low > size * (1 + 1e-12):
            return None
        half = (1 - margin) * size / 2.0
        if high - low > 2.0 * half:
            moves.append(-(low + high) / 2.0)
        else:
            moves.append(max(0.0, -half - low) or min(0.0, half - high))
    cos, sin = math.cos(allowed.angle_rad), math.sin(allowed.angle_rad)
    return cos * moves[0] - sin * moves[1], sin * moves[0] + cos * moves[1]


def too_slow(planned: PlannedMeasurements, usual_m_s: float | None) -> str:
    """Return a warning if a round of scans takes longer than its period; empty otherwise, or at unknown speed.

    Args:
        usual_m_s: scan speed if the plan sets no speed.
    """
    parameters = planned.parameters.get("parameters", ())
    speeds = [parameter for parameter in parameters if parameter.name == names.SCAN_SPEED]
    speed_m_s = si(f"{speeds[0].value} {speeds[0].unit or 'm/s'}", "m/s") if speeds else usual_m_s
    if not speed_m_s or planned.shape is None or not planned.period_s:
        return ""
    rows = planned.shape[0]
    round_s = sum(path_length_m(region, rows) / speed_m_s for region in planned.regions)
    if round_s <= planned.period_s:
        return ""
    what = "the scan" if len(planned.regions) == 1 else f"a round of {len(planned.regions)} scans"
    return (
        f"{what} takes about {duration_text(round_s)} at {quantity(speed_m_s, 'm/s')},"
        f" longer than its period of {duration_text(planned.period_s)}"
    )


def with_waits(name: str, planned: PlannedMeasurements, work: PlannedWork, limits: ExperimentLimits) -> PlannedWork:
    """Return the work of a component with the time that it waits for limits on time, and their places in the file.

    The waits between the measurements are least waits: other components count for the same limits.
    """
    count = (work.scans or 0) + work.spectra
    if count < 2:
        return work
    each_s = None if work.duration_s is None else work.duration_s / count
    by_place = [waits for waits in _waits_s(name, planned, work, limits, each_s or 0.0) if sum(waits[1]) > 0.0]
    between_s = [max(waits) for waits in zip(*(waits for _, waits in by_place), strict=True)]
    waited_s = sum(max(0.0, wait_s - (each_s or 0.0)) for wait_s in between_s)
    if not waited_s:
        return work
    places = ", ".join(dict.fromkeys(place for place, _ in by_place))
    why = f"of it at least {duration_text(waited_s)} waiting for limits: {places}"
    duration_s = None if work.duration_s is None else work.duration_s + waited_s
    return replace(work, duration_s=duration_s, why="; ".join(filter(None, (work.why, why))))


def _waits_s(
    name: str, planned: PlannedMeasurements, work: PlannedWork, limits: ExperimentLimits, each_s: float
) -> Iterator[tuple[str, list[float]]]:
    # the place of each limit, and the least times between the starts of measurements
    count = (work.scans or 0) + work.spectra
    for action in _only_start(work):
        limit, role = limits.actions.get(action), limits.roles.get(name)
        if limit is not None and limit.interval_s is not None:
            each_s = max(each_s, limit.interval_s)
            yield f"{action} every {duration_text(limit.interval_s)} ({limit.source})", [limit.interval_s] * (count - 1)
        if role is not None and (most := role.per_hour.get(action)):
            rest_s = 3600.0 - (most - 1) * each_s
            waits = [rest_s if number % most == 0 else 0.0 for number in range(1, count)]
            yield f"{most} {action} per hour ({role.source})", waits
    if planned.sweep is None:
        return
    places = planned.sweep.places()
    for i, axis in enumerate(planned.sweep.axes):
        limit = limits.parameters.get(axis.name)
        if limit is None:
            continue
        if limit.interval_s is not None:
            place = f"{axis.name} every {duration_text(limit.interval_s)} ({limit.source})"
            yield place, [limit.interval_s] * (count - 1)
        if limit.rate_per_s is not None and not is_of_instrument(axis.name):  # an instrument ramps by itself
            with suppress(UnitError, ValueError):  # the limits have refused it before
                values = [convert(float(value), axis.unit or "", limit.unit or "") for value in axis.values]
                steps = [abs(values[after[i]] - values[before[i]]) for before, after in itertools.pairwise(places)]
                yield f"the rate of {axis.name} ({limit.source})", [step / limit.rate_per_s for step in steps]


def _only_start(work: PlannedWork | None) -> list[str]:
    # the action that starts all measurements; of work with scans and spectra the order is not known
    starts = [names.START_SCAN] * bool(work and work.scans) + [names.START_SPEC] * bool(work and work.spectra)
    return starts if len(starts) == 1 else []


def further_waits(name: str, planned: PlannedMeasurements, limits: ExperimentLimits) -> list[str]:
    """Return a sentence for each action with a shortest interval that `with_waits` does not count."""
    counted = _only_start(planned.work(None) if planned.work else None)
    intervals = {action: limits.actions[action] for action in planned.needs_actions if action in limits.actions}
    return [
        f"{name} may wait up to {duration_text(limit.interval_s)} before each {action} ({limit.source})"
        for action, limit in intervals.items()
        if limit.interval_s is not None and action not in counted
    ]


def refused_actions(limits: ExperimentLimits) -> list[tuple[str, str]]:
    """Return the actions whose settings the limits would always refuse, with the reasons."""
    # the tip's position is unknown before the start
    guard = LimitChecker(replace(_for_all(limits.fixed), actions={}, region=None))
    refusals = []
    for action in limits.sets:
        refused = guard.check("", Request(ControlRequest.ACTION, action, b""), 0)
        if refused is not None:
            refusals.append((action, refused.reason))
    return refusals


def _sweep_steps(sweep: SweepPlan, limits: ExperimentLimits) -> Iterator[tuple[Parameter, Parameter]]:
    # the largest change between two points, of each parameter whose changes are limited
    places = sweep.places()
    for i, axis in enumerate(sweep.axes):
        numbers = [value for value in axis.values if not isinstance(value, str | bool)]
        changes = {(a[i], b[i]) for a, b in itertools.pairwise(places) if a[i] != b[i]}
        if axis.name in limits.bounded and len(numbers) == len(axis.values) and changes:
            before, after = max(sorted(changes), key=lambda pair: abs(numbers[pair[1]] - numbers[pair[0]]))
            yield axis.parameter(before), axis.parameter(after)


def _with_steps_alone(limits: ExperimentLimits) -> ExperimentLimits:
    steps = {
        name: Limit(step=limit.step, unit=limit.unit, source=limit.source) for name, limit in limits.parameters.items()
    }
    return ExperimentLimits(parameters=steps)


def _for_all(limits: ExperimentLimits) -> ExperimentLimits:
    return replace(limits, parameters={name: replace(limit, only=None) for name, limit in limits.parameters.items()})
