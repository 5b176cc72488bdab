"""Conversion of model objects to and from messages field by field, by one table for each class."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import fields
from enum import IntEnum
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from afspm import model
from afspm.basics import shortest_single
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import InvalidValue
from afspm.model.events import LogLines, MeasurementSettings
from afspm.model.instruments import InstrumentOrders
from afspm.model.panel import ChangedValue
from afspm.model.requests import LoanInForce, LoansInForce, Overruling, Setting, Settings
from afspm.model.state import FeedbackUnits
from afspm.model.variables import VariableRoles
from afspm.wire.generated import (
    channels_pb2,
    control_pb2,
    feedback_pb2,
    grants_pb2,
    instruments_pb2,
    journal_pb2,
    loans_pb2,
    panel_pb2,
)
from afspm.wire.messages import parse
from afspm.wire.split import Buffer

T = TypeVar("T")
E = TypeVar("E", bound=IntEnum)

# the record and numpy keep times as ns in a signed 64-bit integer
_TIMES = 2**63


def timestamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // NS_PER_S, nanos=time_ns % NS_PER_S)


def time_ns(stamp: Timestamp) -> int:
    """Return a timestamp in ns since the Unix epoch.

    Raises:
        InvalidValue: the time does not fit 64 bits (the years 1678 to 2261), as in the record.
    """
    found = int(stamp.seconds) * NS_PER_S + stamp.nanos
    if not -_TIMES <= found < _TIMES:
        raise InvalidValue(f"a time of {stamp.seconds} s since 1970, outside of the years 1678 to 2261")
    return found


def known(kind: type[E], number: int) -> E:
    """Return the enum member with this number; UNDEFINED (0) for an unknown number from a newer peer."""
    return kind(number) if number in kind._value2member_map_ else kind(0)


class FieldMapping(NamedTuple):
    """A field of a message, and the conversion of its value in both directions.

    Attributes:
        sparse: whether an empty or zero value is omitted.
    """

    name: str
    to_wire: Callable[[Any], object] | None = None
    from_wire: Callable[[Any], object] | None = None
    sparse: bool = False


class MessageMapping(Generic[T]):
    """The mapping between a model class and its message.

    None is sent as an absent field. An absent field is read as None if None is the attribute's default.

    Args:
        same: attributes with a field of the same name and type.
        other: all other attributes, each with the name of its field, or a `FieldMapping`.
    """

    def __init__(self, kind: type[T], message: type[Message], /, *same: str, **other: str | FieldMapping) -> None:
        self.kind = kind
        self.name = message.DESCRIPTOR.name
        self._message = message
        self._fields = {
            attribute: FieldMapping(field) if isinstance(field, str) else field
            for attribute, field in {**{name: name for name in same}, **other}.items()
        }
        defaults = {field.name: field.default for field in fields(kind)}  # type: ignore[arg-type]
        self._optional = {attribute for attribute in self._fields if defaults[attribute] is None}

    def to_wire(self, thing: T) -> Message:
        values = {}
        for attribute, field in self._fields.items():
            value = getattr(thing, attribute)
            if value is not None and (value or not field.sparse):
                values[field.name] = field.to_wire(value) if field.to_wire else value
        return self._message(**values)

    def from_wire(self, message: Message) -> T:
        """Return the model object of a message.

        Raises:
            InvalidValue: a value is invalid.
        """
        return self.kind(
            **{
                attribute: None
                # an absent field reads as 0, which a request would then set
                if attribute in self._optional and not message.HasField(field.name)
                else _converted(field, getattr(message, field.name))
                for attribute, field in self._fields.items()
            }
        )

    def decode(self, payload: Buffer) -> T:
        """Return the model object of a serialised message.

        Raises:
            WireError: the bytes are no such message.
            InvalidValue: a value is invalid.
        """
        return self.from_wire(parse(self._message, payload))


def _converted(field: FieldMapping, value: object) -> Any:
    return field.from_wire(value) if field.from_wire else value


def _time(name: str = "timestamp") -> FieldMapping:
    return FieldMapping(name, timestamp, time_ns)


def _enum(name: str, kind: type[E], *, sparse: bool = False) -> FieldMapping:
    return FieldMapping(name, int, partial(known, kind), sparse)


def _each(name: str, mapping: MessageMapping[Any]) -> FieldMapping:
    return FieldMapping(
        name,
        lambda things: [mapping.to_wire(thing) for thing in things],
        # a list first: of an iterator of unknown length, Python 3.11.7 once failed to resize the tuple (SystemError)
        lambda messages: (*map(mapping.from_wire, messages),),
    )


def _gain(name: str) -> FieldMapping:
    # a float32 in the message: its nearest float64 would differ from the value that was set
    def finite(value: float) -> float:
        if not math.isfinite(value):
            raise InvalidValue(f"{name} is {value}")
        return shortest_single(value)

    return FieldMapping(name, from_wire=finite)


def _wait(settle_s: float) -> float:
    if not 0.0 <= settle_s < math.inf:
        raise InvalidValue(f"a wait of {settle_s} s", hint="zero or more")
    return settle_s


def _needed(what: str) -> Callable[[str], str]:
    def checked(name: str) -> str:
        if not name:
            raise InvalidValue(f"{what} without a name")
        return name

    return checked


def _panel_act(name: str) -> model.PanelAct:
    try:
        return model.PanelAct(name)
    except ValueError:
        raise InvalidValue(f"{name!r} is no act at the microscope") from None


FEEDBACK = MessageMapping(
    model.Feedback,
    feedback_pb2.ZCtrlParameters,
    on="feedbackOn",
    proportional_gain=_gain("proportionalGain"),
    integral_gain=_gain("integralGain"),
    setpoint=_gain("setPoint"),
)
SCOPE_STATUS = MessageMapping(
    model.ScopeStatus, control_pb2.ScopeStateMsg, state=_enum("scope_state", model.ScopeState), paused="scan_paused"
)
CONTROL_STATE = MessageMapping(
    model.ControlState,
    control_pb2.ControlState,
    mode=_enum("control_mode", model.ControlMode),
    # the wire has an empty name for no holder
    holder=FieldMapping("client_in_control_id", from_wire=lambda holder: holder or None),
    problems=FieldMapping("problems_set", from_wire=lambda problems: tuple(sorted({int(one) for one in problems}))),
)
PARAMETER = MessageMapping(
    model.Parameter,
    control_pb2.ParameterMsg,
    name=FieldMapping("parameter", from_wire=_needed("a parameter")),
    value="value",
    unit="units",
)
_JOURNAL_ENTRY = MessageMapping(
    model.JournalEntry,
    journal_pb2.JournalEntry,
    *("kind", "who", "what", "response", "request", "problem"),
    time_ns=_time(),
    reason=FieldMapping("reason", sparse=True),
    took_s="took",
    event=_enum("event", model.ControlEvent, sparse=True),
    mode=_enum("mode", model.ControlMode, sparse=True),
    late=FieldMapping("late", sparse=True),
    sent_ns=_time("sent"),
    again_ns=_time("again"),
    key=FieldMapping("key", sparse=True),
    subject=FieldMapping("subject", sparse=True),
    value=FieldMapping("value", sparse=True),
    unit=FieldMapping("unit", sparse=True),
)
_PROCESS_STATE = MessageMapping(
    model.ProcessState,
    journal_pb2.ProcessState,
    *("name", "role", "starts", "pid", "last_exit"),
    condition=_enum("condition", model.ProcessCondition),
    since_ns=_time("since"),
    step_age_s="step_age",
)
_LOG_LINE = MessageMapping(model.LogLine, journal_pb2.LogLine, "name", "level", "text", time_ns=_time())
_NOTE = MessageMapping(
    model.Note,
    journal_pb2.Note,
    *("who", "text"),
    time_ns=_time(),
    scan_ns=_time("scan"),
    written_ns=_time("written"),
)
_SWEPT = MessageMapping(
    MeasurementSettings,
    journal_pb2.MeasurementSettings,
    *("who", "point"),
    time_ns=_time(),
    parameters=_each("parameters", PARAMETER),
    key=FieldMapping("key", sparse=True),
)
_READING = MessageMapping(
    model.InstrumentReading,
    instruments_pb2.InstrumentReading,
    *("value", "target", "busy"),
    name=FieldMapping("parameter", from_wire=_needed("a reading")),
    unit=FieldMapping("units", sparse=True),
    age_s="age",
    reason=FieldMapping("reason", sparse=True),
)
_OUTCOME = MessageMapping(
    model.OrderOutcome, instruments_pb2.OrderOutcome, "number", "response", reason=FieldMapping("reason", sparse=True)
)
_ORDER = MessageMapping(
    model.InstrumentOrder,
    instruments_pb2.InstrumentOrder,
    *("number", "id"),
    parameter=FieldMapping("parameter", PARAMETER.to_wire, PARAMETER.from_wire),
    rate_per_s="rate",
    rate_unit=FieldMapping("rate_units", sparse=True),
)
# Told is the name on the wire, which must stay compatible  # word: told
RELAYED = MessageMapping(
    model.RelayedMessage, journal_pb2.Told, "payload", message=FieldMapping("message", from_wire=_needed("a message"))
)
INSTRUMENT_ORDERS = MessageMapping(InstrumentOrders, journal_pb2.Orders, "token", orders=_each("instrument", _ORDER))
_SETTING = MessageMapping(
    Setting,
    loans_pb2.LentSetting,
    parameter=FieldMapping("parameter", PARAMETER.to_wire, PARAMETER.from_wire),
    known=_each("known", PARAMETER),
    is_claimed=FieldMapping("claimed", sparse=True),
    is_lent="lent",
    is_swept=FieldMapping("swept", sparse=True),
)
SETTINGS = MessageMapping(
    Settings,
    loans_pb2.LentSettings,
    settings=_each("settings", _SETTING),
    settle_s=FieldMapping("settle", from_wire=_wait),
)
_LOAN = MessageMapping(
    LoanInForce,
    loans_pb2.Loan,
    value=FieldMapping("value", PARAMETER.to_wire, PARAMETER.from_wire),
    base=FieldMapping("base", PARAMETER.to_wire, PARAMETER.from_wire),
    lender="lender",
    is_unsure=FieldMapping("unsure", sparse=True),
    why=FieldMapping("reason", sparse=True),
)
_OVERRULING = MessageMapping(
    Overruling,
    loans_pb2.Overruling,
    *("lender", "by"),
    planned=FieldMapping("planned", PARAMETER.to_wire, PARAMETER.from_wire),
    value=FieldMapping("value", PARAMETER.to_wire, PARAMETER.from_wire),
    is_asked=FieldMapping("asked", sparse=True),
)
_COUNT = MessageMapping(model.GrantedCount, grants_pb2.GrantedCount, "action", "count")
_RANGE = MessageMapping(model.GrantedRange, grants_pb2.GrantedRange, "parameter", "low", "high")
GRANT = MessageMapping(
    model.Grant,
    grants_pb2.Grant,
    *("plan", "run", "limits"),
    agent=FieldMapping("agent", from_wire=_needed("an agent")),
    steps=_each("steps", MessageMapping(model.GrantedStep, grants_pb2.GrantedStep, "request", "payload")),
    region_m=FieldMapping("region", from_wire=tuple),
    ranges=_each("ranges", _RANGE),
    counts=_each("counts", _COUNT),
    lasts_s="lasts",
    since_ns=_time("since"),
    offset_m=FieldMapping("offset", from_wire=tuple),
    drift_m="drift",
)
_APPROVAL = MessageMapping(
    model.Approval,
    grants_pb2.Approval,
    *("agent", "plan", "by", "steps_left"),
    until_ns=_time("until"),
    left=_each("left", _COUNT),
    region_m=FieldMapping("region", from_wire=tuple),
    ranges=_each("ranges", _RANGE),
    counts=_each("counts", _COUNT),
)
TIP_STATUS = MessageMapping(
    model.TipStatus,
    panel_pb2.TipStatus,
    *("engaged", "feedback_on"),
    by_hand=FieldMapping("by_hand", sparse=True),
)
_CHANGED_VALUE = MessageMapping(
    ChangedValue,
    panel_pb2.ChangedValue,
    *("parameter", "before", "after"),
    unit=FieldMapping("units", sparse=True),
)
ACT_BY_HAND = MessageMapping(
    model.ActByHand,
    panel_pb2.ActByHand,
    time_ns=_time(),
    act=FieldMapping("act", str, _panel_act),
    evidence=FieldMapping("evidence", sparse=True),
    changes=_each("changes", _CHANGED_VALUE),
)
_TIP = FieldMapping("", TIP_STATUS.to_wire, TIP_STATUS.from_wire)
_ROLES = FieldMapping(
    "roles",
    lambda of_roles: [channels_pb2.ChannelRole(role=role, names=names) for role, names in of_roles.items()],
    lambda roles: {_needed("a channel's role")(one.role): tuple(one.names) for one in roles},
)
VARIABLE_ROLES = MessageMapping(
    VariableRoles,
    channels_pb2.VariableRoles,
    names=_ROLES,
    towards=FieldMapping("towards", from_wire=tuple),
)
CHANNEL_ROLES = MessageMapping(
    model.ChannelRoles,
    channels_pb2.ChannelRoles,
    names=_ROLES,
    others=FieldMapping("others", from_wire=tuple),
    variables=FieldMapping("variables", VARIABLE_ROLES.to_wire, VARIABLE_ROLES.from_wire),
)
FEEDBACK_UNITS = MessageMapping(
    FeedbackUnits,
    feedback_pb2.ZCtrlUnits,
    proportional_gain=FieldMapping("proportional_gain", sparse=True),
    integral_gain=FieldMapping("integral_gain", sparse=True),
    setpoint=FieldMapping("setpoint", sparse=True),
)
MAPPINGS: tuple[MessageMapping[Any], ...] = (
    FEEDBACK_UNITS,
    CHANNEL_ROLES,
    TIP_STATUS,
    ACT_BY_HAND,
    MessageMapping(
        model.MeasurementConditions,
        panel_pb2.MeasurementConditions,
        time_ns=_time(),
        filename="filename",
        begin=_TIP._replace(name="begin"),
        end=_TIP._replace(name="end"),
        acts=_each("acts", ACT_BY_HAND),
        began_ns=_time("began"),
        holder=FieldMapping("holder", sparse=True),
        begin_values=_each("begin_values", PARAMETER),
        end_values=_each("end_values", PARAMETER),
        unproved=FieldMapping("unproved", from_wire=tuple),
        begin_in_force=_each("begin_in_force", PARAMETER),
        end_in_force=_each("end_in_force", PARAMETER),
    ),
    GRANT,
    MessageMapping(model.Approvals, grants_pb2.Approvals, approvals=_each("approvals", _APPROVAL)),
    MessageMapping(model.Proposal, grants_pb2.Proposal, "who", "id", "plan", "preflight", time_ns=_time()),
    FEEDBACK,
    SCOPE_STATUS,
    CONTROL_STATE,
    PARAMETER,
    RELAYED,
    MessageMapping(model.JournalEntries, journal_pb2.JournalEntries, entries=_each("entries", _JOURNAL_ENTRY)),
    MessageMapping(
        model.ProcessStates,
        journal_pb2.ProcessStates,
        "supervisor",
        time_ns=_time(),
        processes=_each("processes", _PROCESS_STATE),
    ),
    MessageMapping(LogLines, journal_pb2.LogLines, lines=_each("lines", _LOG_LINE)),
    MessageMapping(model.Progress, journal_pb2.Progress, "name", "done", "of", time_ns=_time(), left_s="remaining"),
    _NOTE,
    _SWEPT,
    SETTINGS,
    MessageMapping(
        LoansInForce, loans_pb2.Loans, loans=_each("loans", _LOAN), overruled=_each("overruled", _OVERRULING)
    ),
    MessageMapping(
        model.InstrumentReadings,
        instruments_pb2.InstrumentReadings,
        *("instrument", "token"),
        patience_s=FieldMapping("patience", sparse=True),
        time_ns=_time(),
        readings=_each("readings", _READING),
        outcomes=_each("outcomes", _OUTCOME),
    ),
    INSTRUMENT_ORDERS,
)


def encode_orders(restart: Iterable[str]) -> bytes:
    """Return the answer to a supervisor's RELAY_REQUEST in bytes: the names of the processes to restart."""
    return journal_pb2.Orders(restart=restart).SerializeToString()


def decode_instrument_orders(payload: Buffer) -> InstrumentOrders:
    """Return the orders in the answer to an instrument's report.

    Raises:
        WireError: the bytes are no orders.
        InvalidValue: a value is invalid.
    """
    return INSTRUMENT_ORDERS.decode(payload)


def decode_orders(payload: Buffer) -> tuple[str, ...]:
    """Return the names of the processes to restart, from the answer to a supervisor's report.

    Raises:
        WireError: the bytes are no orders.
    """
    return tuple(parse(journal_pb2.Orders, payload).restart)
