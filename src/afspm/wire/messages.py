"""Every message type by its name: those of the contract, and those that users add."""

from __future__ import annotations

from typing import TypeVar

from google.protobuf.message import DecodeError, Message

from afspm.errors import InvalidValue, WireError
from afspm.wire.generated.analysis_pb2 import (
    SpatialPoint,
    SpatialPointWithScore,
    SpatialPointWithScoreList,
    SpatialROIWithScore,
    SpatialROIWithScoreList,
)
from afspm.wire.generated.control_pb2 import ActionMsg, ControlState, ParameterMsg, ScopeStateMsg
from afspm.wire.generated.drift_pb2 import DriftMapping, DriftRescan
from afspm.wire.generated.feedback_pb2 import FeedbackAnalysis, ZCtrlParameters
from afspm.wire.generated.geometry_pb2 import (
    Point2d,
    Point2u,
    Rect2d,
    Rect2i,
    RotRect2d,
    RotRect2i,
    Size2d,
    Size2u,
    Size3u,
)
from afspm.wire.generated.journal_pb2 import (
    JournalEntries,
    JournalEntry,
    LogLine,
    LogLines,
    Orders,
    ProcessState,
    ProcessStates,
    Progress,
    Told,
)
from afspm.wire.generated.lines_pb2 import ScanLines
from afspm.wire.generated.scan_pb2 import DataAspects, Scan2d, ScanParameters2d, SpatialAspects
from afspm.wire.generated.spectroscopy_pb2 import ProbePosition, Spec1d, SpecData

M = TypeVar("M", bound=Message)

_BESIDE = "journal.proto"

_messages: dict[str, type[Message]] = {
    message.DESCRIPTOR.name: message
    for message in (
        ActionMsg, ControlState, DataAspects, DriftMapping, DriftRescan, FeedbackAnalysis, JournalEntries,
        JournalEntry, LogLine, LogLines, Orders, ParameterMsg, Point2d, Point2u, ProbePosition, ProcessState,
        ProcessStates, Progress, Rect2d, Rect2i, RotRect2d, RotRect2i, Scan2d, ScanLines, ScanParameters2d,
        ScopeStateMsg, Size2d, Size2u, Size3u, SpatialAspects, SpatialPoint, SpatialPointWithScore,
        SpatialPointWithScoreList, SpatialROIWithScore, SpatialROIWithScoreList, Spec1d, SpecData, Told,
        ZCtrlParameters,
    )
}  # fmt: skip


def register(message: type[Message]) -> type[Message]:
    """Make a message type of one's own known, so that it is published, cached and received by its name.

    Raises:
        InvalidValue: another type has that name.
    """
    name = message.DESCRIPTOR.name
    known = _messages.setdefault(name, message)
    if known is not message and known.DESCRIPTOR.full_name != message.DESCRIPTOR.full_name:
        raise InvalidValue(f"there is a message {name!r} already", hint="choose another name")
    return message


def message_type(name: str) -> type[Message]:
    """The class of the message `name`.

    Raises:
        WireError: nobody registered it.
    """
    try:
        return _messages[name]
    except KeyError:
        raise WireError(
            f"there is no message type {name!r}", hint="name its module under `messages` in the experiment file"
        ) from None


def known_messages() -> tuple[str, ...]:
    """The names of all message types, those of users included."""
    return tuple(_messages)


def messages_of_the_experiment() -> tuple[str, ...]:
    """Those of them that are about sample, microscope and control; not what is told of processes, requests and logs."""
    return tuple(name for name, message in _messages.items() if message.DESCRIPTOR.file.name != _BESIDE)


def message_of(envelope: str) -> str:
    """The name of the message in a packet: its envelope is that name, or begins with that name and an underscore.

    Raises:
        WireError: it begins with no known message's name.
    """
    end = len(envelope)
    while end > 0:
        if (name := envelope[:end]) in _messages:
            return name
        end = envelope.rfind("_", 0, end)
    raise WireError(
        f"the envelope {envelope[:80]!r} begins with no known message's name",
        hint="name the module of your own messages under `messages` in the experiment file",
    )


def parse(message: type[M], payload: bytes | memoryview) -> M:
    """Bytes as a message of the given class.

    Raises:
        WireError: they are none.
    """
    try:
        return message.FromString(payload if isinstance(payload, bytes) else bytes(payload))
    except DecodeError as error:
        raise WireError(f"the bytes are no {message.DESCRIPTOR.name}: {error}") from None
