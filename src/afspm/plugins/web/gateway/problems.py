"""Refusals of the gateway: one model with a code, a reason and advice, for every source of a refusal."""

from __future__ import annotations

from enum import Enum
from http import HTTPStatus

from pydantic import BaseModel, ConfigDict, Field

from afspm.basics import AfspmError, ExperimentEnded, NoResponse, iso_utc
from afspm.model import HAS_ENDED, ControlResponse, Response, ResponseDetail
from afspm.transport import StopRequested


class RefusalCode(Enum):
    """The reasons of refusals."""

    INVALID = "invalid"
    TOO_LARGE = "too-large"
    NOT_FOUND = "not-found"
    METHOD_NOT_ALLOWED = "method-not-allowed"
    NAME_NEEDED = "name-needed"
    UNAUTHORIZED = "unauthorized"
    WRONG_ORIGIN = "wrong-origin"
    TOO_MANY = "too-many"
    GONE = "gone"
    KEY_USED = "key-used"
    NOT_IN_CONTROL = "not-in-control"
    ALREADY_UNDER_CONTROL = "already-under-control"
    WRONG_MODE = "wrong-mode"
    PROBLEM_FLAGGED = "problem-flagged"
    NOT_FREE = "not-free"
    TOO_SOON = "too-soon"
    FORBIDDEN = "forbidden"
    NOT_SUPPORTED = "not-supported"
    PARAMETER_REFUSED = "parameter-refused"
    ACTION_FAILED = "action-failed"
    INTERRUPTED = "interrupted"
    NO_RESULT = "no-result"
    NO_RESPONSE = "no-response"
    EXPERIMENT_ENDED = "experiment-ended"
    FAILED = "failed"


_C, _S = RefusalCode, HTTPStatus
_STATUS = {
    _C.INVALID: _S.UNPROCESSABLE_ENTITY,
    _C.TOO_LARGE: _S.REQUEST_ENTITY_TOO_LARGE,
    _C.NOT_FOUND: _S.NOT_FOUND,
    _C.METHOD_NOT_ALLOWED: _S.METHOD_NOT_ALLOWED,
    _C.NAME_NEEDED: _S.UNAUTHORIZED,
    _C.UNAUTHORIZED: _S.UNAUTHORIZED,
    _C.WRONG_ORIGIN: _S.FORBIDDEN,
    _C.TOO_MANY: _S.TOO_MANY_REQUESTS,
    _C.TOO_SOON: _S.TOO_MANY_REQUESTS,
    _C.GONE: _S.GONE,
    _C.FORBIDDEN: _S.FORBIDDEN,
    _C.NOT_SUPPORTED: _S.NOT_FOUND,
    _C.NO_RESPONSE: _S.GATEWAY_TIMEOUT,
    _C.EXPERIMENT_ENDED: _S.GONE,
    _C.FAILED: _S.INTERNAL_SERVER_ERROR,
}
"""HTTP status by code. Other codes give 409: a well-formed request that the experiment refuses."""
_ADVICE = {
    _C.INVALID: "Correct the request; /openapi.json describes it.",
    _C.TOO_LARGE: "Send less: no request needs more than 64 KiB.",
    _C.NOT_FOUND: "Look it up in the list above it.",
    _C.METHOD_NOT_ALLOWED: "The header Allow names the methods; /openapi.json describes them.",
    _C.NAME_NEEDED: "Send a name and its token with HTTP Basic, or `Authorization: Bearer NAME:TOKEN`.",
    _C.UNAUTHORIZED: "Check name and token against `people` of the gateway. After five wrong ones wait a minute.",
    _C.WRONG_ORIGIN: "Ask at the address that the gateway listens at, or name the page in `origins` of the gateway.",
    _C.TOO_MANY: "Wait for the answers to the requests before, then send it again.",
    _C.GONE: "Read it from the record of the run.",
    _C.KEY_USED: "Use another key: this one is of another measurement.",
    _C.NOT_IN_CONTROL: "Request control (POST /v1/control), then send it again.",
    _C.ALREADY_UNDER_CONTROL: "Wait until control is released (POST /v1/control?wait_s=20), then ask again.",
    _C.WRONG_MODE: "Wait until a person sets the mode to AUTOMATED.",
    _C.PROBLEM_FLAGGED: "Wait until the problem is cleared, or request control to solve it.",
    _C.NOT_FREE: "Wait until the state is FREE, then send it again.",
    _C.TOO_SOON: "Wait until the experiment's time `again` (header Retry-After: real seconds), then send it again.",
    _C.FORBIDDEN: "Have the name given the role in [control.roles] of the experiment file.",
    _C.NOT_SUPPORTED: "Use what the microscope has: GET /v1/parameters, GET /v1/actions.",
    _C.PARAMETER_REFUSED: "Change the value: its unit, a limit or the microscope does not allow it.",
    _C.ACTION_FAILED: "Look at the microscope, and at the events, before you try again.",
    _C.INTERRUPTED: "Request control again, then send the request again with the same key.",
    _C.NO_RESULT: "Send the request again with the same key.",
    _C.NO_RESPONSE: "Send the request again; give measurements a key, which makes that safe.",
    _C.EXPERIMENT_ENDED: "Nothing more can be asked; the record of the run has everything.",
    _C.FAILED: "Look at the log of the gateway.",
}
_R = ControlResponse
_BY_RESPONSE = {
    _R.FAILURE: _C.FORBIDDEN,
    _R.CMD_NOT_SUPPORTED: _C.NOT_SUPPORTED,
    _R.NO_RESPONSE: _C.NO_RESPONSE,
    _R.ALREADY_UNDER_CONTROL: _C.ALREADY_UNDER_CONTROL,
    _R.WRONG_CONTROL_MODE: _C.WRONG_MODE,
    _R.NOT_IN_CONTROL: _C.NOT_IN_CONTROL,
    _R.NOT_FREE: _C.NOT_FREE,
    _R.PARAM_NOT_SUPPORTED: _C.NOT_SUPPORTED,
    _R.PARAM_ERROR: _C.PARAMETER_REFUSED,
    _R.WRONG_EXP_PROBLEM: _C.PROBLEM_FLAGGED,
    _R.ACTION_NOT_SUPPORTED: _C.NOT_SUPPORTED,
    _R.ACTION_ERROR: _C.ACTION_FAILED,
}


