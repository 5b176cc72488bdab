"""The order in which peers receive the states of a microscope (wire format, "What a translator does"). Pure.

A polled controller may be free again before a poll shows its scan, and the file may come after the state.
The published sequence is always complete: SS_SCANNING, the results, SS_FREE; or SS_SCANNING, SS_INTERRUPTED, SS_FREE.
"""

from __future__ import annotations

from dataclasses import dataclass

from afspm.model import ScopeState, ScopeStatus
from afspm.model.state import MEASURING


@dataclass(frozen=True)
class PublishStatus:
    """The step that publishes a status."""

    status: ScopeStatus


@dataclass(frozen=True)
class PublishResults:
    """The step that publishes the new results."""


@dataclass(frozen=True)
class DiscardResults:
    """The step that drops new results of an interrupted measurement."""


@dataclass(frozen=True)
class LogError:
    """The step that logs an error."""

    text: str


SequenceStep = PublishStatus | PublishResults | DiscardResults | LogError

_INTERRUPTED = ScopeStatus(ScopeState.INTERRUPTED)


class StatusSequence:
    """The conversion of observed states of the controller into published states.

    Args:
        published: the last published status (perhaps by an earlier process of this translator).
        result_timeout_s: longest time from the end to the results, and longest duration of a stop.

    Attributes:
        is_requested: whether a request to this process began the published state, such as a scan.
    """

    def __init__(self, published: ScopeStatus, result_timeout_s: float) -> None:
        self.published = published
        self._timeout_s = result_timeout_s
        self._waiting_since_s: float | None = None
        self._broken_off = ScopeState.UNDEFINED
        self.is_requested = False

    def begin(self, state: ScopeState) -> list[SequenceStep]:
        """Return the steps that publish a state after an accepted request, even before the controller shows it."""
        steps = self._publish(ScopeStatus(state))
        self.is_requested = True
        return steps

    def interrupt(self) -> list[SequenceStep]:
        """Return the steps that publish an interruption: a request has stopped the running measurement."""
        return self._publish(_INTERRUPTED)

    def follow(self, *, is_whole: bool) -> list[SequenceStep]:
        """Return the steps that publish a missed end of a measurement, because the next followed at once.

        Args:
            is_whole: False if the measurement was interrupted.
        """
        if self.published.state not in MEASURING:
            return []
        free = ScopeStatus(ScopeState.FREE)
        if is_whole:
            return [PublishResults(), *self._publish(free)]
        return [*self._publish(_INTERRUPTED), DiscardResults(), *self._publish(free)]

    def observe(
        self, seen: ScopeStatus, results: bool, now_s: float, *, of_another: bool = False
    ) -> list[SequenceStep]:
        """Return the steps that follow from the status just read from the controller.

        Args:
            seen: the status of the controller.
            results: whether there are unpublished results.
            now_s: experiment time.
            of_another: whether none of the results is of the kind of the published measurement.
        """
        if self.published.state is ScopeState.INTERRUPTED:
            return self._after_interruption(seen, now_s)
        if seen == self.published:
            self._waiting_since_s = None
            return self._unseen_scan(results) if seen.state is ScopeState.FREE else []
        if self.published.state not in MEASURING or seen.state is self.published.state:
            # results that are there already belong to a measurement that began and ended between two looks
            return (self._unseen_scan(results) if seen.state is ScopeState.FREE else []) + self._publish(seen)
        if results and of_another:
            return self._replaced(seen)
        return self._after_measuring(seen, results, now_s)

    def _unseen_scan(self, results: bool) -> list[SequenceStep]:
        # a person at the panel took a scan that began and ended between two looks
        if not results or self.published.state is ScopeState.UNDEFINED:
            return []
        after = self.published
        return [*self._publish(ScopeStatus(ScopeState.SCANNING)), PublishResults(), *self._publish(after)]

    def _after_measuring(self, seen: ScopeStatus, results: bool, now_s: float) -> list[SequenceStep]:
        if seen.state is ScopeState.INTERRUPTED:
            return self._publish(seen)
        if results:
            return [PublishResults(), *self._publish(seen)]
        if not self._timed_out(now_s):
            return []
        text = "a scan or spectrum ended without a result: it was stopped at the controller, or its file is missing"
        return [LogError(text), *self._publish(_INTERRUPTED), DiscardResults(), *self._publish(seen)]

    def _replaced(self, seen: ScopeStatus) -> list[SequenceStep]:
        # a person at the panel stopped a curve, and took a scan at once (or the reverse)
        another = ScopeState.SCANNING if self.published.state is ScopeState.SPEC else ScopeState.SPEC
        states = (_INTERRUPTED, ScopeStatus(ScopeState.FREE), ScopeStatus(another))
        steps = [step for status in states for step in self._publish(status)]
        return [*steps, PublishResults(), *self._publish(seen)]

    def _after_interruption(self, seen: ScopeStatus, now_s: float) -> list[SequenceStep]:
        if seen.state is ScopeState.INTERRUPTED:
            return []
        if seen.state not in MEASURING:
            return [DiscardResults(), *self._publish(seen)]
        if self._broken_off in MEASURING and seen.state is not self._broken_off:
            return [DiscardResults(), *self._publish(seen)]  # of the other kind: it was begun at the panel
        if not self._timed_out(now_s):
            return []
        return [LogError("the controller keeps measuring after a stop"), *self._publish(seen)]

    def _timed_out(self, now_s: float) -> bool:
        if self._waiting_since_s is None:
            self._waiting_since_s = now_s
        return now_s - self._waiting_since_s >= self._timeout_s

    def deadline_s(self) -> float | None:
        """Return the latest experiment time for the next `observe`; None without a deadline."""
        return None if self._waiting_since_s is None else self._waiting_since_s + self._timeout_s

    def _publish(self, status: ScopeStatus) -> list[SequenceStep]:
        self._waiting_since_s = None
        if status == self.published:
            return []
        if status == _INTERRUPTED:
            self._broken_off = self.published.state
        # a scan that is paused, or goes on, is the requested one still
        self.is_requested = self.is_requested and status.state is self.published.state
        self.published = status
        return [PublishStatus(status)]
