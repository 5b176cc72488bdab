"""`PanelWatch`: acts at the microscope that no request of the run has caused. Pure.

| whose doing | when |
| --- | --- |
| asked by the run | a request of this run caused it |
| by hand | seen while the controller answered all the time, and no request was in flight or of unknown outcome |
| unknown | everything else: after a restart or a lost controller, or a scan that ended by itself |

The client repeats an unknown one within bounds, as after a fault. So an act counts as done by hand only if two
successive readings of the controller differ, the microscope was free or scanning at both, and no request and no
restored setting of the run lies between them. For the tip, a start of a measurement may lie between them.

During a spectrum the controller itself changes the bias, and may hold the feedback. So a reading of after a spectrum is
compared with the last one of before it, once two readings in a row show the microscope at rest or scanning again: by
then the controller has put back what it changed. A request in between makes the settings uncertain, but not the
feedback, which no request but its own switches off.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Final

from afspm.model import ActByHand, ChangedValue, PanelAct, ScopeState, TipStatus, names
from afspm.model.microscope_status import STARTS
from afspm.translator.parameters import FEEDBACK_ON, ParameterTable, Value
from afspm.translator.setting_groups import FRAME, POSITION
from afspm.translator.state import Kept

_CALM: Final = frozenset({ScopeState.FREE, ScopeState.SCANNING})
"""States in which the controller itself changes neither settings nor the feedback."""
_STILL: Final = _CALM | {ScopeState.SPEC}
"""States in which the controller does not move the tip away in the course of its work."""
_STARTED: Final = {names.START_SCAN: ScopeState.FREE, names.START_SPEC: ScopeState.SPEC}
"""The state from which the tip is watched after a start: spectra may switch the feedback off."""
_SETTINGS: Final = frozenset(FRAME) | {
    names.ZCTRL_SETPOINT,
    names.ZCTRL_PGAIN,
    names.ZCTRL_IGAIN,
    names.TIP_BIAS_VOLTAGE,
    names.SCAN_SPEED,
}
EXTRA: Final = (names.TIP_BIAS_VOLTAGE, names.SCAN_SPEED)
"""Settings that are read for the watch alone: no message publishes them."""
_NOT_ASKED: Final = "and no request of the run caused it"


class PanelWatch:
    """A watch over successive readings of the controller.

    Args:
        kept: JSON values that outlive a kill: what a person did to the tip that keeps afspm from measuring.
        written: returns whether the run itself has set a parameter to this value last.

    Attributes:
        is_certain: whether a change of state now is certainly no effect of the run: the controller has answered all the
            time since the microscope was published as free. Set by the observer.
        tip: the tip and its feedback at the last reading.
    """

    def __init__(self, kept: Kept, table: ParameterTable, written: Callable[[str, Value], bool]) -> None:
        self._kept = kept
        self._table = table
        self._written = written
        self._settings = _SETTINGS | set(table.watched)
        self._last: ScopeState | None = None
        self._still: ScopeState | None = None
        self._tip_is_moved = False
        self._before_spectrum: dict[str, Value] = {}
        self._by_hand: dict[str, Value] = {}
        self.is_certain = False
        self.tip = TipStatus(by_hand=kept.get("tip_by_hand", ""))

    @property
    def was_engaged(self) -> bool:
        """Whether the tip was at the sample at any reading of this run."""
        return bool(self._kept.get("was_engaged"))

    def asked(self, action: str = "", *, sets: Collection[str] | None = None, sets_feedback: bool = False) -> None:
        """Note that the run changes something: what the next reading shows may be its doing.

        Args:
            action: the action that it asks for, if it asks for one. Its effect on the tip may show later, but not after
                a measurement has begun.
            sets: the settings that it sets; None: not known.
            sets_feedback: whether it switches the z feedback.
        """
        # the tip is looked at right before each start
        self._last, self._still = None, _STARTED.get(action)
        if action in STARTS:
            self._tip_is_moved = False
        elif action and action not in STARTS.values():
            self._tip_is_moved = True
        if action not in STARTS:  # a start sets nothing
            kept = set() if sets is None else self._by_hand.keys() - set(sets)
            self._by_hand = {name: self._by_hand[name] for name in kept}
        if action != names.START_SPEC:
            stays = FEEDBACK_ON in self._before_spectrum and not (self._tip_is_moved or sets_feedback)
            self._before_spectrum = {FEEDBACK_ON: self._before_spectrum[FEEDBACK_ON]} if stays else {}

    def lost(self) -> None:
        """Note a restart or a lost controller: until the microscope is free, nothing is certain."""
        self._last, self._still, self.is_certain = None, None, False
        self._before_spectrum, self._by_hand = {}, {}

    def read(
        self, before: Mapping[str, Value], now: Mapping[str, Value], state: ScopeState, now_ns: int, withdrew: str = ""
    ) -> list[ActByHand]:
        """Compare two successive readings, and return what was done by hand between them.

        Args:
            state: the state of the controller at the second reading.
            withdrew: why the controller itself may have withdrawn the tip; empty: it has not.
        """
        last, self._last = self._last, state
        still, self._still = self._still, state if state in _STILL else self._still
        acts = []
        if state is ScopeState.SPEC:
            self._before_spectrum = {**before, **self._before_spectrum}
        is_calm = still in _CALM and state in _CALM
        is_after_spectrum = is_calm and bool(self._before_spectrum)
        if is_calm:
            before, self._before_spectrum = {**before, **self._before_spectrum}, {}
        # a withdrawal takes time, and the controller may show it as a state of its own until it is over
        if still is not None and not withdrew:
            act = self._tip_act(before, now, now_ns, is_calm=is_calm)
            acts += [] if act is None else [act]
        # a running scan moves the tip, and a spectrum may
        watched = self._settings
        if state is not ScopeState.SCANNING and not is_after_spectrum:
            watched = watched | set(POSITION)
        if last in _CALM and state in _CALM and (changes := self._changes(before, now, watched)):
            acts.append(ActByHand(now_ns, PanelAct.VALUES, changes=tuple(changes.values())))
            self._by_hand |= {name: now[name] for name in changes if name in self._settings}
        self._see_tip(now)
        return acts

    def _tip_act(
        self, before: Mapping[str, Value], now: Mapping[str, Value], now_ns: int, *, is_calm: bool
    ) -> ActByHand | None:
        if self._tip_is_moved:
            return None
        if before.get(names.ENGAGED) is True and now.get(names.ENGAGED) is False:
            act = ActByHand(now_ns, PanelAct.WITHDRAW, f"the controller reports it, {_NOT_ASKED}")
        elif is_calm and before.get(FEEDBACK_ON) is True and _off_at_the_sample(now):
            act = ActByHand(now_ns, PanelAct.FEEDBACK_OFF, f"the controller reports it, {_NOT_ASKED}")
        else:
            return None
        self._kept["tip_by_hand"] = str(act)
        return act

    def _see_tip(self, now: Mapping[str, Value]) -> None:
        engaged, on = now.get(names.ENGAGED), now.get(FEEDBACK_ON)
        if engaged:
            self._kept["was_engaged"] = True
        if engaged is not False and on is not False:
            self._kept["tip_by_hand"] = ""
        by_hand = str(self._kept.get("tip_by_hand") or "")
        self.tip = TipStatus(None if engaged is None else bool(engaged), None if on is None else bool(on), by_hand)

    def _changes(
        self, before: Mapping[str, Value], now: Mapping[str, Value], watched: Collection[str]
    ) -> dict[str, ChangedValue]:
        return {
            name: self._change(name, before[name], value)
            for name, value in now.items()
            if name in watched and name in before and before[name] != value and not self._is_by_run(name, before, value)
        }

    def _is_by_run(self, name: str, before: Mapping[str, Value], now: Value) -> bool:
        # the effect of a request may show late, but not after a person has changed the same setting
        return self._written(name, now) and self._by_hand.get(name) != before[name]

    def _change(self, name: str, before: Value, after: Value) -> ChangedValue:
        (old, unit), (new, _) = (self._table[name].for_peer(value) for value in (before, after))
        return ChangedValue(name, old, new, unit)


def _off_at_the_sample(values: Mapping[str, Value]) -> bool:
    # a withdrawal switches the feedback off as well, which is no act of its own
    return values.get(FEEDBACK_ON) is False and values.get(names.ENGAGED) is not False
