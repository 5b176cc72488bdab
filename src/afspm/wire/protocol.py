"""The protocol between processes: its version, signals and bounds, and what may be sent to a peer of version 1.

Requests and their outcomes are numbered in `model` (`ControlRequest`, `ControlResponse`, `ResponseDetail`).

Version 1 is that of the published implementation: it ends over envelopes and request numbers that it does not know. A
peer is known to be one of ours by what only ours do: a subscriber by its marker (`transport.replay`), a client by the
ids of its requests, a scheduler or translator by its answer to a `QUESTION` that version 1 can answer, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import Enum, auto
from typing import Final

from afspm.model import ControlRequest, ControlResponse, Response
from afspm.wire.generated import control_pb2
from afspm.wire.messages import declared

PROTOCOL_VERSION: Final = 2

KILL: Final = b"KILL"
"""The packet of one frame by which all subscribers learn that the experiment has ended."""
CLOSE: Final = bytes([100])
"""The request of one frame by which the scheduler tells its translator, which subscribes to nobody, the same."""
BEAT: Final = b"\x00"
CLOSING: Final = b"\x01"
LONGEST_ID: Final = 200
LONGEST_ENVELOPE: Final = 1000
"""Bytes."""


VERSION_1_MESSAGES: Final = tuple(one.name for one in declared() if one.in_version_1)
"""The messages that a cache of version 1 knows."""


class Version(Enum):
    """The version of the protocol that a peer speaks."""

    UNKNOWN = auto()
    """Nothing was heard of it yet."""
    ONE = auto()
    OURS = auto()


VERSION_2_ACTION: Final = "x-version-2"
"""An action that ours alone have."""
_ACTION = control_pb2.ActionMsg(action=VERSION_2_ACTION).SerializeToString()
QUESTION: Final = (bytes([ControlRequest.ACTION_SUPPORT]), _ACTION)
"""The request of version 1 that tells ours apart: whether the peer supports that action."""
ANSWER: Final = (bytes([ControlResponse.SUCCESS]), _ACTION)
"""The answer of ours, which no peer of version 1 gives: its object is the action."""
_WITHOUT_OBJECT = (ControlRequest.RELEASE_CTRL, ControlRequest.END_EXPERIMENT)


def version_of(asked_id: str, response: Response) -> Version:
    """Return the version of the peer that answered a request with an id: ours repeats it."""
    return Version.OURS if response.id and response.id == asked_id else Version.ONE


def is_of_version_1(number: int) -> bool:
    """Return whether version 1 has a request of this number."""
    return ControlRequest.UNDEFINED < number <= ControlRequest.ACTION_SUPPORT


def as_version_1(frames: Sequence[bytes]) -> list[bytes]:
    """Return a request as version 1 sends it: number, and the object of a request that has one, be it empty; no id."""
    number = frames[0][0]
    return [frames[0]] if number in _WITHOUT_OBJECT else [frames[0], *(frames[1:2] or [b""])]


def answer_as_version_1(asked: int, frames: Sequence[bytes]) -> list[bytes]:
    """Return a response as version 1 reads it: number and object, and no reason.

    Args:
        asked: the number of the request; the answer to REQ_PARAM always has an object, be it empty.
    """
    payload = frames[1] if len(frames) > 1 else b""
    return [frames[0], payload] if payload or asked == ControlRequest.PARAM else [frames[0]]


def not_of_version_1(frames: Sequence[bytes], whose: str) -> Response:
    """Return the answer to a request that is not sent, since a peer of version 1 would end over its number."""
    asked_id = frames[2].decode() if len(frames) > 2 else ""
    reason = f"the {whose} is of version 1 of the protocol, which has no request {frames[0][0]}"
    return Response(int(ControlResponse.CMD_NOT_SUPPORTED), b"", reason, asked_id)


def prefixes_of_version_1(prefixes: Iterable[str]) -> list[str]:
    """Return the subscriptions of a peer of version 1 as they are meant: to the messages of that version.

    A prefix that is longer than all names of version 1 that it begins like, or begins like none, is meant as it is.

    >>> prefixes_of_version_1(["Scan2d_2", "Scan", "JournalEntries"])
    ['Scan2d_2', 'Scan2d', 'ScanParameters2d', 'JournalEntries']
    """
    found: list[str] = []
    for prefix in prefixes:
        found += [name for name in (*VERSION_1_MESSAGES, KILL.decode()) if name.startswith(prefix)] or [prefix]
    return found
