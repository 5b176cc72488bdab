"""Every message, declared once: all that the other rooms do by the name of a message follows from its declaration.

Nothing outside of this package imports the generated modules; a message class that is needed elsewhere comes from here.

| a declaration says | which decides |
| --- | --- |
| type | how its bytes are read; its name, and with it its envelopes |
| kind, source, always | what clients follow, what a terminal subscribes to, what `afspm check` knows as published |
| history | how many packets of an envelope the scheduler keeps for late joiners |
| handler | the method of a component, and of an overview of the record, that gets it |
| attribute | where a client keeps the newest |
| event | the kind of event under which the gateway streams it |

What must hold: a name is declared once; no set, table or tuple of message names stands in another package.
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
    control_pb2,
    drift_pb2,
    feedback_pb2,
    geometry_pb2,
    journal_pb2,
    lines_pb2,
    scan_pb2,
    spectroscopy_pb2,
)
from afspm.wire.generated.control_pb2 import ParameterMsg
from afspm.wire.generated.drift_pb2 import DriftMapping, DriftRescan
from afspm.wire.generated.feedback_pb2 import ZCtrlParameters
from afspm.wire.generated.scan_pb2 import ScanParameters2d
from afspm.wire.generated.spectroscopy_pb2 import ProbePosition

__all__ = ["DriftMapping", "DriftRescan", "ParameterMsg", "ProbePosition", "ScanParameters2d", "ZCtrlParameters"]

M = TypeVar("M", bound=Message)


class MessageKind(Enum):
    """The kinds of messages, by which receivers treat them."""

    MEASUREMENT = "a finished measurement, with its values"
    LINES = "rows of a running scan: of the moment, not kept"
    STATE = "what is in force: the newest replaces those before"
    EVENT = "what happened to processes, requests and people's notes"
    RESULT = "what a component or a drift scheduler found out"
    PART = "a part of other messages or of requests, or a message of a user"


@dataclass(frozen=True, kw_only=True)
class MessageDeclaration:
    """All that is known of a message by its name.

    Attributes:
        type: the generated class.
        kind: see `MessageKind`.
        source: the role that publishes it; None: no process by itself.
        always: every process of that role publishes it; False: only where something asks for it.
        named: its envelopes go on after its name: with size and channel, kind or owner.
        history: packets of an envelope that the scheduler keeps for late joiners; 0: none.
        handler: the method that gets it, of a `Component` and of an `Overview`.
        attribute: of a client's view, where the newest is kept; empty: it is not kept.
        set_by: the request that sets what it says.
        event: its kind among the events of the gateway; empty: it is not streamed.
        in_past: an overview of an earlier part of a run needs all of its packets, not the newest alone.
        name: of the message, with which its envelopes begin.
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
    name: str = field(init=False)

    def __post_init__(self) -> None:
        # kept, since each packet is compared with some: reading the descriptor takes longer
        object.__setattr__(self, "name", self.type.DESCRIPTOR.name)
        if not self.handler:
            object.__setattr__(self, "handler", f"on_{snake_case(self.name)}")

    @property
    def has_values(self) -> bool:
        """Whether it carries an array of measured values."""
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
PROBE_POSITION: Final = MessageDeclaration(
    type=ProbePosition,
    kind=MessageKind.STATE,
    source=Role.TRANSLATOR,
    handler="on_probe_position",
    attribute="probe_position",
    set_by=ControlRequest.SET_PROBE_POS,
    event="probe-position",
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
    type=analysis_pb2.SpatialROIWithScoreList,
    kind=MessageKind.RESULT,
    source=Role.COMPONENT,
    always=False,
)
POINTS: Final = MessageDeclaration(
    type=analysis_pb2.SpatialPointWithScoreList,
    kind=MessageKind.RESULT,
    source=Role.COMPONENT,
    always=False,
)
FEEDBACK_ANALYSIS: Final = MessageDeclaration(
    type=feedback_pb2.FeedbackAnalysis, kind=MessageKind.RESULT, source=Role.COMPONENT, always=False
)

_MODULES = (
    analysis_pb2, control_pb2, drift_pb2, feedback_pb2, geometry_pb2,
    journal_pb2, lines_pb2, scan_pb2, spectroscopy_pb2,
)  # fmt: skip
_declared: dict[str, MessageDeclaration] = {
    one.name: one for one in list(globals().values()) if isinstance(one, MessageDeclaration)
}
for _module in _MODULES:
    for _name in _module.DESCRIPTOR.message_types_by_name:
        _declared.setdefault(_name, MessageDeclaration(type=getattr(_module, _name)))


def declare(declaration: MessageDeclaration) -> MessageDeclaration:
    """Add a message of a package of one's own, with all that follows from its declaration.

    Raises:
        InvalidValue: another type has that name.
    """
    name = declaration.name
    known = _declared.setdefault(name, declaration)
    if known.type is not declaration.type and known.type.DESCRIPTOR.full_name != declaration.type.DESCRIPTOR.full_name:
        raise InvalidValue(f"there is a message {name!r} already", hint="choose another name")
    if replace(known, type=declaration.type) != declaration:
        raise InvalidValue(f"the message {name!r} is declared differently already", hint="declare it once")
    return declaration


def register(message: type[Message]) -> type[Message]:
    """Make a message type of a user known, so that it is published, cached and received by its name.

    Raises:
        InvalidValue: another type has that name.
    """
    known = _declared.get(message.DESCRIPTOR.name)
    if known is None or known.type.DESCRIPTOR.full_name != message.DESCRIPTOR.full_name:
        declare(MessageDeclaration(type=message))
    return message


def declared() -> tuple[MessageDeclaration, ...]:
    """Return the declarations of all messages, those of users included."""
    return tuple(_declared.values())


def declaration(name: str) -> MessageDeclaration:
    """Return the declaration of the message `name`.

    Raises:
        WireError: there is none.
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
        WireError: it is not declared.
    """
    return declaration(name).type


def known_messages() -> tuple[str, ...]:
    """Return the names of all message types, those of users included."""
    return tuple(_declared)


def messages_of_the_experiment() -> tuple[str, ...]:
    """Return the names of messages about sample, microscope and control; not about processes, requests and logs."""
    beside = journal_pb2.DESCRIPTOR.name
    return tuple(name for name, one in _declared.items() if one.type.DESCRIPTOR.file.name != beside)


def followed_messages() -> tuple[str, ...]:
    """Return the names of messages that every client follows: the state, and measurements that may be its own."""
    return tuple(name for name, one in _declared.items() if one.kind in (MessageKind.STATE, MessageKind.MEASUREMENT))


def messages_without_values() -> tuple[str, ...]:
    """Return the names of messages that a scheduler publishes, but for those with values of scans and spectra."""
    published = (Role.TRANSLATOR, Role.SCHEDULER)
    return tuple(name for name, one in _declared.items() if one.source in published and not one.has_values)


def message_of(envelope: str) -> str:
    """Return the name of the message in a packet: the envelope is that name, or begins with it and an underscore.

    Raises:
        WireError: it begins with no known message's name.
    """
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
    """Return bytes as a message of the given class.

    Raises:
        WireError: they are none.
    """
    try:
        return message.FromString(payload if isinstance(payload, bytes) else bytes(payload))
    except DecodeError as error:
        raise WireError(f"the bytes are no {message.DESCRIPTOR.name}: {error}") from None
