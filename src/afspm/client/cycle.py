"""One scan or spectrum, followed through what the scheduler publishes. Pure: packets in, an outcome out."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import Any

from afspm.model import ScopeState


class CycleOutcome(Enum):
    """The outcome of a cycle."""

    COMPLETED = auto()
    INTERRUPTED = auto()
    """The microscope says that it was stopped."""
    VANISHED = auto()
    """The microscope is free and there is nothing: it was started anew in the middle, say."""
    ANOTHER = auto()
    """The results can't be those asked for: a person at the panel has moved the frame, say."""


class Cycle:
    """The state `busy`, then results, then FREE.

    While a connection was lost the cache may have kept the results and not `busy`: then they are taken for ours, too.

    Args:
        busy: the state while it runs, SCANNING or SPEC.
        fits: whether a result can be what was asked for; only those count, whoever seems to be in control: nothing
            keeps a person, or another program, from the controller itself.
        since_ns: what is not newer than this belongs to something earlier; None: nothing was published before.
        resumed: it was asked for in an earlier life of ours; somebody else may have measured since then.

    Attributes:
        begun: whether it is seen to have begun.
        results: that fit.
        other: the first result that does not, since `busy`.
    """

    def __init__(
        self, busy: ScopeState, fits: Callable[[Any], bool], *, since_ns: int | None = None, resumed: bool = False
    ) -> None:
        self._busy = busy
        self._fits = fits
        self._since_ns = since_ns
        self._resumed = resumed
        self.begun = False
        self.outcome: CycleOutcome | None = None
        self.results: list[Any] = []
        self.other: Any = None

    def control_was_lost(self) -> None:
        """Somebody else may measure from now on, as after an earlier life of ours."""
        self._resumed = True

    def on_state(self, state: ScopeState, time_ns: int | None) -> None:
        """The microscope said what it is doing."""
        if self.outcome is not None or self._is_old(time_ns):
            return
        if state is self._busy:
            self.results.clear()  # what came before this began belongs to another
            self.other = None
            self.begun = True
        elif not self.begun:
            return
        elif state is ScopeState.INTERRUPTED:
            self.outcome = CycleOutcome.INTERRUPTED
        elif state is ScopeState.FREE:
            without = CycleOutcome.VANISHED if self.other is None else CycleOutcome.ANOTHER
            self.outcome = CycleOutcome.COMPLETED if self.results else without

    def on_result(self, result: object, time_ns: int | None) -> None:
        """A channel of a scan, or a spectrum, was published."""
        if self.outcome is not None or self._is_old(time_ns):
            return
        if self._fits(result):
            self.begun = True
            self.results.append(result)
        elif self.begun and self.other is None:
            self.other = result

    def _is_old(self, time_ns: int | None) -> bool:
        if time_ns is None:  # a peer that does not say: only what we wait for right now can be ours
            return self._resumed
        return self._since_ns is not None and time_ns <= self._since_ns
