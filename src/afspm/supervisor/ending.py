"""How a run ends: who is asked to when, who is killed when. Decisions only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto

OWN_PACE_S = 1.0  # after the end of the experiment: everybody has heard it, and may finish a file
KILL_AFTER_S = 1.5  # after being asked


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


@dataclass(frozen=True, slots=True)
class Ending:
    """A run that is ending: first those left are asked to stop (their stdin is closed), then killed.

    Attributes:
        ask_s, kill_s: when, in real monotonic time.
        asked: whether they have been.
    """

    why: Why
    text: str
    ask_s: float
    kill_s: float
    asked: bool = False

    @classmethod
    def begin(cls, why: Why, text: str, now_s: float) -> Ending:
        """Begin to end. Where the experiment itself ended, all know and close by themselves: not disturbed at first."""
        ask_s = now_s + OWN_PACE_S if why is Why.EXPERIMENT_ENDED else now_s
        return cls(why, text, ask_s, ask_s + KILL_AFTER_S)

    def hurried(self, now_s: float) -> Ending:
        """Somebody asked again: no more waiting."""
        return replace(self, ask_s=now_s, kill_s=now_s)

    def deadline_s(self) -> float:
        """When there is something to do next."""
        return self.kill_s if self.asked else self.ask_s
