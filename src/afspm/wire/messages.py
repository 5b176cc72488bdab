"""The registry of messages: one declaration for each message, used by all other packages.

Nothing outside of `wire` imports the generated modules; this module provides their classes.

| a declaration states | and thereby |
| --- | --- |
| type | the class that reads the bytes; the name, with which its envelopes begin |
| kind, source, always | which messages clients follow, a terminal subscribes to, and `afspm check` expects |
| history | the number of packets of an envelope that the scheduler keeps for late joiners |
| handler | the method of a component, and of an overview of the record, for this message |
| attribute | the attribute of a client that holds the newest message |
| event | the kind of event under which the gateway streams it |

Always holds: a name is declared once; no set, table or tuple of message names stands in another package. Thirteen such
lists had to be kept in step by hand before, and a message that one of them lacked raised no error. The messages that
a component names in its own `listens` are its choice, and no such list.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final, TypeVar

from google.protobuf.message import DecodeError, Message

from afspm.basics.errors import InvalidValue, WireError
from afspm.model import ControlRequest, Role
from afspm.wire.generated import (
    analysis_pb2,
    channels_pb2,
    control_pb2,
    drift_pb2,
    feedback_pb2,
    geometry_pb2,
    grants_pb2,
    instruments_pb2,
    journal_pb2,
    lines_pb2,
    loans_pb2,
    panel_pb2,
    scan_pb2,
    spectroscopy_pb2,
)
from afspm.wire.generated.analysis_pb2 import SpatialPointWithScoreList, SpatialROIWithScoreList
from afspm.wire.generated.control_pb2 import ParameterMsg
from afspm.wire.generated.drift_pb2 import DriftMapping, DriftRescan
from afspm.wire.generated.feedback_pb2 import ZCtrlParameters
from afspm.wire.generated.lines_pb2 import TipVerdict, WatchCounts
from afspm.wire.generated.scan_pb2 import ScanParameters2d
from afspm.wire.generated.spectroscopy_pb2 import ProbePosition

__all__ = [
    "DriftMapping",
    "DriftRescan",
    "ParameterMsg",
    "ProbePosition",
    "ScanParameters2d",
    "SpatialPointWithScoreList",
    "SpatialROIWithScoreList",
    "TipVerdict",
    "WatchCounts",
    "ZCtrlParameters",
]

M = TypeVar("M", bound=Message)


class MessageKind(Enum):
    """The kinds of messages, each with its own treatment by receivers."""

    MEASUREMENT = "a finished measurement, with its values"
    LINES = "rows of a running scan, for the moment: not kept"
    STATE = "states and settings in force: the newest replaces earlier ones"
    EVENT = "events of processes and requests, and people's notes"
    RESULT = "findings of a component or a drift scheduler"
    PART = "a part of other messages or of requests, or a message of a user"


@dataclass(frozen=True, kw_only=True)
class MessageDeclaration:
    """The properties of one message type.

    Attributes:
        type: the generated class.
        kind: see `MessageKind`.
        source: role of the process that publishes the message; None: only published on behalf of another process.
        always: whether `afspm check` assumes that every process of this role publishes the message.
        named: whether an envelope continues after the message's name with size and channel, kind or owner.
        history: number of packets for each envelope that the scheduler keeps for late joiners.
        handler: method of a `Component` and of an `Overview` for this message.
        attribute: attribute of a client's view for the newest message; empty: not kept.
        set_by: the request that sets the content of the message.
        event: kind of the event in the gateway; empty: not streamed. A text: an Enum can't grow with the registry.
        in_past: whether an overview of an earlier part of a run needs all packets instead of only the newest.
        relayed: whether the scheduler publishes the message for the component, as `<name>_<component>`: programs that
            follow the scheduler alone then get it, such as `afspm status`, `afspm.connect` and `Run.messages`.
        name: name of the message, with which its envelopes begin.
    """

    type: type[Message]
    kind: MessageKind = MessageKind.PART
    source: Role | None = None
    always: bool = True
    named: bool = False
    history: int = 1
    handler: str = ""
    attribute: str = ""
    set_by: ControlRequest | None = None
    event: str = ""
    in_past: bool = False
    relayed: bool = False
    name: str = field(init=False)

    def __post_init__(self) -> None:
        # cached: each packet is compared with some names, and reading the descriptor takes longer
        object.__setattr__(self, "name", self.type.DESCRIPTOR.name)
        if not self.handler:
            object.__setattr__(self, "handler", f"on_{snake_case(self.name)}")
        if self.relayed and self.has_values:
            raise InvalidValue(f"{self.name} has values of a measurement, and can't be relayed", hint="kind = RESULT")

    @property
    def has_values(self) -> bool:
        """Return whether the message carries an array of measured values."""
        return self.kind in (MessageKind.MEASUREMENT, MessageKind.LINES)


def snake_case(name: str) -> str:
    """Return "SpatialROIWithScoreList" as "spatial_roi_with_score_list"."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


