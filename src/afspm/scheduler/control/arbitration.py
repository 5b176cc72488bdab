"""The arbitration table: the rules for control of the microscope, as data, and the functions that apply them.

Each event has rows. The first row whose condition holds applies; the last row of an event always applies. Only a row
changes the holder of control, the mode or the flagged problems.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from types import MappingProxyType
from typing import ClassVar

from afspm.basics.frozen import replace
from afspm.basics.plain_data import SECTION
from afspm.model import (
    STOPPED_BY_AGENT,
    ControlMode,
    ControlResponse,
    ControlState,
    Problem,
    ProblemNames,
    component_of,
)
from afspm.model.problems import QUIET_HOURS

_NO_PROBLEMS: Mapping[int, str] = MappingProxyType({})


class ArbitrationEvent(Enum):
    """An event that may change control: a request, or the death, idleness or revoked approval of a component."""

    REQUEST_CONTROL = "asks for control"
    RELEASE_CONTROL = "gives control back"
    FLAG = "flags a problem"
    CLEAR = "removes a flag"
    SET_MODE = "sets the mode"
    END = "ends the experiment"
    COMMAND = "commands the microscope"
    ADJUST = "sets a parameter of [control] adjustable"
    FEEDBACK_OFF = "says that the feedback is off by intention, or that the tip is clear"
    READ = "asks the microscope for a value"
    DEAD = "is dead"
    IDLE = "has let its lease run out"
    REVOKED = "has lost its approval"
    BY_HAND = "reports an act at the microscope"


class ControlChange(Enum):
    """A change of the control state, made by a row of the table."""

    GRANT = auto()
    """Control goes to the client, to solve the problem in its request (or none)."""
    TAKE = auto()
    """The holder loses control."""
    FLAG = auto()
    UNFLAG = auto()
    SET_MODE = auto()
    PAUSE = auto()
    """The mode becomes MANUAL."""
    END = auto()
    FORWARD = auto()
    """The request is forwarded to the translator, which answers it."""


class Cause(Enum):
    """The reason why a holder is no longer in control."""

    RELEASED = "released"
    PROBLEM = "problem"
    SOLVED = "solved"
    MANUAL = "manual"
    BY_HAND = "by-hand"
    DEAD = "dead"
    IDLE = "idle"
    REVOKED = "revoked"
    STOPPED = "stopped"
    ENDED = "ended"

    @property
    def text(self) -> str:
        """The cause in words, about the former holder."""
        return _CAUSE_TEXTS[self]


_CAUSE_TEXTS = {
    Cause.RELEASED: "it gave control back",
    Cause.PROBLEM: "a problem was flagged",
    Cause.SOLVED: "the problem it solved was cleared",
    Cause.MANUAL: "the mode changed to MANUAL",
    Cause.BY_HAND: "a person acted at the microscope itself",
    Cause.DEAD: "its process died",
    Cause.IDLE: "it did nothing for longer than its lease",
    Cause.REVOKED: "its approval ended",
    Cause.STOPPED: "an agent called stop",
    Cause.ENDED: "the experiment ended",
}


@dataclass(frozen=True)
class ArbitrationState:
    """The state of control.

    Attributes:
        solving: the flagged problem that the holder is in control for; 0 for none.
        problems: the flagged problems, each with the name of the component that flagged it.
        ended: whether the experiment is over.
    """

    mode: ControlMode = ControlMode.AUTOMATED
    holder: str | None = None
    solving: int = 0
    problems: Mapping[int, str] = field(default_factory=lambda: _NO_PROBLEMS)
    ended: bool = False

    @property
    def sees_to_tip(self) -> bool:
        """Whether a person, or a component that solves device-malfunction, looks after a tip in danger."""
        return self.mode is ControlMode.MANUAL or (
            self.holder is not None and self.solving == Problem.DEVICE_MALFUNCTION
        )

    def published(self) -> ControlState:
        """Return the part of the state that is published to all peers."""
        return ControlState(self.mode, self.holder, tuple(sorted(self.problems)))


@dataclass(frozen=True)
class RoleTable:
    """The components and people with a role. Without the key, everyone has the role, except `operate` and `approve`.

    A person who acts through a component ("dashboard:Ada") has the roles of the component and the roles given to that
    person there.

    Attributes:
        end_experiment: end the experiment.
        set_mode: switch between MANUAL and AUTOMATED.
        clear_problems: clear problems that others flagged. A component may always clear a problem that it flagged
            itself, or is in control to solve.
        operate: command the microscope in MANUAL mode, and set an `adjustable` parameter. Without the key: the
            dashboard, and other components through which a person commands the microscope.
        restart: restart a process.
        approve: approve plans of agents, give grants, revoke both, clear `stopped-by-agent`, and say that the
            feedback is off by intention (`afspm continue --feedback-off`), or that the tip is clear
            (`afspm continue --tip-is-clear`). No agent has this role. Without the key: the
            dashboard and other components through which a person commands the microscope, and the terminal of this
            computer.
    """

    end_experiment: tuple[str, ...] | None = None
    set_mode: tuple[str, ...] | None = None
    clear_problems: tuple[str, ...] | None = None
    operate: tuple[str, ...] | None = None
    restart: tuple[str, ...] | None = None
    approve: tuple[str, ...] | None = None

    __pydantic_config__: ClassVar[object] = SECTION


@dataclass(frozen=True)
class Rules:
    """The part of the experiment file that the arbitration table needs.

    Attributes:
        problems: the problems declared for this experiment.
        adjustable: parameters that a person may set while a component is in control and no problem is flagged.
        end_on: problems that end the experiment.
        agents: components whose commands need the approval of a person.
        by_hand: problems that a person solves.
        shadow: whether the run only watches a person's work (`afspm shadow`): no component gets control.
    """

    roles: RoleTable = RoleTable()
    problems: ProblemNames = field(default_factory=ProblemNames)
    adjustable: frozenset[str] = frozenset()
    end_on: frozenset[int] = frozenset()
    agents: frozenset[str] = frozenset()
    by_hand: frozenset[int] = frozenset()
    shadow: bool = False

    @property
    def stop(self) -> int:
        """The number of the problem `stopped-by-agent`; 0 where the experiment has no agent."""
        return self.problems.get(STOPPED_BY_AGENT, 0)

    def is_agent(self, who: str) -> bool:
        """Return whether `who` acts only with the approval of a person."""
        return component_of(who) in self.agents

    def may_approve(self, who: str) -> bool:
        """Return whether `who` may approve plans and grants."""
        return not self.is_agent(who) and may(self.roles.approve or (), who)


@dataclass(frozen=True)
class ControlInput:
    """An event caused by the component `who`.

    Attributes:
        number: the problem or mode of the event, else 0.
        why: the act, in words, of `ArbitrationEvent.BY_HAND`.
    """

    event: ArbitrationEvent
    who: str
    number: int = 0
    why: str = ""


@dataclass(frozen=True)
class Condition:
    """A condition on a state and an input, with its text for the documentation."""

    text: str
    holds: Callable[[ArbitrationState, ControlInput, Rules], bool]


@dataclass(frozen=True)
class Transition:
    """One row of the table.

    Attributes:
        response: the answer to a request; None where the translator answers, or the event is not a request.
        why: the reason of the row. With a refusal it is sent to the client, with {who}, {holder}, {number}, {problem}
            and {problems} filled in.
        cause: the reason why the holder loses control; None if the holder stays in control.
    """

    when: Condition
    response: ControlResponse | None
    do: tuple[ControlChange, ...]
    why: str
    cause: Cause | None = None


def may(role: Collection[str] | None, who: str) -> bool:
    """Return whether a component, or a person who acts through a component, has a role.

    If `role` is None, all have the role.
    """
    return role is None or who in role or component_of(who) in role


def _may_clear(control: ArbitrationState, ask: ControlInput, rules: Rules) -> bool:
    flagged_by = control.problems.get(ask.number, ask.who)
    solves = control.holder == ask.who and control.solving == ask.number
    return flagged_by == ask.who or solves or may(rules.roles.clear_problems, ask.who)


OTHERWISE = Condition("otherwise", lambda c, a, r: True)
IS_MANUAL = Condition("the mode is manual", lambda c, a, r: c.mode is ControlMode.MANUAL)
IS_SHADOW = Condition("[control] shadow is true", lambda c, a, r: r.shadow)
# the scheduler would flag a lost microscope again and again if its flag were not kept
IS_NOTED = Condition(
    "[control] shadow is true and it is not device-malfunction",
    lambda c, a, r: r.shadow and a.number != Problem.DEVICE_MALFUNCTION,
)
IS_OPERATOR = Condition(
    "the mode is manual and it has the role `operate`",
    lambda c, a, r: c.mode is ControlMode.MANUAL and may(r.roles.operate or (), a.who),
)
IS_PERSON = Condition(
    "the mode is manual and it has the role `approve`",
    lambda c, a, r: c.mode is ControlMode.MANUAL and r.may_approve(a.who),
)
IS_ADJUSTER = Condition(
    "it has the role `operate` and no problem is flagged",
    lambda c, a, r: may(r.roles.operate or (), a.who) and not c.problems,
)
ASKER_HOLDS = Condition("it is in control", lambda c, a, r: c.holder == a.who)
OTHER_HOLDS = Condition("another component is in control", lambda c, a, r: c.holder not in (None, a.who))
SOLVES_NONE = Condition("problems are flagged and it names none", lambda c, a, r: not a.number and bool(c.problems))
SOLVES_UNFLAGGED = Condition(
    "it names a problem that is not flagged", lambda c, a, r: bool(a.number) and a.number not in c.problems
)
SOLVES_OTHER_THAN_MALFUNCTION = Condition(
    "device-malfunction is flagged and it names another problem",
    lambda c, a, r: a.number not in (0, Problem.DEVICE_MALFUNCTION) and Problem.DEVICE_MALFUNCTION in c.problems,
)
# the tip may be withdrawn until the component that flagged it has brought it back
SOLVES_OTHER_THAN_QUIET_HOURS = Condition(
    "quiet-hours is flagged, it names another problem than this and device-malfunction, and is not in control",
    lambda c, a, r: (
        r.problems.get(QUIET_HOURS) in c.problems
        and a.number not in (0, r.problems.get(QUIET_HOURS), Problem.DEVICE_MALFUNCTION)
        and c.holder != a.who
    ),
)
UNKNOWN_PROBLEM = Condition("the experiment knows no such problem", lambda c, a, r: a.number not in r.problems.values())
IS_FLAGGED = Condition("it is flagged already", lambda c, a, r: a.number in c.problems)
ENDS_EXPERIMENT = Condition("[control] end_on names it", lambda c, a, r: a.number in r.end_on)
NOT_FLAGGED = Condition("it is not flagged", lambda c, a, r: a.number not in c.problems)
HOLDER_SOLVES_NOTHING = Condition(
    "a component is in control that solves no problem", lambda c, a, r: c.holder is not None and not c.solving
)
MALFUNCTION_IS_NEW_TO_HOLDER = Condition(
    "it is device-malfunction and a component is in control",
    lambda c, a, r: a.number == Problem.DEVICE_MALFUNCTION and c.holder is not None,
)
HOLDER_SOLVES_IT = Condition(
    "a component is in control to solve it", lambda c, a, r: c.holder is not None and c.solving == a.number
)
MAY_NOT_CLEAR = Condition(
    "another component flagged it, and the asker does not have the role `clear_problems`",
    lambda c, a, r: not _may_clear(c, a, r),
)
MAY_NOT_SET_MODE = Condition(
    "the asker does not have the role `set_mode`", lambda c, a, r: not may(r.roles.set_mode, a.who)
)
MAY_NOT_END = Condition(
    "the asker does not have the role `end_experiment`", lambda c, a, r: not may(r.roles.end_experiment, a.who)
)
NO_SUCH_MODE = Condition(
    "neither manual nor automated", lambda c, a, r: a.number not in (ControlMode.MANUAL, ControlMode.AUTOMATED)
)
SAME_MODE = Condition("that is the mode", lambda c, a, r: a.number == c.mode)
IS_STOPPED = Condition("stopped-by-agent is flagged", lambda c, a, r: bool(r.stop) and r.stop in c.problems)
STOPS = Condition(
    "it is stopped-by-agent and the mode is automated",
    lambda c, a, r: bool(r.stop) and a.number == r.stop and c.mode is ControlMode.AUTOMATED,
)
STOP_NEEDS_A_PERSON = Condition(
    "it is stopped-by-agent, and the asker does not have the role `approve`",
    lambda c, a, r: bool(r.stop) and a.number == r.stop and not r.may_approve(a.who),
)
TO_MANUAL = Condition("to manual", lambda c, a, r: a.number == ControlMode.MANUAL)

_R, _D = ControlResponse, ControlChange


def _refuse(when: Condition, response: ControlResponse, why: str) -> Transition:
    return Transition(when, response, (), why)


def _accept(when: Condition, do: tuple[ControlChange, ...], why: str, cause: Cause | None = None) -> Transition:
    return Transition(when, ControlResponse.SUCCESS, do, why, cause)


def _without_answer(when: Condition, do: tuple[ControlChange, ...], why: str, cause: Cause | None = None) -> Transition:
    return Transition(when, None, do, why, cause)


TABLE: dict[ArbitrationEvent, tuple[Transition, ...]] = {
    ArbitrationEvent.REQUEST_CONTROL: (
        _refuse(IS_MANUAL, _R.WRONG_CONTROL_MODE, "the mode is MANUAL: a person is in control"),
        _refuse(
            IS_STOPPED,
            _R.WRONG_EXP_PROBLEM,
            "an agent has stopped the experiment; a person looks at it, and clears stopped-by-agent",
        ),
        _refuse(SOLVES_UNFLAGGED, _R.WRONG_EXP_PROBLEM, "{problem} is not flagged; flagged: {problems}"),
        _refuse(
            SOLVES_OTHER_THAN_MALFUNCTION,
            _R.WRONG_EXP_PROBLEM,
            "flagged: {problems}; until device-malfunction is cleared, only components that solve it get control",
        ),
        _refuse(
            SOLVES_OTHER_THAN_QUIET_HOURS,
            _R.WRONG_EXP_PROBLEM,
            "flagged: {problems}; until quiet-hours is cleared, no other problem is solved",
        ),
        _refuse(
            SOLVES_NONE,
            _R.WRONG_EXP_PROBLEM,
            "flagged: {problems}; until that is cleared, only components that solve it get control",
        ),
        _refuse(OTHER_HOLDS, _R.ALREADY_UNDER_CONTROL, "{holder} is in control"),
        _accept(ASKER_HOLDS, (_D.GRANT,), "asked for again: it stays in control, for the problem it now names"),
        _accept(OTHERWISE, (_D.GRANT,), "no component is in control: the first to ask gets it"),
    ),
    ArbitrationEvent.RELEASE_CONTROL: (
        _accept(ASKER_HOLDS, (_D.TAKE,), "its own decision", Cause.RELEASED),
        _refuse(OTHERWISE, _R.NOT_IN_CONTROL, "{who} is not in control, {holder} is; nothing changed"),
    ),
    ArbitrationEvent.FLAG: (
        _refuse(UNKNOWN_PROBLEM, _R.WRONG_EXP_PROBLEM, "this experiment knows no problem with the number {number}"),
        _accept(IS_NOTED, (), "a shadow notes it in the record, and goes on as before"),
        _accept(IS_FLAGGED, (), "it is flagged already: two components may notice the same"),
        _accept(ENDS_EXPERIMENT, (_D.FLAG, _D.END), "the experiment ends instead of waiting for a solver"),
        _accept(STOPS, (_D.FLAG, _D.TAKE), "until a person has cleared it, no component is in control", Cause.STOPPED),
        _accept(
            HOLDER_SOLVES_NOTHING,
            (_D.FLAG, _D.TAKE),
            "from now on only components that solve a flagged problem get control",
            Cause.PROBLEM,
        ),
        _accept(
            MALFUNCTION_IS_NEW_TO_HOLDER,
            (_D.FLAG, _D.TAKE),
            "nothing else can be solved while the microscope can't be used, or after its tip was in danger",
            Cause.PROBLEM,
        ),
        _accept(OTHERWISE, (_D.FLAG,), "a solver stays in control while its own problem is flagged"),
    ),
    ArbitrationEvent.CLEAR: (
        _refuse(UNKNOWN_PROBLEM, _R.WRONG_EXP_PROBLEM, "this experiment knows no problem with the number {number}"),
        _accept(NOT_FLAGGED, (), "nothing to clear: classifier and corrector may both clear"),
        _refuse(
            STOP_NEEDS_A_PERSON,
            _R.FAILURE,
            "{problem} is cleared by a person with the role approve ([control.roles]), not by {who}",
        ),
        _refuse(
            MAY_NOT_CLEAR,
            _R.FAILURE,
            "{who} did not flag {problem}, and does not have the role clear_problems ([control.roles])",
        ),
        _accept(
            HOLDER_SOLVES_IT,
            (_D.UNFLAG, _D.TAKE),
            "solved: its solver has no more reason to be in control",
            Cause.SOLVED,
        ),
        _accept(OTHERWISE, (_D.UNFLAG,), "a component that solves another problem stays in control"),
    ),
    ArbitrationEvent.SET_MODE: (
        _refuse(MAY_NOT_SET_MODE, _R.FAILURE, "{who} does not have the role set_mode ([control.roles])"),
        _refuse(IS_SHADOW, _R.FAILURE, "a shadow only watches a person's work: its mode stays MANUAL"),
        _refuse(NO_SUCH_MODE, _R.WRONG_CONTROL_MODE, "there is no control mode {number}: 1 manual, 2 automated"),
        _accept(SAME_MODE, (), "nothing changes"),
        _accept(
            TO_MANUAL,
            (_D.SET_MODE, _D.TAKE),
            "a person takes over, and the holder loses control",
            Cause.MANUAL,
        ),
        _accept(OTHERWISE, (_D.SET_MODE,), "components ask for control again, and go on"),
    ),
    ArbitrationEvent.END: (
        _refuse(MAY_NOT_END, _R.FAILURE, "{who} does not have the role end_experiment ([control.roles])"),
        _accept(OTHERWISE, (_D.END,), "all receivers close"),
    ),
    ArbitrationEvent.COMMAND: (
        _refuse(IS_SHADOW, _R.NOT_IN_CONTROL, "a shadow only watches a person's work: nothing is sent"),
        _without_answer(ASKER_HOLDS, (_D.FORWARD,), "the holder of control commands the microscope"),
        _without_answer(IS_OPERATOR, (_D.FORWARD,), "in MANUAL mode a person may, through a component"),
        _refuse(OTHERWISE, _R.NOT_IN_CONTROL, "{who} is not in control, {holder} is"),
    ),
    ArbitrationEvent.ADJUST: (
        _refuse(IS_SHADOW, _R.NOT_IN_CONTROL, "a shadow only watches a person's work: nothing is sent"),
        _without_answer(ASKER_HOLDS, (_D.FORWARD,), "the holder of control commands the microscope"),
        _without_answer(IS_OPERATOR, (_D.FORWARD,), "in MANUAL mode a person may, through a component"),
        _without_answer(IS_ADJUSTER, (_D.FORWARD,), "the experiment file lets a person adjust it beside the holder"),
        _refuse(
            OTHERWISE,
            _R.NOT_IN_CONTROL,
            "{who} is not in control, {holder} is; beside it only the role operate may adjust this,"
            " and while no problem is flagged",
        ),
    ),
    ArbitrationEvent.FEEDBACK_OFF: (
        _refuse(IS_SHADOW, _R.NOT_IN_CONTROL, "a shadow only watches a person's work: nothing is sent"),
        _without_answer(IS_PERSON, (_D.FORWARD,), "a person knows why it is off, and the holder can't know"),
        _refuse(
            OTHERWISE,
            _R.NOT_IN_CONTROL,
            "only a person with the role approve says that the feedback is off by intention, or that the tip is clear,"
            " in the mode MANUAL",
        ),
    ),
    ArbitrationEvent.READ: (
        _without_answer(OTHERWISE, (_D.FORWARD,), "reading disturbs nothing, and is always allowed"),
    ),
    ArbitrationEvent.DEAD: (
        _without_answer(ASKER_HOLDS, (_D.TAKE,), "a component that has died does not keep control", Cause.DEAD),
        _without_answer(OTHERWISE, (), "it was not in control"),
    ),
    ArbitrationEvent.IDLE: (
        _without_answer(ASKER_HOLDS, (_D.TAKE,), "an idle component must not block the others", Cause.IDLE),
        _without_answer(OTHERWISE, (), "it was not in control"),
    ),
    ArbitrationEvent.REVOKED: (
        _without_answer(ASKER_HOLDS, (_D.TAKE,), "an agent without an approval does not keep control", Cause.REVOKED),
        _without_answer(OTHERWISE, (), "it was not in control"),
    ),
    ArbitrationEvent.BY_HAND: (
        _without_answer(IS_MANUAL, (), "a person is in control already"),
        _without_answer(
            OTHERWISE,
            (_D.PAUSE, _D.TAKE),
            "the microscope belongs to the person at it, until a person lets the run continue",
            Cause.BY_HAND,
        ),
    ),
}


def row_for(control: ArbitrationState, ask: ControlInput, rules: Rules) -> Transition:
    """Return the first row of the table whose condition holds."""
    for row in TABLE[ask.event]:
        if row.when.holds(control, ask, rules):
            return row
    raise AssertionError(f"the table has no last row for {ask.event}")


def apply(row: Transition, control: ArbitrationState, ask: ControlInput) -> ArbitrationState:
    """Return the state after the changes of a row."""
    for do in row.do:
        control = _APPLY[do](control, ask)
    return control


def reason(row: Transition, control: ArbitrationState, ask: ControlInput, rules: Rules) -> str:
    """Return the text of a refusal; empty if the row does not refuse a request."""
    if row.response in (None, ControlResponse.SUCCESS):
        return ""
    return row.why.format(
        who=ask.who,
        holder=control.holder or "no component",
        number=ask.number,
        problem=rules.problems.name(ask.number),
        problems=", ".join(map(rules.problems.name, sorted(control.problems))) or "none",
    )


def _flag(control: ArbitrationState, ask: ControlInput) -> ArbitrationState:
    return replace(control, problems=MappingProxyType({**control.problems, ask.number: ask.who}))


def _unflag(control: ArbitrationState, ask: ControlInput) -> ArbitrationState:
    rest = {number: who for number, who in control.problems.items() if number != ask.number}
    return replace(control, problems=MappingProxyType(rest))


_APPLY: dict[ControlChange, Callable[[ArbitrationState, ControlInput], ArbitrationState]] = {
    ControlChange.GRANT: lambda control, ask: replace(control, holder=ask.who, solving=ask.number),
    ControlChange.TAKE: lambda control, ask: replace(control, holder=None, solving=0),
    ControlChange.FLAG: _flag,
    ControlChange.UNFLAG: _unflag,
    ControlChange.SET_MODE: lambda control, ask: replace(control, mode=ControlMode(ask.number)),
    ControlChange.PAUSE: lambda control, ask: replace(control, mode=ControlMode.MANUAL),
    ControlChange.END: lambda control, ask: replace(control, ended=True),
    ControlChange.FORWARD: lambda control, ask: control,
}
