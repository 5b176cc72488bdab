"""The end of a pulse or crash, which many controllers do not report: the feedback is on, and holds the setpoint.

The duration of the request is over before the tip is back at the sample. In 168 traces of a real Nanonis the tip shaper
began 0.22 to 0.33 s late, and after the dip the preamplifier needed up to 0.45 s to leave saturation. A scan that
begins meanwhile is measured by a tip on its way.
"""

from __future__ import annotations

import logging
from typing import Final

from afspm.basics.errors import Refused
from afspm.model import ControlResponse, ScopeState, ScopeStatus, names
from afspm.translator.driver_base import DriverBase
from afspm.translator.parameters import FEEDBACK_ON
from afspm.translator.state import KeptState

BETWEEN_S: Final = 1.0
"""Least experiment time between the two readings of the current that prove that the feedback holds it."""
LONGEST_S: Final = 5.0
"""Longest wait for the current, experiment time from the end that the controller shows."""
NEAR: Final = 2.0
"""Largest ratio of current and setpoint, and of setpoint and current, at which the feedback holds the current."""
_LOOK_S: Final = 0.25  # experiment time between readings, until the current is near its setpoint
_KEY: Final = "treatment"
_UNPROVED: Final = "unproved_treatment"


class TreatmentEnd:
    """The end of the last treatment of the tip, as far as the current proves it; kept over a restart.

    Nothing is awaited where the feedback holds no current, or was off before the treatment.

    Args:
        kept: JSON values that outlive a kill; the caller saves them.
    """

    def __init__(self, driver: DriverBase, kept: KeptState, log: logging.Logger) -> None:
        self._driver, self._kept, self._log = driver, kept, log

    def expect(self, action: str, state: ScopeState | None) -> None:
        """Register a treatment that is about to begin."""
        if state is not None and self._ratio() is not None and self._is_on():
            self._kept[_KEY] = {"action": action, "state": state.name}

    def forget(self) -> None:
        """Forget a treatment that the controller has refused, or whose end is known."""
        self._kept.pop(_KEY, None)

    @property
    def next_s(self) -> float | None:
        """Experiment time of the next look at the current; None if none is awaited, or the controller is busy still."""
        found = self._kept.get(_KEY)
        return None if found is None else found.get("next_s")

    def status(self) -> ScopeStatus | None:
        """Return the state of the microscope until the end is proved; None if no end is awaited."""
        found = self._kept.get(_KEY)
        if found is None:
            if _UNPROVED in self._kept and self._is_on():
                del self._kept[_UNPROVED]
            return None
        seen, now_s = self._driver.status(), self._driver.clock.now_s()
        if seen.state is not ScopeState.FREE:
            return seen
        free_s, is_on, ratio = found.setdefault("free_s", now_s), self._is_on(), self._ratio() or 0.0
        is_near = is_on and 1.0 / NEAR <= ratio <= NEAR
        near_s = found["near_s"] = (found.get("near_s") or now_s) if is_near else None
        is_over = near_s is not None and now_s - near_s >= BETWEEN_S
        # a current that has just come back is read once more
        if not is_over and (now_s - free_s < LONGEST_S or is_near):
            found["next_s"] = now_s + _LOOK_S if near_s is None else near_s + BETWEEN_S
            return ScopeStatus(ScopeState[found["state"]])
        if not is_over:
            text = (
                "%g s after %s the current is not at its setpoint: the feedback is %s, the current %.3g of the setpoint"
            )
            self._log.warning(text, LONGEST_S, found["action"], "on" if is_on else "off", ratio)
            if not is_on:  # a feedback that is on is switched off later by others than the treatment
                self._kept[_UNPROVED] = found["action"]
        self.forget()
        return seen

    def refuse_start(self) -> None:
        """Refuse a measurement after a treatment that has left the feedback off, unless the feedback was on since.

        Raises:
            Refused: ACTION_ERROR.
        """
        action = self._kept.get(_UNPROVED)
        if action is not None and not self._is_on():
            why = f"after {action} the feedback is off: bring the tip back to the sample, and switch the feedback on"
            raise Refused(ControlResponse.ACTION_ERROR, why)
        self._kept.pop(_UNPROVED, None)

    def _is_on(self) -> bool:
        return bool(self._driver.in_force([FEEDBACK_ON])[FEEDBACK_ON]) if FEEDBACK_ON in self._driver.table else True

    def _ratio(self) -> float | None:
        # of current and setpoint, whose signs differ at some controllers; None where the feedback holds no current
        row = self._driver.table.get(names.ZCTRL_SETPOINT)
        if row is None or row.si_unit != "A" or (current_a := self._driver.current_a()) is None:
            return None
        setpoint_a = abs(float(self._driver.in_force([row.name])[row.name]))
        return abs(current_a) / setpoint_a if setpoint_a else None
