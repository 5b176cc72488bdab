"""Errors of a call to GXSM."""

from __future__ import annotations

from afspm.basics.errors import AfspmError
from afspm.translator.driver_base import ControllerLost


class GxsmError(AfspmError):
    """An error of a call, reported by GXSM or by the script in its console."""

    code = "gxsm"


class BadReply(ControllerLost):
    """A malformed reply: the link can't be trusted any more."""

    code = "gxsm-bad-reply"
