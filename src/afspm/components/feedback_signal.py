"""What the feedback holds at its setpoint, as a channel of a scan."""

from __future__ import annotations

from afspm.errors import InvalidValue, RequestError, UnitError
from afspm.model import Scan, names
from afspm.runtime.scope import Scope


class Comparable:
    """Asks, once for each unit, whether a channel can be compared with the setpoint, which is told without a unit."""

    def __init__(self) -> None:
        self._units: set[str] = set()

    def require(self, scan: Scan, scope: Scope) -> None:
        """Raises InvalidValue: it is of another kind than the setpoint: an amplitude in m, say, where that is in V."""
        if scan.unit in self._units:
            return
        try:
            scope.get(names.ZCTRL_SETPOINT, scan.unit)
        except UnitError as error:
            raise InvalidValue(f"{scan.channel} can't be compared with the setpoint: {error.what}") from error
        except RequestError:
            return  # it can't be asked for now
        self._units.add(scan.unit)
