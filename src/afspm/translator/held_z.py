"""A held z: the feedback is off by a request of the run, and z stands at an offset from the height of the setpoint.

| phase | the tip | ends |
| --- | --- | --- |
| `off` | at the setpoint, while the feedback is being switched off | when the feedback reads as off, and z as before |
| `held` | at the offset, or on its way there | by `x-release-z`, an abort, a restart, or a lost controller |
| `back` | on its way to the height of the setpoint, then waits for the settings of before | with the feedback on |
| `failed` | withdrawn: a part of the way back was refused or could not be read | when it has been withdrawn |

**The way back** is one request: first z, since a tip that is nearer than the setpoint is in danger; then bias,
setpoint and gains as they were read before, since a feedback that acts on another bias or setpoint drives the tip
into the sample; each is read back; then the feedback. A person may switch the feedback on before or meanwhile: where
it holds a current, the settings are set back in an order that never narrows the gap. Everything that the way back
needs is on disk before the feedback is switched off. It begins with a reading of z and can be repeated from any step:
a translator that is restarted, or reconnects to a lost controller, does so before anything else.

A ramp takes a step at each look, so that a request to withdraw the tip never waits for it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Final

from afspm.basics.errors import Refused
from afspm.basics.formatting import lengths_text, quantity
from afspm.basics.plain_data import Plain
from afspm.model import ControlResponse, Response, ScopeState, ScopeStatus, names
from afspm.model.microscope_status import STARTS, STOPS
from afspm.model.setting_order import widening_first
from afspm.translator.driver_base import LOST, Action, DriverBase
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.setters import apply
from afspm.translator.state import TranslatorState

_KEY: Final = "held_z"
_ENDED: Final = "held_z_ended"
_OFF, _HELD, _BACK, _FAILED = "off", "held", "back", "failed"
_RESTORED: Final = (names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)
"""The settings of the way back: all that decides where the feedback brings the tip, and how."""
_STEP_M: Final = 10e-12
"""Longest step of a ramp: a fifth of the decay of a tunnelling current, so that an abort comes in time."""
_READINGS: Final = 8
"""Readings of z whose mean is the height of the setpoint: a single one has the noise of the feedback."""
_BACK_M_PER_S: Final = 1e-9
"""Least speed away from the sample on the way back."""
_ALLOWED: Final = frozenset((*STARTS, *STARTS.values(), names.RETRACT, names.RELEASE_Z, names.FEEDBACK_MAY_BE_OFF))
"""The actions that a held z allows; others may move z, or switch the feedback."""


class HeldZ:
    """A height that is held without feedback, and the way back from it.

    Attributes:
        act: executes an action of the translator itself; set by the translator, as the next two.
        switched_on: called once the feedback is on again: the run wishes it so from now on.
        is_set: called with values that were set back, as read back.
    """

    def __init__(self, driver: DriverBase, state: TranslatorState, log: logging.Logger) -> None:
        self._driver, self._state, self._kept, self._log = driver, state, state.kept, log
        self._settings = driver.held_z
        if driver.held_z is not None:
            driver.held_z.kept_in(state.kept.setdefault("held_z_settings", {}))
            driver.held_z.moves, driver.held_z.is_held = self._aim, lambda: self.is_held
        self.act: Callable[[str], Response]
        self.switched_on: Callable[[], None]
        self.is_set: Callable[[Mapping[str, Value]], None]

    def actions(self) -> dict[str, Action]:
        """Return the two actions by name; empty where z can't be held."""
        needed = {names.TIP_Z, FEEDBACK_ON, names.TIP_BIAS_VOLTAGE}
        if self._settings is None or not needed <= self._driver.table.keys():
            return {}
        release = Action(names.RELEASE_Z, self.release, ScopeState.MOVING, while_busy=True, switches_feedback=True)
        return {names.HOLD_Z: Action(names.HOLD_Z, self.hold, switches_feedback=True), names.RELEASE_Z: release}

    # --- what others may know ---

    @property
    def is_held(self) -> bool:
        """Whether z is held, and not on its way back."""
        return self._phase == _HELD

    @property
    def is_ending(self) -> bool:
        """Whether the way back is not over."""
        return self._phase in (_OFF, _BACK, _FAILED)

    @property
    def next_s(self) -> float | None:
        """Experiment time of the next step; None if none is due."""
        found = self._found
        return None if found is None or self.status() is None else float(found["next_s"])

    def status(self) -> ScopeStatus | None:
        """Return the state of the microscope while z moves; None while it stands."""
        found = self._found
        if found is None or (found["phase"] == _HELD and found["at_m"] == found["offset_m"]):
            return None
        return ScopeStatus(ScopeState.MOVING)

    def refuse(self, action: str) -> None:
        """Refuse an action that a held z does not allow, and a measurement after a hold that has ended by itself.

        Raises:
            Refused: ACTION_ERROR.
        """
        if self._found is not None and action not in _ALLOWED:
            allowed = ", ".join(sorted(_ALLOWED))
            raise Refused(ControlResponse.ACTION_ERROR, f"{action}: z is held: leave that first; allowed: {allowed}")
        if action in STARTS and (why := self._kept.get(_ENDED)):
            raise Refused(ControlResponse.ACTION_ERROR, f"{action}: z is held no more: {why}")

    def refuse_setting(self, values: Mapping[str, Value]) -> None:
        """Refuse to switch the feedback while z is held, and a value meant for a hold that has ended by itself.

        A bias for a held tip, set after the way back, would let the feedback drive the tip into the sample.

        Raises:
            Refused: PARAM_ERROR.
        """
        if self._found is None and (why := self._kept.get(_ENDED)) and not values.keys().isdisjoint(_RESTORED):
            raise Refused(ControlResponse.PARAM_ERROR, f"{', '.join(values)}: z is held no more: {why}")
        if self._found is not None and FEEDBACK_ON in values:
            raise Refused(ControlResponse.PARAM_ERROR, f"{FEEDBACK_ON}: z is held: {names.RELEASE_Z} switches it on")

    def moves_aside(self) -> None:
        """Note that the tip may be elsewhere over the sample from now on."""
        if self._found is not None:
            self._found["moved"] = True

    # --- the two actions ---

    def hold(self) -> None:
        """Switch the feedback off, and hold z where it is.

        Raises:
            Refused: the feedback is off or can't be switched off, the tip is withdrawn, or it moved meanwhile.
            an error in `LOST`.
        """
        self._hold(is_asked=True)

    def through_zero(self, set_bias: Callable[[], dict[str, Value]]) -> dict[str, Value]:
        """Set a bias of the other sign while z is held, and return the values read back.

        Near 0 V a feedback that holds a current drives the tip into the sample.

        Raises:
            Refused: z can't be held, the bias is refused, or the feedback is not on again: the tip is then withdrawn.
            an error in `LOST`: the way back of a held z follows.
        """
        try:
            self._hold(is_asked=False)
            found = set_bias()
        except LOST:
            raise
        except Exception:  # raised again: `apply` has set the bias back; where a tip lift moved z, the feedback ends it
            hold = self._found
            if hold is not None and not hold.get("is_asked", True):
                self._break_off(hold)
            raise
        hold = self._kept[_KEY]
        hold["former"] |= {name: value for name, value in found.items() if name in hold["former"]}
        self._switch_on(hold)
        return found

    def _break_off(self, hold: Plain) -> None:
        # only at the bias of before does the feedback find the tip where it left it
        now = self._driver.in_force(hold["former"])
        off = [name for name, value in hold["former"].items() if not self._driver.same(name, now[name], value, now)]
        if off:
            self._fail(hold, f"{off[0]} reads {self._driver.table[off[0]].quantity(now[off[0]])}")
        else:
            self._switch_on(hold)

    def _switch_on(self, found: Plain) -> None:
        try:
            apply(self._driver, {FEEDBACK_ON: True})
        except LOST:
            raise
        except Exception as error:  # a driver may raise anything, and a tip without feedback must not be left so
            self._fail(found, str(error))
            raise Refused(
                ControlResponse.PARAM_ERROR, f"the feedback is off, with the tip withdrawn: {error}"
            ) from error
        self.switched_on()
        self._forget("")

    def _hold(self, *, is_asked: bool) -> None:
        # is_asked: the run knows of the hold, and asks for its end
        driver = self._driver
        self._refuse_hold()
        self._kept.pop(_ENDED, None)
        wanted = _RESTORED if is_asked else (*_RESTORED, names.SAMPLE_BIAS)
        restored = [name for name in wanted if name in driver.table and not driver.table[name].read_only]
        former = driver.in_force(restored)
        before_m = self._mean_z_m()
        now_s = driver.clock.now_s()
        self._kept[_KEY] = {
            "phase": _OFF, "z_m": before_m, "at_m": 0.0, "offset_m": 0.0, "former": former, "moved": False,
            "was_set": False, "next_s": now_s, "stepped_s": now_s, "why": "", "is_asked": is_asked,
        }  # fmt: skip
        self._state.save()  # before any change: a kill must not lose the way back
        try:
            apply(driver, {FEEDBACK_ON: False})
            held_m = self._mean_z_m()
            if abs(held_m - before_m) > self._near_m:
                by = lengths_text([held_m - before_m])
                why = f"z moved by {by} as the feedback was switched off, more than its reading differs by"
                raise Refused(ControlResponse.ACTION_ERROR, f"{why}: switch a tip lift of the controller off")
        except LOST:
            raise  # the outcome is unknown: the way back begins when the controller is reconnected
        except Exception as error:  # raised again: a driver may raise anything
            self.end(str(error))
            raise
        assert self._settings is not None
        self._settings.keep({names.HELD_Z_OFFSET: 0.0})
        self._kept[_KEY] |= {"phase": _HELD, "z_m": held_m}
        self._state.save()

    def _refuse_hold(self) -> None:
        driver, table = self._driver, self._driver.table
        why = ""
        if self._found is not None:
            why = "z is held already"
        elif not driver.in_force([FEEDBACK_ON])[FEEDBACK_ON]:
            why = "the z feedback is off: z is held at an offset from the height at which the feedback holds it"
        elif names.ENGAGED in table and not driver.in_force([names.ENGAGED])[names.ENGAGED]:
            why = "the tip is withdrawn: bring it to the sample first"
        for bound, shown in _BOUNDS.items():
            if self._bound(bound) and shown not in table:
                why = f"{bound} can't be kept: this microscope has no parameter {shown!r}"
        if why:
            raise Refused(ControlResponse.ACTION_ERROR, f"{names.HOLD_Z}: {why}")

    def release(self) -> None:
        """Begin the way back.

        Raises:
            Refused: NOT_FREE: it has begun by itself, or a measurement is running. ACTION_ERROR: it is over, with the
                reason; or z was not held.
        """
        if self.is_held and self._state.sequence.published.state not in (ScopeState.FREE, ScopeState.MOVING):
            raise Refused(ControlResponse.NOT_FREE, "a measurement is running: stop it first")
        if self.is_held:
            self.end("")
        elif self._found is not None:
            raise Refused(ControlResponse.NOT_FREE, "z is on its way back")
        else:
            why = self._kept.pop(_ENDED, "") or "it was not held"
            self._state.save()
            raise Refused(ControlResponse.ACTION_ERROR, f"z is held no more: {why}")

    def end(self, why: str) -> None:
        """Begin the way back, from any phase; without a hold nothing happens.

        Args:
            why: the reason, unless the run has asked for it.
        """
        found = self._found
        if found is None:
            return
        if why and not found["why"]:
            found["why"], found["moved"] = why, True  # others may have moved the tip, or time the surface
            self._log.warning("z is held no more: %s", why)
        if found["phase"] != _FAILED:
            found["phase"] = _BACK
        # the way back measures where the tip is: what was set last may not have been carried out
        found |= {"at_m": None, "next_s": self._driver.clock.now_s()}
        self._state.save()

    # --- each look ---

    def step(self) -> None:
        """Watch a held z, and take the next step of a ramp or of the way back, if it is due.

        Raises:
            an error in `LOST`.
        """
        found = self._found
        if found is None:
            return
        try:
            if found["phase"] == _HELD:
                self._watched(found)
            elif found["phase"] == _FAILED:
                self._withdraw(found)
            elif self._driver.clock.now_s() >= found["next_s"]:
                self._go_back(found)
        except LOST:
            raise
        except Exception as error:  # a driver may raise anything, and a tip without feedback must not be left so
            self._fail(found, str(error))

    def _watched(self, found: Plain) -> None:
        try:
            self._watch(found)
        except LOST:
            raise
        except Exception as error:  # a driver may raise anything; what can't be watched is held no longer
            self._abort(str(error))

    def _watch(self, found: Plain) -> None:
        if self._is_over(found):
            return
        for bound, shown in _BOUNDS.items():
            if most := self._bound(bound):
                value = abs(float(self._driver.in_force([shown])[shown]))
                if value > most:
                    unit = names.OF_HELD_Z[bound]
                    self._abort(f"{shown} was {quantity(value, unit)}, beyond the bound of {quantity(most, unit)}")
                    return
        if found["at_m"] == found["offset_m"] or self._driver.clock.now_s() < found["next_s"]:
            return
        assert self._settings is not None
        speed = self._settings.number(names.HELD_Z_SPEED)
        offset_m = self._step(found, found["at_m"], found["offset_m"], speed)
        found |= {"at_m": offset_m, "was_set": True}
        self._state.save()  # before the step: a kill must not lose that the tip may be there
        if off := self._set_z(found["z_m"] + offset_m):
            self._abort(off)

    def _abort(self, why: str) -> None:
        stop = STOPS.get(self._state.sequence.published.state)
        if stop is not None:
            self.act(stop)
        self.end(why)

    def _is_over(self, found: Plain) -> bool:
        # a person has ended it, or a process that was killed right after its last step
        table = self._driver.table
        shown = self._driver.in_force([name for name in (FEEDBACK_ON, names.ENGAGED) if name in table])
        is_away = shown.get(names.ENGAGED) is False
        if not (is_away or shown[FEEDBACK_ON]):
            return False
        by_hand = "the tip was withdrawn" if is_away else "the feedback was switched on beside it"
        why = by_hand if is_away or found["phase"] == _HELD else found["why"]
        if left := self._set_back(found["former"]):
            why = f"{why or by_hand}; {left}"
            self._log.critical("z is held no more: %s", why)
        if not is_away:
            self.switched_on()
        self._forget(why)
        return True

    def _step(self, found: Plain, at_m: float, to_m: float, speed_m_s: float) -> float:
        # one step towards a height, no faster than the speed
        now_s = self._driver.clock.now_s()
        longest_m: float = min(_STEP_M, max(0.0, now_s - found["stepped_s"]) * speed_m_s)
        found |= {"stepped_s": now_s, "next_s": now_s + _STEP_M / speed_m_s}
        if abs(to_m - at_m) <= longest_m:
            return to_m
        return at_m + (longest_m if to_m > at_m else -longest_m)

    def _set_z(self, z_m: float) -> str:
        # empty if z reads as it was set
        self._driver.move_z(z_m)
        read_m = self._z_m()
        if abs(read_m - z_m) <= self._near_m:
            return ""
        return f"z was set to {lengths_text([z_m])} and reads {lengths_text([read_m])}"

    # --- the way back ---

    def _go_back(self, found: Plain) -> None:
        if self._is_over(found):
            return
        to_m, at_m = found["z_m"], found["at_m"]
        if at_m is None:
            at_m = found["at_m"] = self._z_m()
        # where the tip has moved over the sample, the surface may be higher: the feedback itself brings it down
        if at_m > to_m and found["moved"]:
            to_m = at_m
        if found["was_set"] and at_m != to_m:
            assert self._settings is not None
            speed = self._settings.number(names.HELD_Z_SPEED)
            speed = max(speed, _BACK_M_PER_S) if to_m > at_m else speed
            found["at_m"] = self._step(found, at_m, to_m, speed)
            if off := self._set_z(found["at_m"]):
                self._fail(found, off)
            return
        if left := self._set_back(found["former"]):
            self._fail(found, left)
            return
        apply(self._driver, {FEEDBACK_ON: True})
        self.switched_on()
        self._forget(found["why"])

    def _set_back(self, former: Mapping[str, Value]) -> str:
        # one after the other, each read back; return why one is not as before
        driver, row = self._driver, self._driver.table.get(names.ZCTRL_SETPOINT)
        holds_current = row is not None and row.si_unit == "A"
        name = next(iter(former), "")
        try:
            for name in widening_first(driver.in_force(former), former) if holds_current else former:
                now = driver.in_force([name])
                if not driver.same(name, now[name], former[name], now):
                    self.is_set(apply(driver, {name: former[name]}))
        except LOST:
            raise
        except Exception as error:  # a driver may raise anything
            return f"{name} is not set back to {driver.table[name].quantity(former[name])}: {error}"
        return ""

    def _fail(self, found: Plain, why: str) -> None:
        former = ", ".join(
            f"{name} {self._driver.table[name].quantity(value)}" for name, value in found["former"].items()
        )
        found["why"] = f"the way back from a held z failed: {why}; as before it: {former}"
        found["phase"] = _FAILED
        self._state.save()
        self._log.critical("%s; the feedback stays off, and the tip is withdrawn", found["why"])
        self._withdraw(found)

    def _withdraw(self, found: Plain) -> None:
        response = self.act(names.RETRACT)
        if not response.ok:
            why = response.reason or str(response.code)
            self._log.critical("the tip can't be withdrawn, and has no feedback: %s; do it by hand", why)
        left = self._set_back(found["former"])
        self._forget(f"{found['why']}; {left}" if left else found["why"])

    # --- within ---

    def _aim(self, offset_m: float) -> None:
        found = self._found
        if found is not None and found["phase"] == _HELD:
            now_s = self._driver.clock.now_s()
            found |= {"offset_m": offset_m, "stepped_s": now_s, "next_s": now_s}
            self._state.save()
        elif found is not None or self._kept.get(_ENDED):
            why = self._kept.get(_ENDED) or (found or {}).get("why") or "z is on its way back"
            raise Refused(ControlResponse.PARAM_ERROR, f"{names.HELD_Z_OFFSET}: z is held no more: {why}")

    def _bound(self, name: str) -> float:
        return 0.0 if self._settings is None else self._settings.number(name)

    def _z_m(self) -> float:
        return float(self._driver.in_force([names.TIP_Z])[names.TIP_Z])

    def _mean_z_m(self) -> float:
        return math.fsum(self._z_m() for _ in range(_READINGS)) / _READINGS

    @property
    def _near_m(self) -> float:
        return self._driver.table[names.TIP_Z].resolution

    @property
    def _found(self) -> Plain | None:
        found: Plain | None = self._kept.get(_KEY)
        return found

    @property
    def _phase(self) -> str:
        return "" if self._found is None else str(self._found["phase"])

    def _forget(self, why: str) -> None:
        found = self._kept.pop(_KEY, None) or {}
        if why and found.get("is_asked", True):
            self._kept[_ENDED] = why
        self._state.save()


_BOUNDS: Final = {
    names.HELD_Z_ABORT_CURRENT: names.CURRENT,
    names.HELD_Z_ABORT_SHIFT: names.FREQUENCY_SHIFT,
}
"""The parameter that each bound is compared with."""
