"""Who is in control: the whole transition table as data, and the one function that applies it.

`TABLE` is read from the top: the first row of an event whose condition holds applies, and each event's last row always
does. Nothing but a row changes who is in control, the mode or the flagged problems.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from types import MappingProxyType
from typing import Any

from afspm.model import ControlMode, ControlResponse, ControlState, Problem, ProblemNames, component_of

_NO_PROBLEMS: Mapping[int, str] = MappingProxyType({})


class ControlEvent(Enum):
    """What control depends on: the requests, by kind, and two that time brings."""

    REQUEST_CONTROL = "asks for control"
    RELEASE_CONTROL = "gives control back"
    FLAG = "flags a problem"
    CLEAR = "removes a flag"
    SET_MODE = "sets the mode"
    END = "ends the experiment"
    COMMAND = "commands the microscope"
    READ = "asks the microscope for a value"
    DEAD = "is dead"
    IDLE = "has let its lease run out"


class ControlChange(Enum):
    """What a row does."""

    GRANT = auto()
    """The asker gets control, to solve the problem it named (or none)."""
    TAKE = auto()
    """Whoever is in control no longer is."""
    FLAG = auto()
    UNFLAG = auto()
    SET_MODE = auto()
    END = auto()
    FORWARD = auto()
    """The translator answers."""


class Cause(Enum):
    """Why control was taken from its holder."""

    RELEASED = "it gave control back"
    PROBLEM = "a problem was flagged"
    SOLVED = "the problem it solved was cleared"
    MANUAL = "the mode is manual"
    DEAD = "it is dead"
    IDLE = "it did nothing for longer than its lease"
    ENDED = "the experiment ends"


@dataclass(frozen=True, slots=True)
class ArbitrationState:
    """The state that control is in.

    Attributes:
        solving: the flagged problem that the holder is in control for; 0 for none.
        problems: the flagged problems, each with who flagged it.
        ended: the experiment is over.
    """

    mode: ControlMode = ControlMode.AUTOMATED
    holder: str | None = None
    solving: int = 0
    problems: Mapping[int, str] = field(default_factory=lambda: _NO_PROBLEMS)
    ended: bool = False

    @property
    def sees_to_tip(self) -> bool:
        """Somebody is there for a microscope that is not as it should be: a person, or who solves that."""
        return self.mode is ControlMode.MANUAL or (
            self.holder is not None and self.solving == Problem.DEVICE_MALFUNCTION
        )

    def published(self) -> ControlState:
        """What all peers are told of it."""
        return ControlState(self.mode, self.holder, tuple(sorted(self.problems)))

    def to_dict(self) -> dict[str, Any]:
        """As plain JSON."""
        problems = {str(number): who for number, who in sorted(self.problems.items())}
        return {
            "mode": int(self.mode),
            "holder": self.holder,
            "solving": self.solving,
            "problems": problems,
            "ended": self.ended,
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> ArbitrationState:
        problems = {int(number): str(who) for number, who in plain["problems"].items()}
        return cls(
            ControlMode(plain["mode"]),
            plain["holder"],
            int(plain["solving"]),
            MappingProxyType(problems),
            bool(plain["ended"]),
        )


@dataclass(frozen=True, slots=True)
class RoleTable:
    """Who may do what is not everybody's. None: everybody may; but nobody may `operate` unless named.

    Who acts for a person ("dashboard:Ada") has the roles of the component and those given to just that person there.

    Attributes:
        end: end the experiment.
        mode: switch between MANUAL and AUTOMATED.
        clear: remove flags of others (who flagged a problem, or is in control to solve it, may always).
        operate: command the microscope in MANUAL mode.
        restart: have a process started anew.
    """

    end: Collection[str] | None = None
    mode: Collection[str] | None = None
    clear: Collection[str] | None = None
    operate: Collection[str] = ()
    restart: Collection[str] | None = None


@dataclass(frozen=True, slots=True)
class Rules:
    """What the table takes from the experiment file: roles, and the problems there are."""

    roles: RoleTable = RoleTable()
    problems: ProblemNames = field(default_factory=ProblemNames)


@dataclass(slots=True)
class ControlInput:
    """An event of `who`; `number` is the problem or mode that it is about."""

    event: ControlEvent
    who: str
    number: int = 0


@dataclass(frozen=True, slots=True)
class Condition:
    """Something that may hold of a state and an ask, with words for it."""

    text: str
    holds: Callable[[ArbitrationState, ControlInput, Rules], bool]


@dataclass(frozen=True, slots=True)
class Transition:
    """One line of the table.

    Attributes:
        response: of a request; None where the translator answers, or nobody asked.
        why: why it is so. Of a refusal it is the reason given, with {who}, {holder}, {number}, {problem} and {problems}
            filled in.
        cause: why control is taken, where it is.
    """

    event: ControlEvent
    when: Condition
    response: ControlResponse | None
    do: tuple[ControlChange, ...]
    why: str
    cause: Cause | None = None


def may(role: Collection[str] | None, who: str) -> bool:
    """Whether `who` has a role."""
    return role is None or who in role or component_of(who) in role


def _may_clear(control: ArbitrationState, ask: ControlInput, rules: Rules) -> bool:
    flagged_by = control.problems.get(ask.number, ask.who)
    solves = control.holder == ask.who and control.solving == ask.number
    return flagged_by == ask.who or solves or may(rules.roles.clear, ask.who)


OTHERWISE = Condition("otherwise", lambda c, a, r: True)
IS_MANUAL = Condition("the mode is manual", lambda c, a, r: c.mode is ControlMode.MANUAL)
IS_OPERATOR = Condition(
    "the mode is manual and it has the role `operate`",
    lambda c, a, r: c.mode is ControlMode.MANUAL and may(r.roles.operate, a.who),
)
ASKER_HOLDS = Condition("it is in control", lambda c, a, r: c.holder == a.who)
OTHER_HOLDS = Condition("another is in control", lambda c, a, r: c.holder not in (None, a.who))
SOLVES_NONE = Condition("problems are flagged and it names none", lambda c, a, r: not a.number and bool(c.problems))
SOLVES_UNFLAGGED = Condition(
    "it names a problem that is not flagged", lambda c, a, r: bool(a.number) and a.number not in c.problems
)
SOLVES_OTHER_THAN_MALFUNCTION = Condition(
    "device-malfunction is flagged and it names another problem",
    lambda c, a, r: a.number not in (0, Problem.DEVICE_MALFUNCTION) and Problem.DEVICE_MALFUNCTION in c.problems,
)
UNKNOWN_PROBLEM = Condition("the experiment knows no such problem", lambda c, a, r: a.number not in r.problems.values())
IS_FLAGGED = Condition("it is flagged already", lambda c, a, r: a.number in c.problems)
NOT_FLAGGED = Condition("it is not flagged", lambda c, a, r: a.number not in c.problems)
HOLDER_SOLVES_NOTHING = Condition(
    "one is in control that solves no problem", lambda c, a, r: c.holder is not None and not c.solving
)
MALFUNCTION_IS_NEW_TO_HOLDER = Condition(
    "it is device-malfunction and one is in control",
    lambda c, a, r: a.number == Problem.DEVICE_MALFUNCTION and c.holder is not None,
)
HOLDER_SOLVES_IT = Condition(
    "one is in control to solve it", lambda c, a, r: c.holder is not None and c.solving == a.number
)
MAY_NOT_CLEAR = Condition(
    "another flagged it, and it has not the role `clear`", lambda c, a, r: not _may_clear(c, a, r)
)
MAY_NOT_SET_MODE = Condition("it has not the role `mode`", lambda c, a, r: not may(r.roles.mode, a.who))
MAY_NOT_END = Condition("it has not the role `end`", lambda c, a, r: not may(r.roles.end, a.who))
NO_SUCH_MODE = Condition(
    "neither manual nor automated", lambda c, a, r: a.number not in (ControlMode.MANUAL, ControlMode.AUTOMATED)
)
SAME_MODE = Condition("that is the mode", lambda c, a, r: a.number == c.mode)
TO_MANUAL = Condition("to manual", lambda c, a, r: a.number == ControlMode.MANUAL)

_E, _R = ControlEvent, ControlResponse

TABLE: tuple[Transition, ...] = (
    Transition(
        _E.REQUEST_CONTROL,
        IS_MANUAL,
        _R.WRONG_CONTROL_MODE,
        (),
        "the mode is manual: the person at the microscope is in control",
    ),
    Transition(
        _E.REQUEST_CONTROL,
        SOLVES_UNFLAGGED,
        _R.WRONG_EXP_PROBLEM,
        (),
        "{problem} is not flagged; flagged: {problems}",
    ),
    Transition(
        _E.REQUEST_CONTROL,
        SOLVES_OTHER_THAN_MALFUNCTION,
        _R.WRONG_EXP_PROBLEM,
        (),
        "flagged: {problems}; device-malfunction comes first: until that is cleared, control is only for who solves it",
    ),
    Transition(
        _E.REQUEST_CONTROL,
        SOLVES_NONE,
        _R.WRONG_EXP_PROBLEM,
        (),
        "flagged: {problems}; until that is cleared, control is only for who solves it",
    ),
    Transition(
        _E.REQUEST_CONTROL, OTHER_HOLDS, _R.ALREADY_UNDER_CONTROL, (), "{holder} is in control until it gives that back"
    ),
    Transition(
        _E.REQUEST_CONTROL,
        ASKER_HOLDS,
        _R.SUCCESS,
        (ControlChange.GRANT,),
        "asked for again: it stays in control, for the problem it now names",
    ),
    Transition(
        _E.REQUEST_CONTROL,
        OTHERWISE,
        _R.SUCCESS,
        (ControlChange.GRANT,),
        "nobody is in control: the first to ask gets it",
    ),
    Transition(_E.RELEASE_CONTROL, ASKER_HOLDS, _R.SUCCESS, (ControlChange.TAKE,), "its own decision", Cause.RELEASED),
    Transition(
        _E.RELEASE_CONTROL, OTHERWISE, _R.NOT_IN_CONTROL, (), "{who} is not in control, {holder} is; nothing changed"
    ),
    Transition(
        _E.FLAG, UNKNOWN_PROBLEM, _R.WRONG_EXP_PROBLEM, (), "this experiment knows no problem with the number {number}"
    ),
    Transition(_E.FLAG, IS_FLAGGED, _R.SUCCESS, (), "what was asked for is so: two may notice the same"),
    Transition(
        _E.FLAG,
        HOLDER_SOLVES_NOTHING,
        _R.SUCCESS,
        (ControlChange.FLAG, ControlChange.TAKE),
        "from now on only who solves a flagged problem may have control",
        Cause.PROBLEM,
    ),
    Transition(
        _E.FLAG,
        MALFUNCTION_IS_NEW_TO_HOLDER,
        _R.SUCCESS,
        (ControlChange.FLAG, ControlChange.TAKE),
        "nothing else can be solved with a microscope that can't be used, or a tip that was in danger",
        Cause.PROBLEM,
    ),
    Transition(
        _E.FLAG,
        OTHERWISE,
        _R.SUCCESS,
        (ControlChange.FLAG,),
        "a solver stays in control while its own problem is flagged",
    ),
    Transition(
        _E.CLEAR, UNKNOWN_PROBLEM, _R.WRONG_EXP_PROBLEM, (), "this experiment knows no problem with the number {number}"
    ),
    Transition(
        _E.CLEAR, NOT_FLAGGED, _R.SUCCESS, (), "what was asked for is so: classifier and corrector may both clear"
    ),
    Transition(
        _E.CLEAR,
        MAY_NOT_CLEAR,
        _R.FAILURE,
        (),
        "{who} has not flagged {problem} and has not the role 'clear' ([control] roles)",
    ),
    Transition(
        _E.CLEAR,
        HOLDER_SOLVES_IT,
        _R.SUCCESS,
        (ControlChange.UNFLAG, ControlChange.TAKE),
        "solved: its solver has no more reason to be in control",
        Cause.SOLVED,
    ),
    Transition(_E.CLEAR, OTHERWISE, _R.SUCCESS, (ControlChange.UNFLAG,), "who solves another problem stays in control"),
    Transition(_E.SET_MODE, MAY_NOT_SET_MODE, _R.FAILURE, (), "{who} has not the role 'mode' ([control] roles)"),
    Transition(
        _E.SET_MODE, NO_SUCH_MODE, _R.WRONG_CONTROL_MODE, (), "there is no control mode {number}: 1 manual, 2 automated"
    ),
    Transition(_E.SET_MODE, SAME_MODE, _R.SUCCESS, (), "what was asked for is so"),
    Transition(
        _E.SET_MODE,
        TO_MANUAL,
        _R.SUCCESS,
        (ControlChange.SET_MODE, ControlChange.TAKE),
        "a person takes over: whoever is in control is disengaged",
        Cause.MANUAL,
    ),
    Transition(
        _E.SET_MODE, OTHERWISE, _R.SUCCESS, (ControlChange.SET_MODE,), "components ask for control again, and go on"
    ),
    Transition(_E.END, MAY_NOT_END, _R.FAILURE, (), "{who} has not the role 'end' ([control] roles)"),
    Transition(_E.END, OTHERWISE, _R.SUCCESS, (ControlChange.END,), "all receivers close"),
    Transition(
        _E.COMMAND, ASKER_HOLDS, None, (ControlChange.FORWARD,), "only who is in control commands the microscope"
    ),
    Transition(_E.COMMAND, IS_OPERATOR, None, (ControlChange.FORWARD,), "in manual mode a person may, by a component"),
    Transition(_E.COMMAND, OTHERWISE, _R.NOT_IN_CONTROL, (), "{who} is not in control, {holder} is"),
    Transition(_E.READ, OTHERWISE, None, (ControlChange.FORWARD,), "it disturbs nothing, so anybody may, at any time"),
    Transition(_E.DEAD, ASKER_HOLDS, None, (ControlChange.TAKE,), "control never stays with the dead", Cause.DEAD),
    Transition(_E.DEAD, OTHERWISE, None, (), "it was not in control"),
    Transition(
        _E.IDLE, ASKER_HOLDS, None, (ControlChange.TAKE,), "a greedy component can't block the night", Cause.IDLE
    ),
    Transition(_E.IDLE, OTHERWISE, None, (), "it was not in control"),
)

_ROWS = {event: tuple(row for row in TABLE if row.event is event) for event in ControlEvent}


def row_for(control: ArbitrationState, ask: ControlInput, rules: Rules) -> Transition:
    """The row of the table that applies."""
    for row in _ROWS[ask.event]:
        if row.when.holds(control, ask, rules):
            return row
    raise AssertionError(f"the table has no last row for {ask.event}")


def apply(row: Transition, control: ArbitrationState, ask: ControlInput) -> ArbitrationState:
    """The state after a row."""
    for do in row.do:
        control = _APPLY[do](control, ask)
    return control


def reason(row: Transition, control: ArbitrationState, ask: ControlInput, rules: Rules) -> str:
    """The reason given with a refusal; empty for a success."""
    if row.response in (None, ControlResponse.SUCCESS):
        return ""
    return row.why.format(
        who=ask.who,
        holder=control.holder or "nobody",
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
    ControlChange.END: lambda control, ask: replace(control, ended=True),
    ControlChange.FORWARD: lambda control, ask: control,
}
