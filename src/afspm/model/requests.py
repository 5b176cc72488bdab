"""Requests and responses between components, scheduler and translator."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from afspm.basics.formatting import PREFIXABLE, quantity
from afspm.basics.units import convert, si_unit_or_none

HAS_ENDED = "the experiment has ended"
"""The reason of every refusal after the end."""


class ControlRequest(IntEnum):
    """The requests to scheduler and translator."""

    UNDEFINED = 0
    ACTION = 1
    PARAM = 2
    SET_SCAN_PARAMS = 3
    SET_ZCTRL_PARAMS = 4
    SET_PROBE_POS = 5
    REQUEST_CTRL = 6
    RELEASE_CTRL = 7
    ADD_EXP_PRBLM = 8
    RMV_EXP_PRBLM = 9
    SET_CONTROL_MODE = 10
    END_EXPERIMENT = 11
    ACTION_SUPPORT = 12


# numbers from 100 on are extensions of afspm, unknown to the published implementation
CLOCK_REQUEST = 101
"""Request for the experiment time and other facts of the run, such as its clock and versions; an extension of afspm."""
RELAY_REQUEST = 102
"""Request to publish a message of the sender; an extension of afspm.

The answer to a supervisor or an instrument holds its orders.
"""
RESTART_REQUEST = 103
"""Request to restart the process named by its subject; an extension of afspm."""
LEASE_REQUEST = 104
"""Request of the holder to lose control after an idle time, also while a scan is running; an extension of afspm.

The subject is the time in real seconds without another command or lease request.
"""
LONGEST_LEASE_S = 86_400.0  # a day
LEASE_AT_ONCE_S = 1e-3
"""A lease that ends at once. Unlike a release it is no decision: the scheduler retracts a tip in danger."""
GRANT_REQUEST = 105
"""Request of a person to approve an agent's plan, to give a grant, or to revoke its approvals; an extension of afspm.

The subject is a Grant.
"""

LEND_REQUEST = 106
"""Request of the holder to set what its next measurement states; an extension of afspm.

The subject is `Settings`; the answer holds them with the values in force. The scheduler sets the former values back for
the measurements that do not state them.
"""
RETURN_REQUEST = 107
"""Request of a lender, which needs no control, to set back what it has lent; an extension of afspm.

The subject is `Settings` without values; without settings, all that the client has lent.
"""
COMPARE_REQUEST = 108
"""Request of the scheduler to a translator: which of the known values are in force; an extension of afspm."""
KEEP_REQUEST = 109
"""Request of a person: the plans measure with the values that were set in MANUAL; an extension of afspm.

The subject is `Settings` without values; without settings, all values that a plan would set again.
"""
AS_PLANNED_REQUEST = 110
"""Request of a person: the plans measure with the values of their file again; an extension of afspm.

The subject is the same as for `KEEP_REQUEST`.
"""

OTHER_RUN_RESPONSE = 100
"""Response to a component of another run than the scheduler's run; an extension of afspm."""

_OURS = {
    CLOCK_REQUEST: "CLOCK",
    RELAY_REQUEST: "RELAY",
    RESTART_REQUEST: "RESTART",
    LEASE_REQUEST: "LEASE",
    GRANT_REQUEST: "GRANT",
    LEND_REQUEST: "LEND",
    RETURN_REQUEST: "RETURN",
    COMPARE_REQUEST: "COMPARE",
    KEEP_REQUEST: "KEEP",
    AS_PLANNED_REQUEST: "AS_PLANNED",
}


def request_name(kind: int) -> str:
    """Return the name of a request for people."""
    known = next((request.name for request in ControlRequest if request == kind), None)
    return known or _OURS.get(kind, f"request {kind}")


class ControlResponse(IntEnum):
    """The answers to a request."""

    SUCCESS = 0
    FAILURE = 1
    CMD_NOT_SUPPORTED = 2
    NO_RESPONSE = 3
    ALREADY_UNDER_CONTROL = 4
    WRONG_CONTROL_MODE = 5
    NOT_IN_CONTROL = 6
    NOT_FREE = 7
    PARAM_NOT_SUPPORTED = 8
    PARAM_ERROR = 9
    WRONG_EXP_PROBLEM = 10
    ACTION_NOT_SUPPORTED = 11
    ACTION_ERROR = 12


WAIT_FOR_CONTROL = frozenset(
    {ControlResponse.ALREADY_UNDER_CONTROL, ControlResponse.WRONG_CONTROL_MODE, ControlResponse.WRONG_EXP_PROBLEM}
)
"""Answers to a request for control that are no refusals: the component waits for control."""