SCAN: Final = MessageDeclaration(
    type=scan_pb2.Scan2d,
    kind=MessageKind.MEASUREMENT,
    source=Role.TRANSLATOR,
    named=True,
    history=5,
    handler="on_scan",
    event="scan",
    in_past=True,
)
SPECTRUM: Final = MessageDeclaration(
    type=spectroscopy_pb2.Spec1d,
    kind=MessageKind.MEASUREMENT,
    source=Role.TRANSLATOR,
    named=True,
    history=10,
    handler="on_spectrum",
    event="spectrum",
    in_past=True,
)
SCAN_LINES: Final = MessageDeclaration(
    type=lines_pb2.ScanLines, kind=MessageKind.LINES, source=Role.TRANSLATOR, always=False, history=0
)
SCOPE_STATE: Final = MessageDeclaration(
    type=control_pb2.ScopeStateMsg,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    history=10,
    handler="on_state",
    attribute="status",
    event="state",
    in_past=True,
)
CONTROL_STATE: Final = MessageDeclaration(
    type=control_pb2.ControlState,
    kind=MessageKind.STATE,
    source=Role.SCHEDULER,
    handler="on_control",
    attribute="control",
    event="control",
    in_past=True,
)
SCAN_PARAMETERS: Final = MessageDeclaration(
    type=ScanParameters2d,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    handler="on_scan_parameters",
    attribute="scan_parameters",
    set_by=ControlRequest.SET_SCAN_PARAMS,
    event="scan-parameters",
    in_past=True,
)
FEEDBACK: Final = MessageDeclaration(
    type=ZCtrlParameters,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    handler="on_feedback",
    attribute="feedback",
    set_by=ControlRequest.SET_ZCTRL_PARAMS,
    event="feedback",
    in_past=True,
)
FEEDBACK_UNITS: Final = MessageDeclaration(
    type=feedback_pb2.ZCtrlUnits,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    handler="on_feedback_units",
    attribute="feedback_units",
    in_past=True,
)
PROBE_POSITION: Final = MessageDeclaration(
    type=ProbePosition,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    handler="on_probe_position",
    attribute="probe_position",
    set_by=ControlRequest.SET_PROBE_POS,
    event="probe-position",
)
TIP_STATUS: Final = MessageDeclaration(
    type=panel_pb2.TipStatus,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    always=False,
    attribute="tip",
    event="tip",
    in_past=True,
)
CHANNEL_ROLES: Final = MessageDeclaration(
    type=channels_pb2.ChannelRoles,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    history=10,  # one from before each cached scan
    attribute="channels",
    in_past=True,
)
ACT_BY_HAND: Final = MessageDeclaration(
    type=panel_pb2.ActByHand,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    always=False,
    history=20,
    attribute="by_hand",
    event="by-hand",
    in_past=True,
)
CONDITIONS: Final = MessageDeclaration(
    type=panel_pb2.MeasurementConditions,
    kind=MessageKind.EVENT,
    source=Role.TRANSLATOR,
    always=False,
    history=20,
    event="measurement-conditions",
    in_past=True,
)
JOURNAL: Final = MessageDeclaration(
    type=journal_pb2.JournalEntries,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    history=1000,
    event="journal",
    in_past=True,
)
PROCESSES: Final = MessageDeclaration(
    type=journal_pb2.ProcessStates,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    named=True,
    event="processes",
    in_past=True,
)
LOG: Final = MessageDeclaration(
    type=journal_pb2.LogLines, kind=MessageKind.EVENT, source=Role.SCHEDULER, history=1000, event="log"
)
PROGRESS: Final = MessageDeclaration(
    type=journal_pb2.Progress, kind=MessageKind.EVENT, source=Role.SCHEDULER, named=True, event="progress"
)
NOTE: Final = MessageDeclaration(
    type=journal_pb2.Note,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    history=1000,
    event="note",
    in_past=True,
)
MEASUREMENT_SETTINGS: Final = MessageDeclaration(
    type=journal_pb2.MeasurementSettings, kind=MessageKind.EVENT, source=Role.SCHEDULER
)
INSTRUMENT_READINGS: Final = MessageDeclaration(
    type=instruments_pb2.InstrumentReadings,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    always=False,
    named=True,
    event="readings",
    in_past=True,
)
APPROVALS: Final = MessageDeclaration(
    type=grants_pb2.Approvals,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    event="approvals",
    in_past=True,
)
LOANS: Final = MessageDeclaration(
    type=loans_pb2.Loans,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    always=False,
    event="loans",
    in_past=True,
)
PROPOSAL: Final = MessageDeclaration(
    type=grants_pb2.Proposal,
    kind=MessageKind.EVENT,
    source=Role.SCHEDULER,
    history=100,
    event="proposal",
    in_past=True,
)
DRIFT_MAPPING: Final = MessageDeclaration(
    type=DriftMapping,
    kind=MessageKind.RESULT,
    source=Role.SCHEDULER,
    always=False,
    history=10,
    in_past=True,
)
DRIFT_RESCAN: Final = MessageDeclaration(
    type=DriftRescan, kind=MessageKind.RESULT, source=Role.SCHEDULER, always=False, in_past=True
)
REGIONS: Final = MessageDeclaration(
    type=SpatialROIWithScoreList,
    kind=MessageKind.RESULT,
    source=Role.COMPONENT,
    always=False,
)
POINTS: Final = MessageDeclaration(
    type=SpatialPointWithScoreList,
    kind=MessageKind.RESULT,
    source=Role.COMPONENT,
    always=False,
)
FEEDBACK_ANALYSIS: Final = MessageDeclaration(
    type=feedback_pb2.FeedbackAnalysis, kind=MessageKind.RESULT, source=Role.COMPONENT, always=False
)
TIP_VERDICT: Final = MessageDeclaration(
    type=TipVerdict, kind=MessageKind.RESULT, source=Role.COMPONENT, always=False, named=True
)
WATCH_COUNTS: Final = MessageDeclaration(
    type=WatchCounts, kind=MessageKind.RESULT, source=Role.COMPONENT, always=False, named=True
)
LENT_SETTINGS: Final = MessageDeclaration(type=loans_pb2.LentSettings)

