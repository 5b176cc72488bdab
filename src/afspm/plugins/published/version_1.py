"""Version 1 of the protocol: what its programs can read. All else ends them."""

from __future__ import annotations

from typing import Final

from afspm.basics.launch import Launch
from afspm.model import ControlRequest, ControlResponse, Request, Response
from afspm.transport.network import Network
from afspm.wire import KILL, encode_response, encode_subject
from afspm.wire.messages import (
    CONTROL_STATE,
    FEEDBACK,
    POINTS,
    PROBE_POSITION,
    REGIONS,
    SCAN,
    SCAN_PARAMETERS,
    SCOPE_STATE,
    SPECTRUM,
)

TOPICS: Final = (
    SCAN.name,
    SPECTRUM.name,
    SCOPE_STATE.name,
    CONTROL_STATE.name,
    SCAN_PARAMETERS.name,
    FEEDBACK.name,
    PROBE_POSITION.name,
    REGIONS.name,
    POINTS.name,
)
"""The messages that a cache of version 1 knows."""
_WITHOUT_OBJECT = (ControlRequest.RELEASE_CTRL, ControlRequest.END_EXPERIMENT)


def outside(launch: Launch) -> Network:
    """Return a network for plain sockets: on this computer only, unless [security] insecure is set."""
    return Network(insecure=bool(launch.keys and launch.keys.get("insecure")))


def has_request(number: int) -> bool:
    """Return whether version 1 has a request of this number."""
    return ControlRequest.UNDEFINED < number <= ControlRequest.ACTION_SUPPORT


def request_frames(request: Request) -> list[bytes]:
    """Return a request in the frames of version 1: number, and the object of a request that has one, be it empty."""
    number = bytes([request.kind])
    return [number] if request.kind in _WITHOUT_OBJECT else [number, request.payload or encode_subject(request.subject)]


def answer_frames(asked: int, response: Response, *, reason: bool = False) -> list[bytes]:
    """Return a response in the frames of version 1: number and object.

    Args:
        asked: the number of the request; the answer to REQ_PARAM always has an object, be it empty.
        reason: add the reason as a third frame, for a person who looks at what came.
    """
    if reason:
        return encode_response(response)[:3]
    number = bytes([response.code])
    return [number, response.payload] if response.payload or asked == ControlRequest.PARAM else [number]


def unknown_request(number: int, whose: str, request_id: str) -> Response:
    """Return the answer to a request that is not sent outside, where its number would end the peer."""
    reason = f"the {whose} is of version 1 of the protocol, which has no request {number}"
    return Response(int(ControlResponse.CMD_NOT_SUPPORTED), b"", reason, request_id)


def topics_meant(prefix: str) -> list[str]:
    """Return the prefixes that a subscription of version 1 means: a common beginning stands for messages it knows.

    >>> topics_meant("Scan")
    ['Scan2d', 'ScanParameters2d']
    >>> topics_meant("Scan2d_2"), topics_meant("JournalEntries")
    (['Scan2d_2'], ['JournalEntries'])
    """
    return [name for name in (*TOPICS, KILL.decode()) if name.startswith(prefix)] or [prefix]
