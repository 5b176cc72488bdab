"""Limits of an experiment: what is refused before it reaches the microscope, and why.

Nothing is clamped. A refusal names the parameter, the value, the limit and where the limit was set.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from afspm.errors import AfspmError
from afspm.logic.places import PROBE_CHANGES, REGION_CHANGES, SHAPE_CHANGES, Whereabouts, moved, scan_values
from afspm.logic.usage import Usage, Use
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    Request,
    Response,
    ScanParameters,
    ShapeChange,
    component_of,
    names,
)
from afspm.model.geometry import XY
from afspm.model.names import BASE_PARAMETERS
from afspm.units import convert

_REACH = 1e-9  # relative: what lies on the border, to the precision of the arithmetic, is inside
_TOLD_REACH = 1e-3  # the same of a place that the controller tells: in steps of its own, and in single precision


@dataclass(frozen=True)
class Limit:
    """What is allowed of one parameter or action. None: no such limit.

    Attributes:
        low, high: the range, in `unit`, both allowed.
        step: how far one request may change it at most, in `unit`.
        rate_per_s: how fast it may change at most, in `unit` per second of experiment time since it last changed.
        interval_s: how much experiment time lies between two requests at least. The only one an action can have,
            beside `only`.
        only: the components that may set it.
        unit: of the values above; SI for the base parameters.
        source: where it was set, e.g. "experiment.toml:42".
    """

    low: float | None = None
    high: float | None = None
    step: float | None = None
    rate_per_s: float | None = None
    interval_s: float | None = None
    only: Collection[str] | None = None
    unit: str | None = None
    source: str = "[limits]"


@dataclass(frozen=True)
class Limits:
    """All limits of an experiment.

    Attributes:
        parameters: by name of the parameter.
        actions: by name of the action.
        region: what scans (with their corners) and the probe must stay in, in m, in tip coordinates. Nothing is done
            outside, whoever set the place.
        region_source: where that was set.
        most_pixels: of a scan.
    """

    parameters: Mapping[str, Limit] = field(default_factory=dict)
    actions: Mapping[str, Limit] = field(default_factory=dict)
    region: Region | None = None
    region_source: str = "[limits] region"
    most_pixels: int = 8192 * 8192


class _Breach(Exception):
    """A limit is broken. Never leaves this module."""

    def __init__(self, code: ControlResponse, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class Guard:
    """Checks requests against the limits, and keeps in mind what steps and rates are measured from."""

    def __init__(self, limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        self._usage = Usage()
        self._at = Whereabouts()

    def check(self, who: str, request: Request, now_ns: int, used: Collection[str] | None = None) -> Response | None:
        """The refusal of a request that breaks a limit or has no meaning; None: it may be sent.

        Args:
            used: the parameters that `who` means to set; the others of the request only change with them. None: all.
        """
        try:
            self._check(who, request, now_ns, used)
        except _Breach as breach:
            return Response(int(breach.code), b"", breach.reason, request.id)
        return None

    def check_place(self, request: Request) -> Response | None:
        """The refusal of an action where the scan, or the probe, is now: somebody at the panel may have set that."""
        try:
            self._check_place(str(request.subject))
        except _Breach as breach:
            reason = f"{request.subject}: {breach.reason}"
            return Response(int(ControlResponse.ACTION_ERROR), b"", reason, request.id)
        return None

    def sending(self, who: str, request: Request, now_ns: int) -> bool:
        """A request that was checked is about to be sent. Returns whether that is to be saved first."""
        if request.kind != ControlRequest.ACTION or not self._has_interval(str(request.subject)):
            return False
        self._usage.sending(str(request.subject), Use(now_ns, who, request.id))
        return True

    def not_done(self, who: str, request: Request) -> None:
        """A request was not carried out, for sure."""
        if request.kind == ControlRequest.ACTION:
            self._usage.not_done(str(request.subject), who, request.id)

    def carried_out(
        self,
        request: Request,
        now_ns: int,
        told: Parameter | None = None,
        used: Collection[str] | None = None,
        who: str = "",
    ) -> bool:
        """A request that was checked succeeded; `told` is the parameter as the translator answered it.

        Returns:
            Whether what steps, rates and intervals are measured from has changed.
        """
        subject = told if told is not None and told.value is not None else request.subject
        use = Use(now_ns, who, request.id)
        if isinstance(subject, str):
            if is_kept := self._has_interval(subject):
                self._usage.done(subject, use)
            return is_kept
        sets = not isinstance(request.subject, Parameter) or request.subject.value is not None
        is_new = False
        for name, value in self._values(subject):
            is_new |= self._learn(name, value, now_ns)
            if sets and (used is None or name in used) and self._has_interval(name):
                self._usage.done(name, use)
                is_new = True
        if isinstance(subject, Parameter):
            self._at.has_values(self._values(subject))
        self._at.is_at(subject)
        return is_new

    def published(self, subject: object, now_ns: int) -> bool:
        """The translator said what is in force: a ScanParameters, Feedback or ProbePosition. Returns as above."""
        self._at.is_at(subject)
        new = [name for name, value in self._values(subject) if self._learn(name, value, now_ns)]
        return bool(new)

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, as plain JSON."""
        return {"usage": self._usage.snapshot(), "at": self._at.snapshot()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self._usage.restore(state["usage"])
        self._at.restore(state["at"])  # until it is published again

    # --- checks ---

    def _check(self, who: str, request: Request, now_ns: int, used: Collection[str] | None) -> None:
        subject = request.subject
        if request.kind == ControlRequest.ACTION:
            self._check_use(who, request.id, str(subject), self._limits.actions.get(str(subject)), now_ns, "action")
            return
        if isinstance(subject, Parameter) and subject.value is None:
            return
        if isinstance(subject, ScanParameters):
            self._check_scan(subject)
        elif isinstance(subject, ProbePosition):
            self._check_point(subject.xy_m)
        elif isinstance(subject, PositionChange):
            self._check_move(subject)
        elif isinstance(subject, Parameter):
            self._check_parameter_geometry(subject)
        for name, value in self._values(subject):
            limit = self._limits.parameters.get(name)
            if used is None or name in used:
                self._check_use(who, request.id, name, limit, now_ns, "parameter")
            if limit is not None:
                self._check_value(name, value, limit, now_ns)

    def _check_use(self, who: str, request_id: str, name: str, limit: Limit | None, now_ns: int, what: str) -> None:
        if limit is None:
            return
        error = ControlResponse.ACTION_ERROR if what == "action" else ControlResponse.PARAM_ERROR
        if limit.only is not None and not {who, component_of(who)} & set(limit.only):
            allowed = ", ".join(sorted(limit.only)) or "nobody"
            raise _Breach(error, f"{who} may not use the {what} {name}, only {allowed} ({limit.source})")
        last_ns = self._usage.last_ns(name, who, request_id)
        if limit.interval_s is not None and last_ns is not None and now_ns - last_ns < limit.interval_s * 1e9:
            ago_s = (now_ns - last_ns) / 1e9
            raise _Breach(
                error, f"{name} was used {ago_s:.3g} s ago, and may be every {limit.interval_s:g} s ({limit.source})"
            )

    def _check_value(self, name: str, value: float, limit: Limit, now_ns: int) -> None:
        unit = f" {limit.unit}" if limit.unit else f" {BASE_PARAMETERS.get(name) or ''}".rstrip()
        said = f"{name} = {value:g}{unit}"
        if limit.low is not None and value < limit.low - abs(limit.low) * _REACH:
            raise _param_error(f"{said} is below the lowest allowed, {limit.low:g}{unit} ({limit.source})")
        if limit.high is not None and value > limit.high + abs(limit.high) * _REACH:
            raise _param_error(f"{said} is above the highest allowed, {limit.high:g}{unit} ({limit.source})")
        if limit.step is None and limit.rate_per_s is None:
            return
        known = self._usage.known(name)
        if known is None:
            raise _param_error(
                f"{said}: its value now is not known, so the step to it can't be checked; get it first ({limit.source})"
            )
        change = abs(value - known.value)
        if limit.step is not None and change > limit.step * (1 + _REACH):
            raise _param_error(
                f"{said} is a step of {change:g}{unit}, the largest allowed is {limit.step:g}{unit} ({limit.source})"
            )
        allowed = None if limit.rate_per_s is None else limit.rate_per_s * (now_ns - known.since_ns) / 1e9
        if allowed is not None and change > allowed * (1 + _REACH):
            raise _param_error(
                f"{said} changes by {change:g}{unit}, now allowed is {allowed:.3g}{unit}, at {limit.rate_per_s:g}{unit}"
                f" per second ({limit.source})"
            )

    def _check_scan(self, wanted: ScanParameters, reach: float = _REACH) -> None:
        """What is checked is the scan as it would be afterwards: a request may give only a part of it."""
        shape, region = wanted.shape, wanted.region
        if isinstance(shape, ShapeChange):
            shape = shape.onto(self._at.shape or (1, 1))
        if shape is not None and shape[0] * shape[1] > self._limits.most_pixels:
            raise _param_error(f"a scan of {shape[1]} x {shape[0]} pixels; the most are {self._limits.most_pixels}")
        if isinstance(region, RegionChange):
            region = self._region_after(region)
        allowed = self._limits.region
        if region is None or allowed is None:
            return
        for x, y in region.corners_m():
            if not _inside(allowed, (float(x), float(y)), reach):
                raise _param_error(
                    f"the scan's corner ({x:.6g}, {y:.6g}) m lies outside the region allowed"
                    f" ({self._limits.region_source})"
                )

    def _region_after(self, change: RegionChange) -> Region | None:
        given = (change.left_m, change.low_m, change.width_m, change.height_m, change.angle_rad)
        for value in given:
            if value is not None and not math.isfinite(value):
                raise _param_error(f"a scan region can't have a {value} in it")
        for size in (change.width_m, change.height_m):
            if size is not None and size <= 0:
                raise _param_error(f"a scan region of size {size:g} m is empty")
        if self._at.region is not None:
            return change.onto(self._at.region)
        if self._limits.region is not None:
            raise _param_error("where the scan is now is not known, so a part of its place can't be checked")
        return None

    def _check_point(self, xy_m: XY, reach: float = _REACH) -> None:
        if not all(map(math.isfinite, xy_m)):
            raise _param_error(f"the probe can't go to {xy_m}: not a place")
        allowed = self._limits.region
        if allowed is not None and not _inside(allowed, xy_m, reach):
            raise _param_error(
                f"the probe position ({xy_m[0]:.6g}, {xy_m[1]:.6g}) m lies outside the region allowed"
                f" ({self._limits.region_source})"
            )

    def _check_place(self, action: str) -> None:
        if self._limits.region is None:
            return
        if action == names.START_SCAN:
            if self._at.region is None:
                raise _param_error("where the scan is now is not known")
            self._check_scan(ScanParameters(self._at.region), _TOLD_REACH)
        elif action in names.AT_PROBE:
            if self._at.probe is None:
                raise _param_error("where the probe is now is not known")
            self._check_point(self._at.probe, _TOLD_REACH)

    def _check_move(self, change: PositionChange) -> None:
        if self._limits.region is None:
            return
        if self._at.probe is None:
            raise _param_error("where the probe is now is not known, so a part of its place can't be checked")
        self._check_point(moved(self._at.probe, change))

    def _check_parameter_geometry(self, parameter: Parameter) -> None:
        """A single parameter may move or turn the scan, or make it too many pixels, as well."""
        for name, value in self._values(parameter):
            if name not in REGION_CHANGES and name not in PROBE_CHANGES and name not in SHAPE_CHANGES:
                continue
            if name in PROBE_CHANGES:
                self._check_move(PROBE_CHANGES[name](value))
            elif name in SHAPE_CHANGES:
                if value < 1 or value != int(value):
                    raise _param_error(f"{name} = {value:g}: pixels are counted from 1 in whole numbers")
                self._check_scan(ScanParameters(shape=SHAPE_CHANGES[name](int(value))))
            else:
                self._check_scan(ScanParameters(REGION_CHANGES[name](value)))

    # --- values ---

    def _values(self, subject: object) -> list[tuple[str, float]]:
        """Numbers of the parameters that a subject sets, in SI or the unit of their limit."""
        if isinstance(subject, Parameter):
            value = self._number(subject)
            return [] if value is None else [(subject.name, value)]
        if isinstance(subject, ScanParameters):
            return scan_values(subject)
        if isinstance(subject, Feedback):
            pairs = (
                (names.ZCTRL_SETPOINT, subject.setpoint),
                (names.ZCTRL_PGAIN, subject.proportional_gain),
                (names.ZCTRL_IGAIN, subject.integral_gain),
            )
            return [(name, _finite(name, value)) for name, value in pairs if value is not None]
        if isinstance(subject, ProbePosition | PositionChange):
            x, y = subject.xy_m if isinstance(subject, ProbePosition) else (subject.x_m, subject.y_m)
            return [
                (name, value) for name, value in ((names.PROBE_POS_X, x), (names.PROBE_POS_Y, y)) if value is not None
            ]
        return []

    def _number(self, parameter: Parameter) -> float | None:
        """The value of a parameter; None if it may be a text."""
        if parameter.value is None:
            return None
        limit = self._limits.parameters.get(parameter.name)
        must_be = parameter.name in BASE_PARAMETERS or (limit is not None and _is_numeric(limit))
        try:
            value = float(parameter.value)
        except ValueError:
            if not must_be:
                return None
            raise _param_error(f"{parameter.name} = {parameter.value!r} is not a number") from None
        _finite(parameter.name, value)
        unit = limit.unit if limit is not None and limit.unit is not None else BASE_PARAMETERS.get(parameter.name)
        # without a unit an angle is in degrees on the wire, everything else in SI
        given = parameter.unit or ("deg" if unit == "rad" else unit)
        if not given or unit is None or given == unit:
            return value
        try:
            return float(convert(value, given, unit))
        except AfspmError as error:
            raise _param_error(f"{parameter.name} = {parameter.value} {given}: {error}") from error

    def _learn(self, name: str, value: float, now_ns: int) -> bool:
        limit = self._limits.parameters.get(name)
        if limit is None or (limit.step is None and limit.rate_per_s is None):
            return False
        return self._usage.learn(name, value, now_ns)

    def _has_interval(self, name: str) -> bool:
        limit = self._limits.actions.get(name) or self._limits.parameters.get(name)
        return limit is not None and limit.interval_s is not None


def _param_error(reason: str) -> _Breach:
    return _Breach(ControlResponse.PARAM_ERROR, reason)


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise _param_error(f"{name} = {value}: not a finite number")
    return value


def _is_numeric(limit: Limit) -> bool:
    return any(bound is not None for bound in (limit.low, limit.high, limit.step, limit.rate_per_s))


def _inside(allowed: Region, xy_m: XY, reach: float) -> bool:
    grown = (allowed.size_m[0] * (1 + reach), allowed.size_m[1] * (1 + reach))
    return replace(allowed, size_m=grown).contains(xy_m)
