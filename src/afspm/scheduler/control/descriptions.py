"""Texts for people about requests, changes of control, and settings changed in MANUAL mode."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from afspm.basics.formatting import (
    PREFIXABLE,
    area_text,
    duration_text,
    lengths_text,
    position_text,
    quantity,
    unit_text,
)
from afspm.basics.frozen import replace
from afspm.model import (
    GRANT_REQUEST,
    LEASE_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    Feedback,
    Grant,
    Parameter,
    PositionChange,
    ProbePosition,
    ProblemNames,
    Region,
    RegionChange,
    Request,
    ScanParameters,
    names,
    request_name,
)
from afspm.model.panel import ChangedValue
from afspm.model.requests import AS_PLANNED_REQUEST, KEEP_REQUEST, LEND_REQUEST, RETURN_REQUEST, Settings
from afspm.model.scan import ShapeChange
from afspm.scheduler.control.arbitration import (
    ArbitrationEvent,
    ArbitrationState,
    Cause,
    ControlInput,
    Rules,
    Transition,
)

# for each field of the feedback its word, and the parameter that has the same value with its unit
_FEEDBACK_WORDS = {
    "on": ("feedback", names.FEEDBACK_ON),
    "proportional_gain": ("P gain", names.ZCTRL_PGAIN),
    "integral_gain": ("I gain", names.ZCTRL_IGAIN),
    "setpoint": ("setpoint", names.ZCTRL_SETPOINT),
}


def is_routine(before: ArbitrationState, after: ArbitrationState, ask: ControlInput, holder_logged: str | None) -> bool:
    """Return whether a change is routine: control is released, or returns to the holder logged last.

    A change is never routine while a problem is flagged, or if the mode or the end changes.
    """
    if (after.problems, after.mode, after.ended) != (before.problems, before.mode, before.ended) or after.problems:
        return False
    return ask.event is ArbitrationEvent.RELEASE_CONTROL if after.holder is None else after.holder == holder_logged


def change_text(
    before: ArbitrationState, after: ArbitrationState, ask: ControlInput, row: Transition, rules: Rules
) -> str:
    """Return the log text of a change of control."""
    parts = []
    if after.holder != before.holder and after.holder is not None:
        parts.append(f"{after.holder} is in control")
        if after.solving:
            parts.append(f"to solve {rules.problems.name(after.solving)}")
    for number in sorted(after.problems.keys() ^ before.problems.keys()):
        done = "flagged" if number in after.problems else "cleared"
        parts.append(f"{ask.who} {done} {rules.problems.name(number)};")
    if after.mode is not before.mode and row.cause is Cause.BY_HAND:
        parts.append(f"{ask.why}: the mode is MANUAL, and nothing is sent to the microscope until `afspm continue`;")
    elif after.mode is not before.mode:
        parts.append(f"{ask.who} switched to {after.mode.name};")
    if after.ended and not before.ended:
        parts.append(f"{ask.who} ended the experiment;")
    if before.holder is not None and after.holder is None and row.cause is not None:
        parts.append(_ended_control(before.holder, row.cause))
    return " ".join(parts).rstrip(";") or f"{ask.who} {ask.event.value}"


def _ended_control(holder: str, cause: Cause) -> str:
    # the text before this one names the cause, except where the holder itself is the cause
    match cause:
        case Cause.RELEASED:
            return f"{holder} gave control back"
        case Cause.DEAD | Cause.IDLE | Cause.REVOKED:
            return f"{holder} lost control: {cause.text}"
        case _:
            return f"{holder} lost control"


@dataclass(frozen=True)
class HandSettings:
    """Settings changed in MANUAL mode, by requests or at the panel.

    Attributes:
        parameters: the values by name.
        at_panel: for each parameter changed only at the panel, its value when MANUAL began.
        before: the feedback in force when MANUAL began; None: not known.
        now: the feedback in force; None: not known.
    """

    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    at_panel: Mapping[str, str] = field(default_factory=dict)
    before: Feedback | None = None
    now: Feedback | None = None

    def requested(self, request: Request) -> HandSettings:
        """Add the parameter set by a request in MANUAL mode."""
        parameter = request.subject
        if not isinstance(parameter, Parameter) or parameter.value is None:
            return self
        return replace(self, parameters={**self.parameters, parameter.name: parameter})

    def changed(self, change: ChangedValue) -> HandSettings:
        """Add a setting changed at the panel in MANUAL mode; remove it if it has its first value again."""
        name, at_panel = change.parameter, self.at_panel
        if name not in self.parameters:
            at_panel = {**at_panel, name: at_panel.get(name, change.before)}
        parameters = {**self.parameters, name: Parameter(name, change.after, change.unit or None)}
        if at_panel.get(name) == change.after:
            del parameters[name]
        return replace(self, parameters=parameters, at_panel=at_panel)

    def published(self, feedback: Feedback, *, is_manual: bool) -> HandSettings:
        return replace(self, now=feedback, before=self.before if is_manual and self.before else feedback)

    @property
    def left(self) -> dict[str, Parameter]:
        """The values that differ from those of before MANUAL, by name; of the feedback in SI."""
        before = {one.name: one for one in feedback_values(self.before)}
        changed = {one.name: one for one in feedback_values(self.now) if before.get(one.name, one) != one}
        return {**changed, **self.parameters}

    def handed_back(self) -> tuple[HandSettings, tuple[str, ...]]:
        """Return emptied settings, and the text of each setting that stays in force after MANUAL."""
        told = [f"{name} = {_value(one.value or '', one.unit or '')}" for name, one in self.parameters.items()]
        for name, (word, parameter) in _FEEDBACK_WORDS.items():
            value = getattr(self.now, name, None)
            is_changed = value is not None and value != getattr(self.before, name, None)
            if is_changed and parameter not in self.parameters:
                told.append(f"{word} = {value:g}" if name != "on" else f"{word} {'on' if value else 'off'}")
        return HandSettings(before=self.now, now=self.now), tuple(told)


def feedback_values(feedback: Feedback | None) -> tuple[Parameter, ...]:
    """Return gains and setpoint, as far as they are given, as parameters in SI."""
    given = {} if feedback is None else {one: getattr(feedback, word) for word, (_, one) in _FEEDBACK_WORDS.items()}
    given.pop(names.FEEDBACK_ON, None)
    return tuple(Parameter(name, repr(value)) for name, value in given.items() if value is not None)


def request_text(request: Request, problems: ProblemNames) -> str:
    """Return a request as text for people, with units."""
    words = _WORDS.get(request.kind)
    return request_name(request.kind) if words is None else words(request.subject, problems)


def _control(problem: Any, problems: ProblemNames) -> str:
    return f"asks for control to solve {problems.name(int(problem))}" if problem else "asks for control"


def _parameter(subject: object, problems: ProblemNames) -> str:
    if not isinstance(subject, Parameter):
        return f"parameter {subject}"
    if subject.value is None:
        return f"reads {subject.name}"
    return f"{subject.name} = {_value(subject.value, subject.unit or '')}"


def _settings(subject: object, problems: ProblemNames) -> str:
    given = subject.parameters if isinstance(subject, Settings) else ()
    texts = (one.name if one.value is None else f"{one.name} = {_value(one.value, one.unit or '')}" for one in given)
    return f"settings of a measurement: {', '.join(texts) or 'none'}"


def _returned(subject: object, problems: ProblemNames) -> str:
    given = subject.parameters if isinstance(subject, Settings) else ()
    return f"sets back {', '.join(one.name for one in given) or 'all that it has lent'}"


def _value(text: str, unit: str) -> str:
    # a prefix is chosen where the unit is SI; any other unit stays as it was sent
    try:
        return quantity(float(text), unit, 6) if unit in PREFIXABLE else f"{text} {unit_text(unit)}".strip()
    except ValueError:
        return f"{text} {unit_text(unit)}".strip()


def _scan_parameters(subject: object, problems: ProblemNames) -> str:
    if not isinstance(subject, ScanParameters):
        return "scan parameters"
    region, shape = subject.region, subject.shape
    parts = []
    if isinstance(region, Region):
        parts.append(f"{area_text(region.size_m)} at {position_text(region.center_m)}")
        if region.angle_rad:
            parts.append(f"turned by {math.degrees(region.angle_rad):.5g} deg")
    elif isinstance(region, RegionChange):
        given = {"left": region.left_m, "low": region.low_m, "width": region.width_m, "height": region.height_m}
        parts += [f"{name} {lengths_text([value_m])}" for name, value_m in given.items() if value_m is not None]
        if region.angle_rad is not None:
            parts.append(f"angle {math.degrees(region.angle_rad):.5g} deg")
    if isinstance(shape, ShapeChange):
        parts += [f"{name} {n}" for name, n in (("rows", shape.rows), ("columns", shape.columns)) if n is not None]
    elif shape is not None:
        parts.append(f"{shape[1]} x {shape[0]}")
    return f"scan parameters: {', '.join(parts)}" if parts else "scan parameters"


def _feedback(subject: object, problems: ProblemNames) -> str:
    if not isinstance(subject, Feedback):
        return "feedback"
    gains = {"P": subject.proportional_gain, "I": subject.integral_gain, "setpoint": subject.setpoint}
    parts = [] if subject.on is None else ["on" if subject.on else "off"]
    parts += [f"{name} = {value:g}" for name, value in gains.items() if value is not None]
    return f"feedback: {', '.join(parts)}" if parts else "feedback"


def _position(subject: object, problems: ProblemNames) -> str:
    if isinstance(subject, ProbePosition):
        return f"probe position: {position_text(subject.xy_m)}"
    if isinstance(subject, PositionChange):
        given = {"x": subject.x_m, "y": subject.y_m}
        parts = [f"{name} = {lengths_text([value_m])}" for name, value_m in given.items() if value_m is not None]
        return f"probe position: {', '.join(parts)}"
    return "probe position"


def _mode(subject: object, problems: ProblemNames) -> str:
    name = next((mode.name for mode in ControlMode if mode == subject), subject)
    return f"sets the mode {name}"


def _grant(grant: Grant) -> str:
    if grant.revokes:
        return f"revokes all approvals of {grant.agent}"
    if grant.plan:
        return f"approves the plan {grant.plan} of {grant.agent}"
    counts = ", ".join(f"{one.count} × {one.action}" for one in grant.counts)
    return f"grants {grant.agent} {counts or 'no action'} for {duration_text(grant.lasts_s)}"


_WORDS: dict[int, Callable[[Any, ProblemNames], str]] = {
    int(ControlRequest.ACTION): lambda subject, problems: str(subject),
    int(ControlRequest.PARAM): _parameter,
    int(ControlRequest.SET_SCAN_PARAMS): _scan_parameters,
    int(ControlRequest.SET_ZCTRL_PARAMS): _feedback,
    int(ControlRequest.SET_PROBE_POS): _position,
    int(ControlRequest.REQUEST_CTRL): _control,
    int(ControlRequest.RELEASE_CTRL): lambda subject, problems: "gives control back",
    int(ControlRequest.ADD_EXP_PRBLM): lambda subject, problems: f"flags {problems.name(int(subject or 0))}",
    int(ControlRequest.RMV_EXP_PRBLM): lambda subject, problems: f"clears {problems.name(int(subject or 0))}",
    int(ControlRequest.SET_CONTROL_MODE): _mode,
    int(ControlRequest.END_EXPERIMENT): lambda subject, problems: "ends the experiment",
    int(ControlRequest.ACTION_SUPPORT): lambda subject, problems: f"asks whether there is {subject}",
    GRANT_REQUEST: lambda subject, problems: _grant(subject),
    LEASE_REQUEST: lambda subject, problems: f"keeps control for {subject:g} s",
    RESTART_REQUEST: lambda subject, problems: f"restart {subject}",
    LEND_REQUEST: _settings,
    RETURN_REQUEST: _returned,
    KEEP_REQUEST: lambda subject, problems: "keeps what was set in MANUAL",
    AS_PLANNED_REQUEST: lambda subject, problems: "lets the plans measure with the values of their file",
}
