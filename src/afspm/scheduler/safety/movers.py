"""Movers: stages and coarse motors, which move only under a tip that is far enough from the sample.

| request | needs |
| --- | --- |
| any move | a tip that the microscope shows as withdrawn (a rule of `forbid` for each mover) |
| a lateral move | besides, `retraction` steps away since the tip was last at the sample, or a person's word |
| a measurement | an approach after the last move; the tip read at the sample twice, the current near its setpoint |

The two readings are `PROVED_AFTER_S` apart. A request counts from the moment at which it is sent. With an unknown
outcome, a move counts as made, and steps away do not.

No controller shows its motor. So steps away and a person's word end wherever others may have used it
(`MoverState.unknown`): with MANUAL (its begin and its end), an act by hand, a motor that moves without a request of the
run, a lost contact, and a restart of translator or scheduler. A lost contact and a restart, in which nothing is read,
end the proof, too. The ways, and the approach that is needed, stay; a way then means "at least".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from afspm.basics.formatting import quantity
from afspm.basics.frozen import replace, without
from afspm.model import Parameter, ResponseDetail, names

Direction = Literal["lateral", "away"]
PROVED_AFTER_S: Final = 1.0
"""Experiment time between the two readings: a step of the motor couples into the current for a moment."""
MEASURES: Final = frozenset({names.START_SCAN, names.START_SPEC, *names.TREATMENTS, names.HOLD_Z})
SIGNAL: Final = (names.ENGAGED, names.CURRENT, names.ZCTRL_SETPOINT)
"""The values of each reading of the tip; a microscope may lack the current."""
_NEAR: Final = (0.5, 2.0)  # of the setpoint


@dataclass(frozen=True)
class Mover:
    """A parameter of an instrument, or an action of the microscope, that moves the sample and the tip apart or along.

    Attributes:
        direction: along the sample ("lateral"), or away from it; towards it, an approach alone brings the tip.
        total: the longest way in a run: in steps for an action, and in the unit of a parameter.
        steps: the steps of one action; None for a parameter.
        unit: of `total`.
        source: the place in the experiment file.
    """

    direction: Direction
    total: float
    steps: int | None = None
    unit: str = ""
    source: str = "[limits.movers]"

    def way_text(self, way: float) -> str:
        return f"{way:g} steps" if self.steps is not None else quantity(way, self.unit, 6)


@dataclass(frozen=True)
class MoverSettings:
    """The movers by the name of their parameter or action.

    Attributes:
        retraction: the steps away from the sample that a lateral move needs.
        approach: the action that brings the tip back after a move.
        undeclared: actions of the microscope that move its coarse motor, and are no movers.
        source: the place of `retraction` in the experiment file.
    """

    movers: Mapping[str, Mover] = field(default_factory=dict)
    retraction: int = 0
    approach: str = names.ENGAGE
    undeclared: tuple[str, ...] = ()
    source: str = "[limits.movers]"


@dataclass(frozen=True)
class MoverState:
    """The moves since the tip was last proved at the sample. A run begins without a proof.

    Attributes:
        ways: the way of each mover in this run, in steps or in its unit.
        pending: steps away that are not answered yet, by request.
        answered: steps away that are answered; they are made once the microscope is free.
        retracted: steps away that were made since the tip was last at the sample.
        is_moving: whether a request that uses the motor was sent since the microscope was last free.
        is_unknown: whether others may have used the motor since the tip was last seen at the sample.
        cleared_by: the client through which a person has stated that the tip is far enough for a lateral move.
        cleared_s: the real monotonic time of that statement.
        is_unproved: whether the tip was not proved at the sample since a move, an approach by the motor, or the begin.
        needs_approach: whether something was moved, and no approach has begun since.
        at_sample_ns: the experiment time of the first of the readings that show the tip at the sample.
    """

    ways: Mapping[str, float] = field(default_factory=dict)
    pending: Mapping[str, int] = field(default_factory=dict)
    answered: int = 0
    retracted: int = 0
    is_moving: bool = False
    is_unknown: bool = False
    cleared_by: str = ""
    cleared_s: float = 0.0
    is_unproved: bool = False
    needs_approach: bool = False
    at_sample_ns: int | None = None

    def refusal(self, settings: MoverSettings, name: str, way: float) -> tuple[str, ResponseDetail]:
        """Return why a mover may not go this way, and a detail for programs; empty: it may, if the tip is withdrawn."""
        mover = settings.movers[name]
        gone = self.ways.get(name, 0.0)
        if gone + way > mover.total * (1 + 1e-9):
            so_far, most = mover.way_text(gone), mover.way_text(mover.total)
            why = f"{name} would go {mover.way_text(way)} after {so_far}, and at most {most} in a run ({mover.source})"
            return why, ResponseDetail.NONE
        if mover.direction == "lateral" and not self.cleared_by and self.retracted < settings.retraction:
            others = "others may have moved it (MANUAL, a lost contact, a restart)"
            since = others if self.is_unknown else "its last approach"
            steps = f"{self.retracted} of {settings.retraction} steps away from the sample ({settings.source})"
            why = (
                f"{name} moves the sample along, and since {since} the tip has gone {steps}: first retract it"
                f" with the coarse motor ({_named(settings)}), or let a person say that it is clear:"
                " afspm continue --tip-is-clear"
            )
            return why, ResponseDetail.STEP_AWAY_AGAIN if self.is_unknown else ResponseDetail.NONE
        return "", ResponseDetail.NONE

    def sent(self, settings: MoverSettings, name: str, way: float, request: str, *, is_repeated: bool) -> MoverState:
        """Count a move that is sent. A repeated one may be answered from memory, so its steps away do not count."""
        state = replace(self, is_moving=True, is_unproved=True, needs_approach=True, at_sample_ns=None)
        if is_repeated:
            return state
        is_away = settings.movers[name].direction == "away"
        pending = {**self.pending, request: int(way)} if is_away else self.pending
        return replace(state._with_way(name, way), pending=pending)

    def done(self, request: str) -> MoverState:
        """Take the answer that a move was made, or has begun."""
        made = self.pending.get(request, 0)
        return replace(self, pending=without(self.pending, request), answered=self.answered + made)

    def undone(self, name: str, way: float, request: str) -> MoverState:
        """Take back a request that was certainly not carried out. An approach is still needed."""
        return replace(self._with_way(name, -way), pending=without(self.pending, request))

    def free(self) -> MoverState:
        """Count the answered steps away: the microscope is free."""
        return replace(self, retracted=self.retracted + self.answered, answered=0, is_moving=False)

    def interrupted(self) -> MoverState:
        """Forget the answered steps away: the microscope has not made them all."""
        return replace(self, answered=0)

    def near(self) -> MoverState:
        """Forget how far the tip was: it comes to the sample, is there, or moves as nothing here knows."""
        return replace(self, pending={}, answered=0, retracted=0, is_unknown=False, cleared_by="")

    def unknown(self, *, engaged: bool | None, unseen: bool, by: str = "") -> MoverState:
        """Forget the steps away, and the proof if the tip may have been away: others may have used the motor.

        Args:
            engaged: whether the tip was last shown at the sample; shown away, it is unproved anyway once it is back.
            unseen: whether the tip may have left the sample and come back without a reading in between.
            by: who ends MANUAL; a word of the same client counts for what follows.
        """
        word = self.cleared_by if self.cleared_by == by else ""
        state = replace(self.near(), is_unknown=engaged is not True, cleared_by=word, at_sample_ns=None)
        return replace(state, is_unproved=self.is_unproved or (engaged is not False and unseen))

    def withdrawn(self) -> MoverState:
        """Forget the steps away, since a withdrawal may end them."""
        return replace(self, pending={}, answered=0, retracted=0, is_moving=True)

    def motor_moves(self, *, engaged: bool | None) -> MoverState:
        """Take in that the motor moves; without a request of the run, others use it. See `unknown` for `engaged`."""
        return self if self.is_moving else self.unknown(engaged=engaged, unseen=engaged is None)

    def approaching(self, settings: MoverSettings, action: str) -> MoverState:
        """Take in that an action is sent that brings the tip to the sample."""
        if action != settings.approach:
            return replace(self.near(), is_moving=True, at_sample_ns=None)
        return replace(self.near(), is_moving=True, is_unproved=True, needs_approach=False, at_sample_ns=None)

    def at_sample(self, *, is_back: bool, by_hand: bool) -> MoverState:
        """Take in that the tip is shown at the sample; `is_back`: it was away before."""
        is_needed = self.needs_approach and not by_hand
        return replace(self.near(), is_unproved=self.is_unproved or is_back, needs_approach=is_needed)

    def moved_by_others(self) -> MoverState:
        return replace(self, is_unproved=True, needs_approach=True, at_sample_ns=None)

    def read(self, values: Mapping[str, Parameter | None], now_ns: int) -> MoverState:
        """Take in `SIGNAL` as read for a decision; a second reading at the sample proves the tip there."""
        if not is_on(values.get(names.ENGAGED)):
            return replace(self, at_sample_ns=None)
        state = self.near()
        if not self.is_unproved or self.needs_approach or not _has_signal(values):
            return replace(state, at_sample_ns=None)
        if self.at_sample_ns is None:
            return replace(state, at_sample_ns=now_ns)
        if now_ns - self.at_sample_ns >= PROVED_AFTER_S * 1e9:
            return replace(state, is_unproved=False, at_sample_ns=None)
        return state

    def refuses_to_measure(self, settings: MoverSettings) -> tuple[str, int | None]:
        """Return why nothing may be measured now, and the time at which it may be tried again; empty: it may."""
        if not self.is_unproved:
            return "", None
        if self.needs_approach:
            return (
                f"the coarse motor or a stage has moved since the last approach: approach ({settings.approach})",
                None,
            )
        if self.at_sample_ns is None:
            why = f"the tip does not read at the sample ({names.ENGAGED}, with the current near its setpoint)"
            return f"{why}: approach ({settings.approach})", None
        again_ns = self.at_sample_ns + math.ceil(PROVED_AFTER_S * 1e9)
        return f"the tip reads at the sample for less than {PROVED_AFTER_S:g} s: a second reading is awaited", again_ns

    def _with_way(self, name: str, way: float) -> MoverState:
        return replace(self, ways={**self.ways, name: self.ways.get(name, 0.0) + way})


def is_on(shown: Parameter | None) -> bool:
    return shown is not None and (shown.value or "").lower() in names.ON_WORDS


def _has_signal(values: Mapping[str, Parameter | None]) -> bool:
    current, setpoint = (values.get(name) for name in (names.CURRENT, names.ZCTRL_SETPOINT))
    if current is None or setpoint is None or setpoint.unit != "A":
        return True  # a feedback on another signal, or a microscope that does not show its current
    current_a, setpoint_a = _amperes(current), _amperes(setpoint)
    if current_a is None or not setpoint_a:
        return False
    return _NEAR[0] <= abs(current_a / setpoint_a) <= _NEAR[1]


def _amperes(shown: Parameter) -> float | None:
    try:
        return float(shown.value or "") if shown.unit == "A" else None
    except ValueError:
        return None


def _named(settings: MoverSettings) -> str:
    return ", ".join(sorted(name for name, one in settings.movers.items() if one.direction == "away")) or "by hand"
