"""Requests and responses, as components, scheduler and translator speak of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

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


CLOCK_REQUEST = 101
"""A request of ours: what time it is in the experiment."""
RELAY_REQUEST = 102
"""A request of ours: a supervisor has something to publish; its answer are orders to it."""
RESTART_REQUEST = 103
"""A request of ours: a process is to be started anew; its subject is the process's name."""
LEASE_REQUEST = 104
"""A request of ours: the holder loses control when it has let so many real seconds pass without
another command or another of these, whatever the microscope does; its subject is that number."""
LONGEST_LEASE_S = 86_400.0

OTHER_RUN_RESPONSE = 100
"""A response of ours, and only to those who named their run: it is not that of the scheduler."""

_OURS = {CLOCK_REQUEST: "CLOCK", RELAY_REQUEST: "TELL", RESTART_REQUEST: "RESTART", LEASE_REQUEST: "LEASE"}


def request_name(kind: int) -> str:
    """Return a request in words."""
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
"""Answers to a request for control that will be granted later: nothing was refused, the component waits."""


class RescanKind(IntEnum):
    """Requests to a Rescanner; a message of ours."""

    AGAIN = 1
    """The same region."""
    OPPOSITE = 2
    """In the other direction of the slow axis."""
    SEARCH = 3
    """A wider region, until the sample is found."""


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
        id: the same for every repetition of one request; empty if it may not be repeated.
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