class RescanKind(IntEnum):
    """The kinds of a request to the component Rescanner, in a message that only afspm has."""

    AGAIN = 1
    """Scan the same region again."""
    OPPOSITE = 2
    """Scan the region in the other direction of the slow axis."""
    SEARCH = 3
    """Scan a wider region, until the sample is found."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter by name: without a value in a request to read the parameter, else with a value.

    Attributes:
        value: as text, in `unit`; None to read it.
        unit: unit of `value`; None for the wire's own unit: SI, but degrees for angles.
    """

    name: str
    value: str | None = None
    unit: str | None = None


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting of a measurement, in a request to lend, return or compare it, or in the answer.

    Attributes:
        parameter: to lend: with its value; to return or compare: without; in an answer: the value in force.
        known: to compare: values that may be in force; in the answer the ones in force, within the controller's
            precision.
        is_claimed: whether the next measurement stands for the first of `known`, if that is in force.
        is_lent: in an answer, whether the parameter may be lent; None: unknown to the translator.
        is_swept: to lend: whether it is a point of a sweep, which no other value takes the place of.
    """

    parameter: Parameter
    known: tuple[Parameter, ...] = ()
    is_claimed: bool = False
    is_lent: bool | None = None
    is_swept: bool = False


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a measurement.

    Attributes:
        settle_s: experiment time to wait after a change of bias, setpoint or gains; None: as in [control].
    """

    settings: tuple[Setting, ...] = ()
    settle_s: float | None = None

    @classmethod
    def of(cls, *parameters: Parameter, settle_s: float | None = None) -> Settings:
        return cls(tuple(map(Setting, parameters)), settle_s)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(one.parameter for one in self.settings)


@dataclass(frozen=True, slots=True)
class LoanInForce:
    """A setting that is in force for one component's measurements.

    Attributes:
        base: the value in force before, which is set back.
        is_unsure: whether others may have changed the value since.
        why: why it can't be set back; empty: nothing is known against it.
    """

    value: Parameter
    base: Parameter
    lender: str
    is_unsure: bool = False
    why: str = ""

    @property
    def text(self) -> str:
        """The loan as text for people: "tip-bias-voltage 500 mV, lent by a (100 mV before)"."""
        return f"{self.value.name} {amount_text(self.value)}, lent by {self.lender} ({amount_text(self.base)} before)"


@dataclass(frozen=True, slots=True)
class Overruling:
    """A value that takes the place of one that a plan states.

    Attributes:
        planned: as the plan states it.
        value: with which the plan measures instead.
        by: who decided it.
        is_asked: whether a person has left it in MANUAL: the plan sets its own again unless it is kept.
    """

    lender: str
    planned: Parameter
    value: Parameter
    by: str
    is_asked: bool = False

    @property
    def text(self) -> str:
        """It as text for people: "a measures at tip-bias-voltage 700 mV, set at the microscope; it states 500 mV"."""
        value, planned = amount_text(self.value), amount_text(self.planned)
        if self.is_asked:
            return f"{self.lender} sets {self.planned.name} {planned} again (you left {value})"
        return f"{self.lender} measures at {self.value.name} {value}, set {self.by}; it states {planned}"


@dataclass(frozen=True, slots=True)
class LoansInForce:
    """All that the scheduler has lent, without which all settings are those of before; and what overrules plans."""

    loans: tuple[LoanInForce, ...] = ()
    overruled: tuple[Overruling, ...] = ()


def amount_text(parameter: Parameter) -> str:
    """Return a value with its unit as text for people."""
    unit = parameter.unit or ""
    si = si_unit_or_none(unit) or ""
    try:
        number = float(parameter.value or "")
    except ValueError:
        return parameter.value or "no value"
    return quantity(float(convert(number, unit, si)), si) if si in PREFIXABLE else quantity(number, unit)


@dataclass(slots=True)
class Request:
    """A request to scheduler or translator.

    Attributes:
        kind: the number of a ControlRequest.
        subject: a model object, such as a ScanParameters, Parameter or Grant; the name of an action or process; the
            number of a problem or control mode; or the seconds of a lease. None for requests without a subject.
        payload: the subject in bytes, as received.
        id: equal for all repetitions of one request; empty if the request may not be repeated.
        alias: the parameter's name in the client's request, if the scheduler replaced it; not on the wire.
    """

    kind: int
    subject: Any = None
    payload: bytes = b""
    id: str = ""
    alias: str = ""


class ResponseDetail(IntEnum):
    """A detail for programs beside the code of a response; numbers as on the wire.

    Programs never parse the reason, whose text may change. A detail is no further ControlResponse: an old client would
    not know whether that is a success. Receivers ignore unknown frames and take an unknown detail for NONE.
    """

    NONE = 0
    NOT_SENT = 1
    """A NO_RESPONSE to a request that was certainly not carried out, and may be repeated."""
    OUTCOME_UNKNOWN = 2
    """A NO_RESPONSE to a request that may have been carried out."""
    EXPERIMENT_ENDED = 3
    STEP_AWAY_AGAIN = 4
    """The steps away from the sample count no more, since others may have used the coarse motor; new ones do."""
    STATE_AGAIN = 5
    """Something that the client has stated for its measurement is not in force any more: state it again."""


@dataclass(slots=True)
class Response:
    """The answer to a request.

    Attributes:
        code: the number of a ControlResponse.
        payload: an object in bytes, such as a parameter; mostly empty.
        reason: the reason of a failure, for people.
        id: id of the answered request, if it had one.
        detail: further facts for programs.
        again_ns: the experiment time at which a refusal by a limit on time may be gone; None for other answers. The
            request may then be sent again, under another id.
    """

    code: int
    payload: bytes = b""
    reason: str = ""
    id: str = ""
    detail: ResponseDetail = ResponseDetail.NONE
    again_ns: int | None = None

    @property
    def ok(self) -> bool:
        return self.code == ControlResponse.SUCCESS