_MODULES = (
    analysis_pb2, channels_pb2, control_pb2, drift_pb2, feedback_pb2, geometry_pb2, grants_pb2, instruments_pb2,
    journal_pb2, lines_pb2, loans_pb2, panel_pb2, scan_pb2, spectroscopy_pb2,
)  # fmt: skip
# collected by their class, so that no declaration above can be forgotten
_declared: dict[str, MessageDeclaration] = {
    one.name: one for one in list(globals().values()) if isinstance(one, MessageDeclaration)
}
# all other messages are parts of these
for _module in _MODULES:
    for _name in _module.DESCRIPTOR.message_types_by_name:
        _declared.setdefault(_name, MessageDeclaration(type=getattr(_module, _name)))
_OF_AFSPM = frozenset(_declared)


def declare(declaration: MessageDeclaration) -> MessageDeclaration:
    """Register a message of another package with its declaration, and return the declaration.

    Raises:
        InvalidValue: another type has this name, or the message is already declared differently.
    """
    name = declaration.name
    known = _declared.setdefault(name, declaration)
    # by full name: a .proto file that is compiled again gives another class of the same message
    if known.type is not declaration.type and known.type.DESCRIPTOR.full_name != declaration.type.DESCRIPTOR.full_name:
        raise InvalidValue(f"there is a message {name!r} already", hint="choose another name")
    if replace(known, type=declaration.type) != declaration:
        raise InvalidValue(f"the message {name!r} is declared differently already", hint="declare it once")
    return declaration


