"""Values set for a limited time, as in a bias pulse; the former values are restored afterwards.

The microscope counts as busy meanwhile. The former values are kept on disk: a translator that is restarted, or
reconnects to a lost controller, restores them first.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Final

from afspm.model import ScopeState, ScopeStatus
from afspm.translator.driver_base import LOST, DriverBase
from afspm.translator.held_z import HeldZ
from afspm.translator.parameters import Value
from afspm.translator.setters import apply
from afspm.translator.setting_groups import MOVES
from afspm.translator.state import TranslatorState
from afspm.translator.treatment_end import TreatmentEnd

_KEY: Final = "temporary"


class TemporarySettings:
    """Values that are set for a limited time, and the former values to restore.

    Attributes:
        treatment: the end of a pulse or crash, for which the microscope counts as busy, too.
        held: a z held without feedback, whose way back outlives a kill as well.
    """

    def __init__(self, driver: DriverBase, state: TranslatorState, log: logging.Logger) -> None:
        self._driver = driver
        self._state = state
        self._kept = state.kept
        self._log = log
        self.treatment = TreatmentEnd(driver, state.kept, log)
        self.held = HeldZ(driver, state, log)

    def begin(self, values: Mapping[str, Value], for_s: float) -> None:
        """Set values, and restore the former values after `for_s` experiment seconds.

        Raises:
            Refused: the former values are in force.
            an error in `LOST`: the former values are restored after reconnecting.
        """
        values = {name: self._driver.table[name].checked(value) for name, value in values.items()}
        former = self._driver.in_force(values.keys())
        self._kept[_KEY] = {"former": former, "set": values, "until_s": self._driver.clock.now_s() + for_s}
        self._state.save()  # before any change: a kill must not lose the former values
        try:
            if values:
                self._kept[_KEY]["set"] = {**values, **apply(self._driver, values)}
        except LOST:
            raise  # the outcome is unknown: the former values are restored when the controller is reconnected
        except Exception:  # raised again: `apply` has restored the former values
            self._forget()
            raise
        # counted again: setting the values has taken time
        self._kept[_KEY]["until_s"] = self._driver.clock.now_s() + for_s

    @property
    def until_s(self) -> float | None:
        """Experiment time of the next step: former values are restored, the end of a treatment is looked for, or a held
        z is moved; None if none is due.
        """
        found = self._kept.get(_KEY)
        if found is not None:
            return float(found["until_s"])
        return min((one for one in (self.treatment.next_s, self.held.next_s) if one is not None), default=None)

    @property
    def status(self) -> ScopeStatus | None:
        """The state of the microscope during a temporary change, a treatment or a move of a held z; otherwise None."""
        found = self._kept.get(_KEY)
        if found is not None:
            return ScopeStatus(state_for(found["former"]))
        return self.treatment.status() or self.held.status()

    def end_if_due(self) -> None:
        """Restore the former values once they are due, and watch a held z.

        Raises:
            an error in `LOST`.
        """
        self.held.step()
        found = self._kept.get(_KEY)
        if found is not None and self._driver.clock.now_s() >= float(found["until_s"]):
            self.end()

    def end(self) -> None:
        """Restore the former values, if any, and begin the way back of a held z.

        A value that others have changed meanwhile stays. Values that the controller refuses are logged and given up.

        Raises:
            an error in `LOST`.
        """
        self.held.end("the controller was lost, or the translator has ended in it")
        found = self._kept.get(_KEY)
        if found is None:
            return
        former: dict[str, Value] = found["former"]
        try:
            now = self._driver.in_force(former)
            left = [name for name in former if not self._driver.same(name, found.get("set", now)[name], now[name], now)]
            if left:
                self._log.warning("not set back, since others have set it meanwhile: %s", ", ".join(left))
            if former := {name: value for name, value in former.items() if name not in left}:
                apply(self._driver, former)
        except LOST:
            raise
        except Exception as error:  # a driver may raise anything; a person must learn the values to restore
            self._log.critical("can't restore %s: %s; set it by hand", found["former"], error)
        self._forget()

    def _forget(self) -> None:
        self._kept.pop(_KEY, None)
        self._state.save()


def state_for(values: Mapping[str, Value]) -> ScopeState:
    """Return the state of the microscope while these values are set temporarily."""
    return ScopeState.MOVING if MOVES & values.keys() else ScopeState.BUSY_PARAM
