"""`PanelWatch`: acts at the microscope that no request of the run has caused. Pure.

| whose doing | when |
| --- | --- |
| asked by the run | a request of this run caused it |
| by hand | seen while the controller answered all the time, and no request was in flight or of unknown outcome |
| unknown | everything else: after a restart or a lost controller, or a scan that ended by itself |

The client repeats an unknown one within bounds, as after a fault. So an act counts as done by hand only if two
successive readings of the controller differ, the microscope was free or scanning at both, and no request and no
restored setting of the run lies between them. For the tip, a start of a measurement may lie between them. The feedback
is compared with what the run wishes (`WishedFeedback`), at every reading.

During a spectrum the controller itself changes the bias. So a reading of after a spectrum is compared with the last one
of before it, once two readings in a row show the microscope at rest or scanning again: by then the controller has put
back what it changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Final

from afspm.basics.clock import NS_PER_S
from afspm.model import ActByHand, PanelAct, ScopeState, TipStatus, names
from afspm.model.microscope_status import STARTS
from afspm.model.panel import ChangedValue
from afspm.translator.judge import SETTINGS
from afspm.translator.parameters import FEEDBACK_ON, ParameterTable, Value
from afspm.translator.setting_groups import FRAME, POSITION
from afspm.translator.state import KeptState
from afspm.translator.wished_feedback import CALM, SINCE_BEFORE, FeedbackLevel, WishedFeedback

_STILL: Final = CALM | {ScopeState.SPEC}
"""States in which the controller does not move the tip away in the course of its work."""
_STARTED: Final = {names.START_SCAN: ScopeState.FREE, names.START_SPEC: ScopeState.SPEC}
"""The state from which the tip is watched after a start: spectra may switch the feedback off."""
_SETTINGS: Final = frozenset((*FRAME, *SETTINGS))
EXTRA: Final = (names.TIP_BIAS_VOLTAGE, names.SCAN_SPEED)
"""Settings that are read for the watch alone: no message publishes them."""
_IN_REQUEST: Final = "in the middle of a request that sets it"
_SET_AGAIN: Final = "set again by the request in which a person acted"
_NOT_ASKED: Final = "and no request of the run caused it"


class PanelWatch:
    """A watch over successive readings of the controller.

    Args:
        kept: JSON values that outlive a kill: what a person did to the tip that keeps afspm from measuring.
        written: returns whether the run itself has set a parameter to this value last.
        feedback: the z feedback as wished.
        leaves_tip_s: experiment seconds after a scan in which a controller may show where the scan has left the tip.

    Attributes:
        is_certain: whether a change of state now is certainly no effect of the run: the controller has answered all the
            time since the microscope was published as free. Set by the observer.
        tip: the tip and its feedback at the last reading.
    """

    def __init__(
        self,
        kept: KeptState,
        table: ParameterTable,
        written: Callable[[str, Value], bool],
        feedback: WishedFeedback,
        leaves_tip_s: float = 0.0,
    ) -> None:
        self.feedback = feedback
        self._leaves_tip_s = leaves_tip_s
        self._scanned_ns: float = -math.inf
        self._kept = kept
        self._table = table
        self._written = written
        self._settings = _SETTINGS | set(table.watched)
        self._last: ScopeState | None = None
        self._still: ScopeState | None = None
        self._tip_is_moved = bool(kept.get("tip_is_moved"))
        self._is_lost = False
        self._before_spectrum: dict[str, Value] = {}
        self._by_hand: dict[str, Value] = {}
        self._in_request: list[tuple[tuple[ChangedValue, ...], str]] = []
        self.is_certain = False
        # a withdrawal while no translator ran is seen at the first reading
        self._was_left_at_sample = kept.get("engaged") is True and not kept.get("tip_is_moved")
        self.tip = TipStatus(by_hand=kept.get("tip_by_hand", ""))

    @property
    def was_engaged(self) -> bool:
        """Whether the tip was at the sample at any reading of this run."""
        return bool(self._kept.get("was_engaged"))

    @property
    def is_withdrawn_by_run(self) -> bool:
        """Whether an action of this run since its last measurement may have withdrawn the tip."""
        return self._tip_is_moved

    def asked(self, action: str = "", *, sets: Collection[str] | None = None) -> None:
        """Note that the run changes something: what the next reading shows may be its doing.

        Args:
            action: the action that it asks for, if it asks for one. Its effect on the tip may show later, but not after
                a measurement has begun.
            sets: the settings that it sets; None: not known.
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
            self._before_spectrum = {}

    def seen_in_request(self, before: Mapping[str, Value], after: Mapping[str, Value]) -> None:
        """Note a change of values in the middle of a request that sets them: the next reading reports it."""
        watched = [name for name in after if name in self._settings or name in POSITION]
        changes = tuple(self._change(name, before[name], after[name]) for name in watched)
        is_set_again = all(self._written(name, after[name]) for name in watched)
        if changes:
            self._in_request.append((changes, _SET_AGAIN if is_set_again else _IN_REQUEST))

    def may_be_off(self) -> None:
        """Note that a person says that the z feedback is off by intention."""
        self.feedback.may_be_off()
        self._kept["tip_by_hand"] = ""
        self.tip = replace(self.tip, by_hand="")

    def lost(self) -> None:
        """Note a restart or a lost controller: until the microscope is free, nothing is certain."""
        self._last, self._still, self.is_certain, self._is_lost = None, None, False, True
        self._before_spectrum, self._by_hand = {}, {}
        self.feedback.lost()

    def swept(self, now: Mapping[str, Value]) -> list[str]:
        """Return the settings that a reading in a spectrum shows otherwise than before it; empty after its end."""
        return [name for name, value in self._before_spectrum.items() if now.get(name, value) != value]

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
        is_calm = still in CALM and state in CALM
        is_after_spectrum = is_calm and bool(self._before_spectrum)
        if is_calm:
            before, self._before_spectrum = {**before, **self._before_spectrum}, {}
        # a withdrawal takes time, and the controller may show it as a state of its own until it is over
        was_engaged = (before.get(names.ENGAGED) is True and not self._is_lost) or self._was_left_at_sample
        self._was_left_at_sample = self._is_lost = False
        if was_engaged and now.get(names.ENGAGED) is False and not withdrew and not self._tip_is_moved:
            acts.append(self._tip_act(PanelAct.WITHDRAW, now_ns))
        acts += self._feedback_acts(now, state, now_ns, withdrew)
        in_request, self._in_request = self._in_request, []
        acts += [ActByHand(now_ns, PanelAct.VALUES, why, changes) for changes, why in in_request]
        # a scan moves the tip and leaves it elsewhere, and a spectrum may; a translator that begins in a scan reads it
        # on its way
        watched = self._settings
        if ScopeState.SCANNING in (last, state):
            self._scanned_ns = now_ns
        if now_ns - self._scanned_ns > NS_PER_S * self._leaves_tip_s and not is_after_spectrum:
            watched = watched | set(POSITION)
        if last in CALM and state in CALM and (changes := self._changes(before, now, watched)):
            acts.append(ActByHand(now_ns, PanelAct.VALUES, changes=tuple(changes.values())))
            self._by_hand |= {name: now[name] for name in changes if name in self._settings}
        is_held = state is ScopeState.SPEC or self.feedback.level is FeedbackLevel.HELD
        self._see_tip({**now, FEEDBACK_ON: True} if is_held and self.feedback.wished and FEEDBACK_ON in now else now)
        return acts

    def _feedback_acts(
        self, now: Mapping[str, Value], state: ScopeState, now_ns: int, withdrew: str
    ) -> list[ActByHand]:
        engaged, on = now.get(names.ENGAGED), now.get(FEEDBACK_ON)
        level = self.feedback.read(_known(engaged), _known(on), state, now_ns / NS_PER_S)
        if level is FeedbackLevel.OFF and self.feedback.wished is None:
            self._kept["tip_by_hand"] = SINCE_BEFORE
        is_reported = bool(self._kept.get("tip_by_hand"))
        if level is not FeedbackLevel.BY_HAND or withdrew or is_reported:
            return []
        return [self._tip_act(PanelAct.FEEDBACK_OFF, now_ns, self.feedback.hint)]

    def _tip_act(self, what: PanelAct, now_ns: int, hint: str = "") -> ActByHand:
        act = ActByHand(now_ns, what, f"the controller reports it, {_NOT_ASKED}{hint}")
        self._kept["tip_by_hand"] = str(act)
        return act

    def _see_tip(self, now: Mapping[str, Value]) -> None:
        engaged, on = _known(now.get(names.ENGAGED)), _known(now.get(FEEDBACK_ON))
        self._kept |= {"engaged": engaged, "tip_is_moved": self._tip_is_moved}
        if engaged:
            self._kept["was_engaged"] = True
        if engaged is not False and on is not False:
            self._kept["tip_by_hand"] = ""
        by_hand = str(self._kept.get("tip_by_hand") or "")
        self.tip = TipStatus(engaged, on, by_hand)

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


def _known(value: Value | None) -> bool | None:
    return None if value is None else bool(value)
