"""Requests and responses, as components, scheduler and translator speak of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from afspm.model.enums import ControlResponse

HAS_ENDED = "the experiment has ended"
"""The reason of every refusal after the end."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter by name. Without a value it is asked for; with one it is set, or told.

    Attributes:
        value: as text, in `unit`; None to get it.
        unit: None if none was given: SI then.
    """

    name: str
    value: str | None = None
    unit: str | None = None


@dataclass(slots=True)
class Request:
    """A request to scheduler or translator.

    Attributes:
        kind: the number of a ControlRequest.
        subject: what it is about: a ScanParameters, Feedback, ProbePosition or Parameter, the name of an action,
            the number of a problem or control mode; None if nothing.
        payload: the subject as it came, in bytes.
        id: the same for every repetition of one request; empty from peers of version 1.
    """

    kind: int
    subject: Any = None
    payload: bytes = b""
    id: str = ""


class ResponseDetail(IntEnum):
    """The detail of a response that a program needs beside its code; the numbers of the wire."""

    NONE = 0
    NOT_SENT = 1
    """A NO_RESPONSE to a request that was certainly not carried out: it may be asked again."""
    OUTCOME_UNKNOWN = 2
    """A NO_RESPONSE to a request that may have been carried out."""
    EXPERIMENT_ENDED = 3


@dataclass(slots=True)
class Response:
    """The answer to a request.

    Attributes:
        code: the number of a ControlResponse.
        payload: an object in bytes (a parameter's value), mostly empty.
        reason: for a person, why it is not a success.
        id: of the request that it answers, if that had one.
        detail: what a program must know beside the code.
    """

    code: int
    payload: bytes = b""
    reason: str = ""
    id: str = ""
    detail: ResponseDetail = ResponseDetail.NONE

    @property
    def ok(self) -> bool:
        return self.code == ControlResponse.SUCCESS
