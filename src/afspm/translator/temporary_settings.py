"""Values that are in force for a while, as those of a bias pulse: what was there before is put back.

The translator holds the microscope busy meanwhile. It remembers what to put back, so that a translator that is started
anew, or finds a lost controller again, does so first.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from afspm.model import ScopeState, ScopeStatus
from afspm.translator.driver_base import LOST, DriverBase
from afspm.translator.parameters import Value
from afspm.translator.setters import apply
from afspm.translator.setting_groups import MOVES
from afspm.translator.state import TranslatorState

_KEY = "temporary"


class TemporarySettings:
    """The values that are in force for a while, if any are."""

    def __init__(self, driver: DriverBase, state: TranslatorState, log: logging.Logger) -> None:
        self._driver = driver
        self._state = state
        self._kept = state.kept
        self._log = log

    def begin(self, values: Mapping[str, Value], for_s: float) -> None:
        """Set values, to be put back after `for_s`, experiment time.

        Raises:
            Refused: nothing was changed.
        """
        values = {name: self._driver.table[name].checked(value) for name, value in values.items()}
        former = self._driver.in_force(values.keys())
        self._kept[_KEY] = {"former": former, "until_s": self._driver.clock.now_s() + for_s}
        self._state.save()  # before anything is changed
        try:
            if values:
                apply(self._driver, values)
        except LOST:
            raise  # whether it was set is not known: it is put back when the controller is found again
        except Exception:
            self._forget()
            raise
        self._kept[_KEY]["until_s"] = self._driver.clock.now_s() + for_s

    @property
    def until_s(self) -> float | None:
        """Experiment time at which it is over; None: nothing is temporary."""
        found = self._kept.get(_KEY)
        return None if found is None else float(found["until_s"])

    @property
    def status(self) -> ScopeStatus | None:
        """The state of the microscope meanwhile; None: nothing is temporary."""
        found = self._kept.get(_KEY)
        return None if found is None else ScopeStatus(state_for(found["former"]))

    def end_if_due(self) -> None:
        """Put back what was there, once it is time. Raises what says that the controller is lost."""
        if self.until_s is not None and self._driver.clock.now_s() >= self.until_s:
            self.end()

    def end(self) -> None:
        """Put back what was there, if anything is temporary. Raises what says that the controller is lost."""
        found = self._kept.get(_KEY)
        if found is None:
            return
        try:
            if found["former"]:
                apply(self._driver, found["former"])
        except LOST:
            raise
        except Exception as error:
            self._log.critical("can't restore %s: %s; set it by hand", found["former"], error)
        self._forget()

    def _forget(self) -> None:
        self._kept.pop(_KEY, None)
        self._state.save()


def state_for(values: Mapping[str, Value]) -> ScopeState:
    """Return the state of the microscope while such values are in force for a while."""
    return ScopeState.MOVING if MOVES & values.keys() else ScopeState.BUSY_PARAM
