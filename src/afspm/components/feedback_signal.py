"""What the feedback holds at its setpoint, as a channel of a scan: how much of it is off."""

from __future__ import annotations

from afspm.components.feedback_metrics import ErrorShares, error_shares
from afspm.errors import InvalidValue, Refused, RequestError, UnitError
from afspm.model import Scan, names
from afspm.runtime.scope import Scope

ASKED_WITHIN_S = 5.0


class FeedbackSignal:
    """Compares channels with the setpoint, which is told without a unit: whether it is of their kind is asked once for
    each unit."""

    def __init__(self) -> None:
        self._reasons: dict[str, str] = {}

    def error_shares(self, scan: Scan, setpoint: float | None, threshold: float, scope: Scope) -> ErrorShares:
        """See `feedback_metrics.error_shares`. Raises, besides,

        InvalidValue: the channel is of another kind than the setpoint: an amplitude in m, say, where that is in V; or
            nobody answers just now.
        """
        if setpoint is not None:
            if scan.unit not in self._reasons:
                self._reasons[scan.unit] = self._reason(scan, scope)
            if reason := self._reasons[scan.unit]:
                raise InvalidValue(f"{scan.channel} can't be compared with the setpoint: {reason}")
        return error_shares(scan.values, setpoint, threshold)

    def _reason(self, scan: Scan, scope: Scope) -> str:
        try:
            scope.get(names.ZCTRL_SETPOINT, scan.unit, timeout_s=ASKED_WITHIN_S)
        except UnitError as error:
            return error.what
        except Refused:  # it can't be asked for, and nobody knows better
            return ""
        except RequestError as error:
            raise InvalidValue(f"its unit is not known yet: {error.what}") from error
        return ""
