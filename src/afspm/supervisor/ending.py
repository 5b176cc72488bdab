"""How a run ends: who is asked to when, who is killed when. Decisions only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto

OWN_PACE_S = 1.0  # after the end of the experiment: everybody has heard it, and may finish a file
KILL_AFTER_S = 1.5  # after being asked
LEAVE_AFTER_S = 3.0  # after being killed


class Why(Enum):
    """What ended a run."""

    EXPERIMENT_ENDED = auto()
    ALL_DONE = auto()
    STOPPED = auto()
    LOST = auto()
    """A process that the experiment can't do without was given up, or all were."""

    @property
    def exit_code(self) -> int:
        """Of `afspm run`."""
        return {Why.EXPERIMENT_ENDED: 0, Why.ALL_DONE: 0, Why.STOPPED: 130, Why.LOST: 1}[self]


class Do(Enum):
    """What is to be done with those that still run."""

    ASK = auto()
    """Close their stdin: they end cleanly."""
    KILL = auto()
    LEAVE = auto()
    """Not even killing ends them (a driver hangs in the system): say so, and go."""


@dataclass(frozen=True, slots=True)
class Ending:
    """A run that is ending: those that still run are asked to end, then killed, then left.

    Attributes:
        ask_s, kill_s: when, in real monotonic time.
        last: what has been done already.
    """

    why: Why
    text: str
    ask_s: float
    kill_s: float
    last: Do | None = None

    @classmethod
    def begin(cls, why: Why, text: str, now_s: float) -> Ending:
        """Begin to end. Where the experiment itself ended, all know and close by themselves: not disturbed at first."""
        ask_s = now_s + OWN_PACE_S if why is Why.EXPERIMENT_ENDED else now_s
        return cls(why, text, ask_s, ask_s + KILL_AFTER_S)

    def hurried(self, now_s: float) -> Ending:
        """Somebody asked again: no more waiting."""
        return self if self.last in (Do.KILL, Do.LEAVE) else replace(self, kill_s=now_s, last=Do.ASK)

    def deadline_s(self) -> float | None:
        """When `step` has something to do next; None: never again."""
        match self.last:
            case None:
                return self.ask_s
            case Do.ASK:
                return self.kill_s
            case Do.KILL:
                return self.kill_s + LEAVE_AFTER_S
            case Do.LEAVE:
                return None

    def step(self, now_s: float) -> tuple[Ending, Do | None]:
        """What the time has come for, if anything, and the ending after it."""
        deadline_s = self.deadline_s()
        if deadline_s is None or now_s < deadline_s:
            return self, None
        do = {None: Do.ASK, Do.ASK: Do.KILL, Do.KILL: Do.LEAVE}[self.last]
        return replace(self, last=do), do
