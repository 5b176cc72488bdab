"""Errors of a call to GXSM."""

from __future__ import annotations

from afspm.basics import AfspmError
from afspm.driver import ControllerLost


class GxsmError(AfspmError):
    """The error that a single call failed; the link stays usable."""

    code = "gxsm"


class BadReply(ControllerLost):
    """The error that a reply is malformed: the link can't be trusted any more."""

    code = "gxsm-bad-reply"