def register(message: type[Message]) -> type[Message]:
    """Register a user's message type, so that it can be published, cached and received.

    Raises:
        InvalidValue: another type has this name.
    """
    known = _declared.get(message.DESCRIPTOR.name)
    if known is None or known.type.DESCRIPTOR.full_name != message.DESCRIPTOR.full_name:
        declare(MessageDeclaration(type=message))
    return message


def declared() -> tuple[MessageDeclaration, ...]:
    """Return the declarations of all messages, including users' messages."""
    return tuple(_declared.values())


def is_relayed(name: str) -> bool:
    """Return whether the scheduler publishes the message `name` for components; False if it is not declared."""
    return name in _declared and _declared[name].relayed


def is_of_afspm(name: str) -> bool:
    """Return whether the message `name` is part of afspm, and not of a user's package."""
    return name in _OF_AFSPM


def declaration(name: str) -> MessageDeclaration:
    """Return the declaration of the message `name`.

    Raises:
        WireError: the message is not declared.
    """
    try:
        return _declared[name]
    except KeyError:
        raise WireError(
            f"there is no message type {name!r}", hint="name its module under `messages` in the experiment file"
        ) from None


def message_type(name: str) -> type[Message]:
    """Return the class of the message `name`.

    Raises:
        WireError: the message is not declared.
    """
    return declaration(name).type


def known_messages() -> tuple[str, ...]:
    """Return the names of all messages, including users' messages."""
    return tuple(_declared)


def messages_of_the_experiment() -> tuple[str, ...]:
    """Return the names of all messages except those about processes, requests, logs, progress, sweeps and notes."""
    beside = journal_pb2.DESCRIPTOR.name
    return tuple(name for name, one in _declared.items() if one.type.DESCRIPTOR.file.name != beside)


def followed_messages() -> tuple[str, ...]:
    """Return the names of messages that every client follows: states, measurements and their conditions."""
    kinds = (MessageKind.STATE, MessageKind.MEASUREMENT)
    return tuple(name for name, one in _declared.items() if one.kind in kinds or one is CONDITIONS)


def messages_without_values() -> tuple[str, ...]:
    """Return the names of messages from translator and scheduler, and of relayed ones, without those with values."""
    published = (Role.TRANSLATOR, Role.SCHEDULER)
    from_them = (one for one in _declared.values() if one.source in published or one.relayed)
    return tuple(one.name for one in from_them if not one.has_values)


def message_of(envelope: str) -> str:
    """Return the name of a packet's message: its whole envelope, or the longest known name before an underscore.

    Raises:
        WireError: the envelope begins with no known name.
    """
    # the longest name first: the name of a message may begin with the name of another and an underscore
    end = len(envelope)
    while end > 0:
        if (name := envelope[:end]) in _declared:
            return name
        end = envelope.rfind("_", 0, end)
    raise WireError(
        f"the envelope {envelope[:80]!r} begins with no known message's name",
        hint="name the module of your own messages under `messages` in the experiment file",
    )


def parse(message: type[M], payload: bytes | memoryview) -> M:
    """Return the message of the given class that the bytes hold.

    Raises:
        WireError: the bytes are no such message.
    """
    try:
        return message.FromString(payload if isinstance(payload, bytes) else bytes(payload))
    except DecodeError as error:
        raise WireError(f"the bytes are no {message.DESCRIPTOR.name}: {error}") from None