class RefusalModel(BaseModel):
    """A refusal. Programs branch on `code`; `reason` and `advice` are for people."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "code": "not-in-control",
                    "reason": "gateway:ada is not in control, series is",
                    "advice": _ADVICE[_C.NOT_IN_CONTROL],
                    "may_have_been_done": False,
                }
            ]
        }
    )

    code: RefusalCode
    reason: str = Field(description="in the words of the scheduler, the microscope or the gateway")
    advice: str = Field(description="what to do about it")
    may_have_been_done: bool = Field(
        default=False, description="no answer came: the microscope may have carried it out"
    )
    again: str | None = Field(
        default=None, description="experiment time (ISO 8601) from which on a limit on time may allow it"
    )


class RefusedRequest(Exception):
    """The error that ends a request with a refusal.

    Attributes:
        again_ns: the experiment time from which on a limit on time may allow the request; None for other refusals.
    """

    def __init__(
        self, code: RefusalCode, reason: str, *, may_have_been_done: bool = False, again_ns: int | None = None
    ) -> None:
        super().__init__(reason)
        self.again_ns = again_ns
        self.model = RefusalModel(
            code=code, reason=reason, advice=_ADVICE[code], may_have_been_done=may_have_been_done,
            again=None if again_ns is None else iso_utc(again_ns),
        )  # fmt: skip

    @property
    def status(self) -> int:
        return _STATUS.get(self.model.code, HTTPStatus.CONFLICT)


def refused(response: Response) -> RefusedRequest:
    """Convert an unsuccessful response to a refusal."""
    if response.detail is ResponseDetail.EXPERIMENT_ENDED:
        return RefusedRequest(_C.EXPERIMENT_ENDED, response.reason)
    if response.again_ns is not None:
        return RefusedRequest(_C.TOO_SOON, response.reason, again_ns=response.again_ns)
    is_known = response.code in ControlResponse._value2member_map_
    code = _BY_RESPONSE.get(ControlResponse(response.code), _C.FAILED) if is_known else _C.FAILED
    is_unknown = code is _C.NO_RESPONSE and response.detail is not ResponseDetail.NOT_SENT
    return RefusedRequest(code, response.reason or code.value, may_have_been_done=is_unknown)


def of_error(error: BaseException) -> RefusedRequest:
    """Convert an error to a refusal."""
    match error:
        case RefusedRequest():
            return error
        case ExperimentEnded() | StopRequested():
            return RefusedRequest(_C.EXPERIMENT_ENDED, str(error) or HAS_ENDED)
        case NoResponse():
            return RefusedRequest(_C.NO_RESPONSE, str(error), may_have_been_done=True)
        case AfspmError():
            return RefusedRequest(_C.PARAMETER_REFUSED, str(error))
    return RefusedRequest(_C.FAILED, f"{type(error).__name__}: {error}")
