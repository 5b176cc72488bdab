"""The check of requests against the limits of an experiment.

Nothing is clamped. A refusal by a range, a step or a rate names the parameter, the value, the limit and its place in
the experiment file.

A check is valid only at its own moment: steps, rates and places are measured from the values in force. So a request is
checked right before it is sent, after all earlier commands have settled. `depends_on` names the values to read from the
microscope for that check.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from afspm.basics.errors import InvalidValue
from afspm.basics.formatting import lengths_text, position_text, quantity
from afspm.basics.frozen import replace
from afspm.basics.units import convert, si_unit_or_none
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    Request,
    Response,
    ResponseDetail,
    ScanParameters,
    component_of,
    names,
)
from afspm.model.geometry import XY
from afspm.model.parameter_names import BASE_PARAMETERS
from afspm.model.positions import (
    PROBE_CHANGES,
    REGION_CHANGES,
    SHAPE_CHANGES,
    KnownPosition,
    changes_by,
    moved,
)
from afspm.model.scan import ShapeChange
from afspm.scheduler.safety import forbidden_states, movers
from afspm.scheduler.safety.forbidden_states import PresentState
from afspm.scheduler.safety.limit_state import LastUse, LimitState, Usage
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState, Limit
from afspm.scheduler.safety.movers import MoverSettings, MoverState
from afspm.scheduler.safety.parameter_values import ParameterValue, ParameterValueError, numbers, values_of

_ROUNDED_OF_STEP = 0.1
_REACH = 1e-9  # relative: a value on the border, to the precision of the arithmetic, is inside
_ROUNDED = 0.01  # of the largest step of a stage: how far it rounds a target
_TOLD_REACH = 1e-3  # the same for a place read from a controller, which rounds to its steps and to single precision
_PLACES = ((frozenset(REGION_CHANGES), frozenset({names.START_SCAN})), (frozenset(PROBE_CHANGES), names.AT_PROBE))
"""The parameters of each place, with the actions that happen there."""
_TREATMENTS = {
    names.PULSE: (names.PULSE_VOLTAGE, names.PULSE_DURATION),
    names.CRASH: (names.CRASH_DEPTH, names.CRASH_SPEED),
}
"""The parameters that a treatment of the tip uses as they are in force."""
_IN_FORCE = (
    names.TIP_BIAS_VOLTAGE, names.SAMPLE_BIAS, names.ZCTRL_SETPOINT, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN,
    names.SCAN_SPEED,
)  # fmt: skip
"""The settings with which a measurement or treatment takes place; no request of the run may have set them."""
_OF_BIAS_CURVES = frozenset((*names.SPEC_ENDS, names.SPEC_Z_OFFSET, names.LOCK_IN_AMPLITUDE))
_OF_HEIGHT_CURVES = frozenset((*names.SPEC_Z_ENDS, names.LOCK_IN_AMPLITUDE))
_OF_CURVES = _OF_BIAS_CURVES | _OF_HEIGHT_CURVES
"""The values that limits judge right before a curve, by the swept quantity."""
_READ_FOR_ACTIONS = _OF_CURVES.union(*_TREATMENTS.values(), _IN_FORCE)


class _Breach(Exception):
    """The error that a limit is broken; raised and caught in this module alone."""

    def __init__(
        self,
        code: ControlResponse,
        reason: str,
        again_ns: int | None = None,
        detail: ResponseDetail = ResponseDetail.NONE,
    ) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason
        self.again_ns = again_ns
        self.detail = detail


class _Use(NamedTuple):
    who: str
    request_id: str
    now_ns: int
    is_repeated: bool


@dataclass(frozen=True)
class LimitChecker:
    """The check of requests against the limits, with the values that steps and rates are measured from."""

    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    state: LimitState = field(default_factory=LimitState)

    def check(
        self,
        who: str,
        request: Request,
        now_ns: int,
        used: Collection[str] | None = None,
        *,
        is_repeated: bool = False,
    ) -> Response | None:
        """Return the refusal of a request that breaks a limit or is malformed; None: it may be sent.

        Args:
            used: the parameters that `who` sets; the others of the request only change with them. None: all.
            is_repeated: whether this request was sent before with an unknown outcome, and is no second use.
        """
        try:
            self._check(_Use(who, request.id, now_ns, is_repeated), request, used)
            self._check_movers(request)
        except _Breach as breach:
            return Response(int(breach.code), b"", breach.reason, request.id, breach.detail, breach.again_ns)
        except (ParameterValueError, InvalidValue) as error:
            return Response(int(ControlResponse.PARAM_ERROR), b"", str(error), request.id)
        return None

    def check_place(self, request: Request) -> Response | None:
        """Return the refusal of an action at the present place, or with the settings in force; None: it may start.

        A person may have changed both.
        """
        try:
            self._check_place(str(request.subject))
        except _Breach as breach:
            return _action_error(request, breach)
        return self.check_values(request)

    def check_values(self, request: Request) -> Response | None:
        """Return the refusal of a measurement or a treatment with the values in force; None: it may start."""
        if self._is_curve(request):
            try:
                self._check_curve()
            except _Breach as breach:
                return _action_error(request, breach)
        for name in _used_by(request):
            limit, known = self.limits.parameters.get(name), self.state.usage.known.get(name)
            if limit is None or known is None:
                continue
            try:
                self._check_range(name, known.value, limit, _TOLD_REACH)
            except _Breach as breach:
                breach.reason += ", and is in force: set it back at the panel, or by a request"
                return _action_error(request, breach)
        return None

    def check_forbidden(self, request: Request, present: PresentState) -> Response | None:
        """Return the refusal of a request that leads into a forbidden state; None: it may be sent."""
        why = forbidden_states.refusal(self._with_sweep(request), request, present)
        return Response(int(_error_of(request)), b"", why, request.id) if why else None

    def _with_sweep(self, request: Request) -> ExperimentLimits:
        # a curve that sweeps the bias sets it to both ends; where they are not shown, the bias in force counts
        kind, ends = self.kind_of_curve, [self.state.usage.known.get(name) for name in names.SPEC_ENDS]
        if not self._is_curve(request) or kind not in names.SWEEPS_BIAS or None in ends:
            return self.limits
        swept = tuple(Parameter(names.TIP_BIAS_VOLTAGE, repr(end.value), "V") for end in ends if end is not None)
        return dataclasses.replace(self.limits, sets={**self.limits.sets, names.START_SPEC: swept})

    @staticmethod
    def _is_curve(request: Request) -> bool:
        return request.kind == ControlRequest.ACTION and request.subject == names.START_SPEC

    @property
    def kind_of_curve(self) -> str:
        """The present kind of curve, as last read; empty if unknown."""
        reported = self.state.last_seen.get(names.SPEC_KIND)
        return (reported and reported.value) or ""

    def beyond_range(self, wanted: Parameter) -> str:
        """Return why a value lies outside its range; empty: it does not."""
        limit, value = self.limits.parameters.get(wanted.name), self.number(wanted)
        if limit is not None and value is not None:
            try:
                self._check_range(wanted.name, value, limit, _TOLD_REACH)
            except _Breach as breach:
                return breach.reason
        return ""

    def outside(self, changed: Parameter) -> str:
        """Return why a value that a person has set lies outside its range or in a forbidden state; empty: neither."""
        if beyond := self.beyond_range(changed):
            return beyond
        present = PresentState(
            {name: (value,) for name, value in {**self.state.last_seen, changed.name: changed}.items()}
        )
        rules = (rule for rule in self.limits.forbid.values() if changed.name in rule.names)
        return next(filter(None, (forbidden_states.now_forbidden(rule, present) for rule in rules)), "")

    def depends_on(self, request: Request, *, is_mapped: bool = False) -> list[str]:
        """Return the parameters to read before a request is checked.

        The value set or published last is not enough. A request of unknown outcome or a person at the panel may have
        changed it, and an old packet may arrive after the answer to a newer request.

        Args:
            is_mapped: a mapped place is sent as a whole, even if the client set only a part of it.
        """
        parameters = self.names_set_by(request)
        needed = [name for name in parameters if name in self.limits.bounded]
        limited = self.limits.parameters
        needed += [name for name in _used_by(request) if name in limited and limited[name].is_of_a_number]
        if self._is_curve(request):
            needed += self._ends_to_read()
        if self.state.movers.is_unproved and (request.subject in movers.MEASURES or self._switches_on(request)):
            needed += movers.SIGNAL
        if self.limits.region is not None or is_mapped:
            action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
            for place, actions in _PLACES:
                if action in actions or 0 < len(place.intersection(parameters)) < len(place):
                    needed += sorted(place)
        if len(SHAPE_CHANGES.keys() & parameters) == 1:
            needed += sorted(SHAPE_CHANGES)
        needed += forbidden_states.to_read(self._judging(request, is_mapped=is_mapped))
        if not needed:
            return needed
        for place, _ in _PLACES:
            if place.intersection(needed):  # a place of values read at different times would be a wrong one
                needed += sorted(place)
        return list(dict.fromkeys(needed))

    def _judging(self, request: Request, *, is_mapped: bool) -> list[ForbiddenState]:
        rules = forbidden_states.judging(self.limits, request)
        if is_mapped:
            parameters = set(self.names_set_by(request))
            moved_ones = frozenset[str]().union(*(place for place, _ in _PLACES if place & parameters))
            rules += [rule for rule in self.limits.forbid.values() if rule not in rules and rule.names & moved_ones]
        return rules

    def to_be_known(self) -> list[str]:
        """Return the parameters to read when a translator connects: those with a limited rate, and in rules."""
        return list(dict.fromkeys((*self.limits.rated, *forbidden_states.to_read(self.limits.forbid.values()))))

    def seen(self, values: Iterable[Parameter]) -> LimitChecker:
        """Store the last known values of quantities in forbidden states."""
        wanted = frozenset({names.SPEC_KIND}).union(*(rule.names for rule in self.limits.forbid.values()))
        new = {value.name: value for value in values if value.name in wanted}
        if not new:
            return self
        return replace(self, state=replace(self.state, last_seen={**self.state.last_seen, **new}))

    def was_read(self, values: Mapping[str, Parameter | None], now_ns: int) -> LimitChecker:
        """Store values that were read for a check.

        Args:
            values: None where the microscope answered without a value. A parameter that it does not have is left out.
        """
        numbers_read = {name: None if reported is None else self.number(reported) for name, reported in values.items()}
        usage = self.state.usage
        for name in _OF_CURVES - values.keys() - self.limits.bounded:  # not shown any more
            usage = usage.forget(name)
        for name, value in numbers_read.items():
            if value is None:
                usage = usage.forget(name)
            elif name in self.limits.bounded or name in _READ_FOR_ACTIONS:
                usage = usage.learn(name, value, now_ns, was_read=True)
        others = {name: value for name, value in self.state.last_seen.items() if name != names.SPEC_KIND}
        read = replace(self, state=replace(self.state, last_seen=others))
        read = read.seen(value for value in values.values() if value is not None)
        if names.ENGAGED in values:
            read = read._with_movers(read.state.movers.read(values, now_ns))
        return read._with_state(usage, self.state.position.was_read(numbers_read))

    def with_movers(self, change: Callable[[MoverState], MoverState]) -> LimitChecker:
        """Store what was seen of the movers and the tip."""
        return self._with_movers(change(self.state.movers))

    def seems_moved(self, name: str, target: float) -> bool:
        """Return whether the target of a stage is another one than the run has set."""
        mover, known = self.limits.movers.movers.get(name), self.state.usage.known.get(name)
        step = self.limits.parameters[name].step if name in self.limits.parameters else None
        return mover is not None and known is not None and abs(target - known.value) > _ROUNDED * (step or 0.0)

    def _with_movers(self, state: MoverState) -> LimitChecker:
        if not self.limits.movers.movers or state == self.state.movers:
            return self
        return replace(self, state=replace(self.state, movers=state))

    def _moves(self, request: Request) -> list[tuple[str, float]]:
        # each mover of a request with its way; the value in force was read for this decision
        known = self.limits.movers.movers
        if not known:
            return []
        if request.kind == ControlRequest.ACTION:
            mover = known.get(str(request.subject))
            return [(str(request.subject), float(mover.steps or 0))] if mover is not None else []
        found = list[tuple[str, float]]()
        for name, value in (one for subject in self._set_by(request) for one in self._valid_values(subject)):
            if name in known and value is not None:
                before = self.state.usage.known.get(name) or self.state.usage.before.get(name)
                found.append((name, 0.0 if before is None else abs(value - before.value)))
        return found

    def _moving(self, who: str, request: Request, *, is_repeated: bool) -> LimitChecker:
        settings, moved = self.limits.movers, self.state.movers
        for name, way in self._moves(request):
            moved = moved.sent(settings, name, way, f"{who} {request.id}", is_repeated=is_repeated)
        action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
        if action in names.APPROACHES:
            moved = moved.approaching(settings, action)
        elif action == names.RETRACT:
            moved = moved.withdrawn()
        elif self._switches_on(request):
            moved = moved.near()
        return self._with_movers(moved)

    def _switches_on(self, request: Request) -> bool:
        values = (forbidden_states.values_in(subject).get(names.FEEDBACK_ON) for subject in self._set_by(request))
        return any(map(movers.is_on, values))

    def _check_movers(self, request: Request) -> None:
        settings, state = self.limits.movers, self.state.movers
        for name, way in self._moves(request):
            why, detail = state.refusal(settings, name, way)
            if why:
                raise _Breach(_error_of(request), why, detail=detail)
        action = request.subject if request.kind == ControlRequest.ACTION else None
        if action in settings.undeclared:
            why = f"{action} moves the coarse motor: declare it in the experiment file ([limits.movers.{action}])"
            raise _Breach(ControlResponse.ACTION_ERROR, why)
        if action in movers.MEASURES:
            why, again_ns = state.refuses_to_measure(settings)
            if why:
                raise _Breach(ControlResponse.ACTION_ERROR, f"{action}: {why}", again_ns)
        if action in names.APPROACHES and state.is_unproved and action != settings.approach:
            raise _Breach(ControlResponse.ACTION_ERROR, f"{action} may not reach the sample: {_unproved(settings)}")
        is_away = not movers.is_on(self.state.last_seen.get(names.ENGAGED))
        if state.is_unproved and is_away and self._switches_on(request):
            raise _Breach(_error_of(request), f"the feedback would bring the tip to the sample: {_unproved(settings)}")

    def unknown(self, request: Request) -> LimitChecker:
        """Forget the values that a request of unknown outcome may have changed."""
        parameters = self.names_set_by(request)
        usage = self.state.usage
        for name in parameters:
            usage = usage.forget(name)
        return self._with_state(usage, self.state.position.without(parameters))

    def forget(self, name: str) -> LimitChecker:
        """Forget the value of a parameter that could not be read."""
        return self._with_usage(self.state.usage.forget(name))

    def sending(
        self,
        who: str,
        request: Request,
        now_ns: int,
        used: Collection[str] | None = None,
        *,
        is_repeated: bool = False,
    ) -> LimitChecker:
        """Count the uses of a checked request that is about to be sent.

        The time of a change is unknown until the request has settled, so values with a limited rate are set aside.
        """
        usage = self.state.usage
        for name in self._counted_uses(request, used):
            usage = usage.use_sent(name, LastUse(now_ns, who, request.id))
        for name in self.limits.rated.intersection(self.names_set_by(request)) if self.limits.rated else ():
            usage = usage.changing(name)
        checker = self._with_usage(usage)
        return checker._moving(who, request, is_repeated=is_repeated) if self.limits.movers.movers else checker

    def counts(self, request: Request) -> bool:
        """Return whether the interval between two requests of this kind is limited."""
        return bool(self._counted_uses(request, None))

    def not_done(self, who: str, request: Request, used: Collection[str] | None = None) -> LimitChecker:
        """Undo the uses of a request that was certainly not carried out."""
        usage = self.state.usage
        for name in self._counted_uses(request, used):
            usage = usage.use_undone(name, who, request.id)
        for name in self.names_set_by(request):
            usage = usage.unchanged(name)
        moved = self.state.movers
        for name, way in self._moves(request):
            moved = moved.undone(name, way, f"{who} {request.id}")
        return self._with_usage(usage)._with_movers(moved)

    def carried_out(
        self,
        request: Request,
        now_ns: int,
        answered: Parameter | None = None,
        used: Collection[str] | None = None,
        who: str = "",
    ) -> LimitChecker:
        """Store the values set or read by a successful request.

        Args:
            answered: the parameter in the translator's answer.
        """
        if is_get(request):
            if answered is None or not _has_value_of(answered, request.subject):
                return self.forget(request.subject.name)
            return self.in_force(answered, now_ns, was_read=True)
        usage = self.state.usage
        for name in self._counted_uses(request, used):
            usage = usage.use_done(name, LastUse(now_ns, who, request.id))
        moved = self.state.movers.done(f"{who} {request.id}") if self._moves(request) else self.state.movers
        checker = self._with_usage(usage)._with_movers(moved)
        for subject in self._set_by(request):
            # the value in the microscope's answer, rather than the one that was sent
            in_force = (
                answered
                if isinstance(subject, Parameter) and answered is not None and _has_value_of(answered, subject)
                else subject
            )
            checker = checker.in_force(in_force, now_ns)
        return checker

    def published(self, subject: object, now_ns: int) -> LimitChecker:
        """Store the position, and changes of values with a limited rate, from a published message."""
        usage = self.state.usage
        for name, value in numbers(self._valid_values(subject)):
            if name in self.limits.rated:
                usage = usage.learn(name, value, now_ns)
        return self._with_seen(subject, usage, self.state.position)

    def in_force(self, subject: object, now_ns: int, *, was_read: bool = False) -> LimitChecker:
        """Store values that were set or read: a ScanParameters, Feedback, Parameter …"""
        values, usage, position = numbers(self._valid_values(subject)), self.state.usage, self.state.position
        if isinstance(subject, Parameter):
            if not values:  # a malformed value of a microscope is no reason to refuse a request: it counts as unknown
                usage = usage.forget(subject.name)
            position = position.learn_values(values)
        for name, value in values:
            if name in self.limits.bounded:
                usage = usage.learn(name, value, now_ns, was_read=was_read)
        return self._with_seen(subject, usage, position)

    def _with_seen(self, subject: object, usage: Usage, position: KnownPosition) -> LimitChecker:
        checker = self.seen(forbidden_states.values_in(subject).values()) if self.limits.forbid else self
        return checker._with_state(usage, position.learn(subject))

    def _with_state(self, usage: Usage, position: KnownPosition) -> LimitChecker:
        if usage is self.state.usage and position is self.state.position:
            return self
        return replace(self, state=replace(self.state, usage=usage, position=position))

    def _with_usage(self, usage: Usage) -> LimitChecker:
        return self if usage is self.state.usage else replace(self, state=replace(self.state, usage=usage))

    def _counted_uses(self, request: Request, used: Collection[str] | None) -> list[str]:
        counted = self.limits.counted
        if not counted:
            return []
        uses = [name for name in self.names_set_by(request) if used is None or name in used]
        if request.kind == ControlRequest.ACTION:
            uses.append(str(request.subject))
        return [name for name in uses if name in counted]

    def next_step(self, now: Parameter, wanted: Parameter) -> Parameter:
        """Return the farthest value on the way from one value to another that the largest step allows."""
        limit = self.limits.parameters.get(wanted.name)
        start, end = self.number(now), self.number(wanted)
        if limit is None or limit.step is None or start is None or end is None:
            return wanted
        if wanted.name == names.TIP_BIAS_VOLTAGE and start * end < 0.0 and abs(end - start) > limit.step:
            end = _beside_zero(start, end, limit.step)
            wanted = Parameter(wanted.name, f"{end:.12g}", limit.unit or wanted.unit)
        count = math.ceil(abs(end - start) / limit.step * (1 - _REACH))
        if count <= 1:
            return wanted
        return Parameter(wanted.name, f"{start + (end - start) / count:.12g}", limit.unit or wanted.unit)

    def names_set_by(self, request: Request) -> list[str]:
        """Return the parameters that a request sets. Malformed values have no name: `check` refuses such a request."""
        values = [value for subject in self._set_by(request) for value in self._valid_values(subject)]
        return list(dict.fromkeys(value.name for value in values))

    def _valid_values(self, subject: object) -> list[ParameterValue]:
        try:
            return values_of(subject, self.limits.parameters)
        except ParameterValueError:
            return []

    def number(self, reported: Parameter) -> float | None:
        """Return a value in the unit of its limit, or in SI; None for a text or without a value."""
        limits = self.limits.parameters
        if reported.name in _READ_FOR_ACTIONS and reported.name not in limits:
            # in SI, for the ranges of roles and grants
            limits = {reported.name: Limit(unit=si_unit_or_none(reported.unit or ""))}
        try:
            return next((value.number for value in values_of(reported, limits)), None)
        except ParameterValueError:
            return None

    # --- checks ---

    def _check(self, use: _Use, request: Request, used: Collection[str] | None) -> None:
        if request.kind == ControlRequest.ACTION:
            action = str(request.subject)
            self._check_use(use, action, self.limits.actions.get(action), "action")
            try:
                self._check_settings(use, request, used)
            except (_Breach, ParameterValueError, InvalidValue) as breach:
                again_ns = breach.again_ns if isinstance(breach, _Breach) else None
                raise _Breach(ControlResponse.ACTION_ERROR, f"{action}: {breach}", again_ns) from breach
        else:
            self._check_settings(use, request, used)

    def _check_settings(self, use: _Use, request: Request, used: Collection[str] | None) -> None:
        subjects = self._set_by(request)
        values = [value for subject in subjects for value in values_of(subject, self.limits.parameters)]
        # several parameters together may also move or turn the scan, or give it too many pixels
        are_parameters = all(isinstance(subject, Parameter) for subject in subjects)
        for place in changes_by(numbers(values)) if are_parameters else subjects:
            if isinstance(place, ScanParameters):
                self._check_scan(place)
            elif isinstance(place, ProbePosition):
                self._check_point(place.xy_m)
            elif isinstance(place, PositionChange):
                self._check_move(place)
        for name, value in values:
            limit = self.limits.parameters.get(name)
            if used is None or name in used:
                self._check_use(use, name, limit, "parameter")
            if limit is not None and value is not None:
                self._check_value(name, value, limit, use.now_ns)
            if name == names.HELD_Z_OFFSET and value is not None and value < 0.0:
                _check_towards(value, limit)
            if name in _OF_CURVES and value is not None:
                for one in self._limits_on(name):
                    self._check_of_curve(name, value, one)

    def _set_by(self, request: Request) -> Collection[object]:
        # an action of the experiment file sets parameters at the microscope
        if request.kind == ControlRequest.ACTION:
            return self.limits.sets.get(str(request.subject), ())
        return () if is_get(request) else (request.subject,)

    def _check_use(self, use: _Use, name: str, limit: Limit | None, what: str) -> None:
        if limit is None:
            return
        who, now_ns = use.who, use.now_ns
        error = ControlResponse.ACTION_ERROR if what == "action" else ControlResponse.PARAM_ERROR
        if limit.only is not None and not {who, component_of(who)} & set(limit.only):
            rule = f"only {', '.join(sorted(limit.only))} may" if limit.only else "no component may"
            raise _Breach(error, f"{who} may not use the {what} {name}: {rule} ({limit.source})")
        last_ns = self.state.usage.last_ns(name, (who, use.request_id) if use.is_repeated else None)
        if limit.interval_s is not None and last_ns is not None and now_ns - last_ns < limit.interval_s * 1e9:
            ago_s = (now_ns - last_ns) / 1e9
            raise _Breach(
                error,
                f"{name} was used {ago_s:.3g} s ago, its shortest interval is {limit.interval_s:g} s ({limit.source})",
                last_ns + math.ceil(limit.interval_s * 1e9),
            )

    def _check_range(self, name: str, value: float, limit: Limit, reach: float = _REACH) -> None:
        text = partial(_amount_text, name, limit)
        setting = f"{name} = {text(value)}"
        if limit.low is not None and value < limit.low - abs(limit.low) * reach:
            raise _param_error(f"{setting} is below the lowest allowed, {text(limit.low)} ({limit.source})")
        if limit.high is not None and value > limit.high + abs(limit.high) * reach:
            raise _param_error(f"{setting} is above the highest allowed, {text(limit.high)} ({limit.source})")

    def _check_of_curve(self, name: str, value: float, limit: Limit, reach: float = _REACH) -> None:
        # by a limit of its own, or on the quantity that it is, which may count in another unit
        own, si = self.limits.parameters.get(name), names.OF_CURVES[name]
        unit = limit.unit or si
        in_unit = float(convert(value, (own and own.unit) or si, unit))
        self._check_range(name, in_unit, replace(limit, unit=unit), reach)

    def _limits_on(self, name: str) -> list[Limit]:
        # of a value of a curve: its own, and those of the quantity that it is
        same = {names.SPEC_Z_OFFSET: names.SPEC_Z_ENDS, **dict.fromkeys(names.SPEC_ENDS, (names.TIP_BIAS_VOLTAGE,))}
        found = map(self.limits.parameters.get, (name, *same.get(name, ())))
        return [limit for limit in found if limit is not None and limit.has_range]

    def _ends_to_read(self) -> list[str]:
        in_rules = any(names.TIP_BIAS_VOLTAGE in rule.names for rule in self.limits.forbid.values())
        needed = {name for name in _OF_CURVES if self._limits_on(name)}.union(names.SPEC_ENDS if in_rules else ())
        return [names.SPEC_KIND, *sorted(needed)] if needed else []

    def _check_curve(self) -> None:
        kind = self.kind_of_curve or "of no known kind"
        sweeps_bias, sweeps_height = kind not in names.SWEEPS_HEIGHT, kind not in names.SWEEPS_BIAS
        mine = (_OF_BIAS_CURVES if sweeps_bias else frozenset()) | (_OF_HEIGHT_CURVES if sweeps_height else frozenset())
        for name in sorted(mine):
            known, own = self.state.usage.known.get(name), self.limits.parameters.get(name)
            for limit in self._limits_on(name):
                # the table's ends are not those of a vector program
                if known is not None and not (sweeps_bias and sweeps_height):
                    self._check_of_curve(name, known.value, limit, _TOLD_REACH)
                # a microscope that shows no height of its own for a sweep of the bias has none
                elif not limit.unseen_sweeps and (name != names.SPEC_Z_OFFSET or limit is own):
                    raise _param_error(_unseen(kind, name, limit))

    def _check_value(self, name: str, value: float, limit: Limit, now_ns: int) -> None:
        text = partial(_amount_text, name, limit)
        setting = f"{name} = {text(value)}"
        self._check_range(name, value, limit)
        if not limit.bounds_changes:
            return
        known = self.state.usage.known.get(name)
        if known is None:
            raise _param_error(
                f"{setting}: the microscope reports no value now, so the step can't be checked ({limit.source})"
            )
        change = abs(value - known.value)
        if limit.step is not None and change > limit.step * (1 + _REACH):
            raise _param_error(
                f"{setting} is a step of {text(change)}, the largest allowed is {text(limit.step)} ({limit.source})"
            )
        if limit.rate_per_s is None:
            return
        allowed = limit.rate_per_s * (now_ns - known.since_ns) / 1e9
        moved_since = change + abs(known.value - known.origin)
        if moved_since > allowed * (1 + _REACH):
            ago_s = (now_ns - known.since_ns) / 1e9
            raise _param_error(
                f"{setting} changes by {text(moved_since)} within {ago_s:.3g} s, allowed is at most {text(allowed, 3)},"
                f" at {text(limit.rate_per_s)} per second ({limit.source})",
                known.since_ns + math.ceil(moved_since / limit.rate_per_s * 1e9),
            )

    def _check_scan(self, wanted: ScanParameters, reach: float = _REACH) -> None:
        shape, region = wanted.shape, wanted.region
        if isinstance(shape, ShapeChange):
            shape = shape.onto(self.state.position.shape or (1, 1))
        if shape is not None and shape[0] * shape[1] > self.limits.most_pixels:
            raise _param_error(
                f"a scan of {shape[1]} x {shape[0]} pixels is above the highest number allowed,"
                f" {self.limits.most_pixels} pixels ({self.limits.most_pixels_source}): choose fewer"
            )
        if isinstance(region, RegionChange):
            region = self._region_after(region)
        allowed = self.limits.region
        if region is None or allowed is None:
            return
        for x, y in region.corners_m():
            if not _inside(allowed, (float(x), float(y)), reach):
                raise _param_error(
                    f"the scan's corner {position_text((float(x), float(y)))} lies outside the region allowed"
                    f" ({self.limits.region_source})"
                )

    def _region_after(self, change: RegionChange) -> Region | None:
        given = (change.left_m, change.low_m, change.width_m, change.height_m, change.angle_rad)
        for value in given:
            if value is not None and not math.isfinite(value):
                raise _param_error(f"a scan region can't have a {value} in it")
        for size in (change.width_m, change.height_m):
            if size is not None and size <= 0:
                raise _param_error(f"a scan region of size {lengths_text([size])} is empty")
        if self.state.position.region is not None:
            return change.onto(self.state.position.region)
        if self.limits.region is not None:
            raise _param_error("the microscope has not reported its scan region, so a part of it can't be checked")
        return None

    def _check_point(self, xy_m: XY, reach: float = _REACH) -> None:
        if not all(map(math.isfinite, xy_m)):
            raise _param_error(f"the probe can't go to {xy_m}: not a place")
        allowed = self.limits.region
        if allowed is not None and not _inside(allowed, xy_m, reach):
            raise _param_error(
                f"the probe position {position_text(xy_m)} lies outside the region allowed"
                f" ({self.limits.region_source})"
            )

    def _check_place(self, action: str) -> None:
        if self.limits.region is None:
            return
        if action == names.START_SCAN:
            if self.state.position.region is None:
                raise _param_error("the microscope has not reported its scan region")
            self._check_scan(ScanParameters(self.state.position.region), _TOLD_REACH)
        elif action in names.AT_PROBE:
            if self.state.position.probe_m is None:
                raise _param_error("the microscope has not reported its probe position")
            self._check_point(self.state.position.probe_m, _TOLD_REACH)

    def _check_move(self, change: PositionChange) -> None:
        if self.limits.region is None:
            return
        if self.state.position.probe_m is None:
            raise _param_error("the microscope has not reported its probe position, so a part of it can't be checked")
        self._check_point(moved(self.state.position.probe_m, change))


def _check_towards(value: float, limit: Limit | None) -> None:
    # without a feedback nothing else keeps the tip from the sample
    if limit is None or limit.low is None:
        offset = quantity(value, (limit and limit.unit) or "m")
        raise _param_error(
            f"{names.HELD_Z_OFFSET} = {offset} is towards the sample, which no limit bounds: write "
            f"[limits.{names.HELD_Z_OFFSET}] min = … into the experiment file"
        )


def _unseen(kind: str, end: str, limit: Limit) -> str:
    return (
        f"a curve {kind} may have any {end}: the microscope does not show how far it goes, so that the limit "
        f"can't be kept ({limit.source}); where the range set at the panel is known to be safe, allow it there: "
        "unseen_sweeps = true"
    )


def _amount_text(name: str, limit: Limit, amount: float, digits: int = 6) -> str:
    return quantity(amount, limit.unit or BASE_PARAMETERS.get(name) or "", digits)


def _unproved(settings: MoverSettings) -> str:
    return f"the tip is not proved there since a move, or the begin of the run: approach ({settings.approach})"


def _error_of(request: Request) -> ControlResponse:
    is_action = request.kind == ControlRequest.ACTION
    return ControlResponse.ACTION_ERROR if is_action else ControlResponse.PARAM_ERROR


def _used_by(request: Request) -> tuple[str, ...]:
    # the parameters that an action uses as they are in force
    action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
    is_at_sample = action in (names.START_SCAN, names.START_SPEC, *names.TREATMENTS)
    return (*_TREATMENTS.get(action, ()), *(_IN_FORCE if is_at_sample else ()))


def _action_error(request: Request, breach: _Breach) -> Response:
    return Response(int(ControlResponse.ACTION_ERROR), b"", f"{request.subject}: {breach.reason}", request.id)


def _param_error(reason: str, again_ns: int | None = None) -> _Breach:
    return _Breach(ControlResponse.PARAM_ERROR, reason, again_ns)


def _inside(allowed: Region, xy_m: XY, reach: float) -> bool:
    grown = (allowed.size_m[0] * (1 + reach), allowed.size_m[1] * (1 + reach))
    return dataclasses.replace(allowed, size_m=grown).contains(xy_m)


def is_get(request: Request) -> bool:
    """Return whether a request reads a parameter."""
    return isinstance(request.subject, Parameter) and request.subject.value is None


def _has_value_of(reported: Parameter, asked: Parameter) -> bool:
    return reported.value is not None and reported.name == asked.name


def _beside_zero(start: float, end: float, step: float) -> float:
    # no step of a bias ends near 0 V, where a feedback drives the tip into the sample: one passes it from side to side
    near = min(step / 2.0, abs(start), abs(end))
    if abs(start) - near > _ROUNDED_OF_STEP * step:  # a controller that rounds is beside it
        return math.copysign(near, start)
    return math.copysign(min(step - abs(start), abs(end)), end)
