"""Every message type by its name: those of the contract, and those that users add.

Nothing outside of this package imports the generated modules; a message class that is needed elsewhere comes from here.
"""

from __future__ import annotations

from typing import TypeVar

from google.protobuf.message import DecodeError, Message

from afspm.errors import InvalidValue, WireError
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

_MODULES = (
    analysis_pb2, control_pb2, drift_pb2, feedback_pb2, geometry_pb2,
    journal_pb2, lines_pb2, scan_pb2, spectroscopy_pb2,
)  # fmt: skip
_messages: dict[str, type[Message]] = {
    name: getattr(module, name) for module in _MODULES for name in module.DESCRIPTOR.message_types_by_name
}


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
    """Return the class of the message `name`.

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
    """Return the names of all message types, those of users included."""
    return tuple(_messages)


def messages_of_the_experiment() -> tuple[str, ...]:
    """Return the names of those about sample, microscope and control; not about processes, requests and logs."""
    beside = journal_pb2.DESCRIPTOR.name
    return tuple(name for name, message in _messages.items() if message.DESCRIPTOR.file.name != beside)


def message_of(envelope: str) -> str:
    """Return the name of the message in a packet: the envelope is that name, or begins with it and an underscore.

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
    """Return bytes as a message of the given class.

    Raises:
        WireError: they are none.
    """
    try:
        return message.FromString(payload if isinstance(payload, bytes) else bytes(payload))
    except DecodeError as error:
        raise WireError(f"the bytes are no {message.DESCRIPTOR.name}: {error}") from None
