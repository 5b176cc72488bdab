"""The errors of a call to GXSM."""

from __future__ import annotations

from afspm.basics.errors import AfspmError
from afspm.translator.driver_base import ControllerLost


class GxsmError(AfspmError):
    """GXSM, or the script in its console, could not do a call, and says so."""

    code = "gxsm"


class BadReply(ControllerLost):
    """A reply that is not what it should be: nothing more on this link is believed."""

    code = "gxsm-bad-reply"
