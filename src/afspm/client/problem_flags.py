"""Flags of problems, set and cleared by one client."""

from __future__ import annotations

from collections.abc import Callable

from afspm import wire
from afspm.client.command_retry import SETTLED_WITHIN_S
from afspm.client.experiment_link import ExperimentLink
from afspm.errors import ExperimentEnded
from afspm.model import ControlRequest


class ProblemFlags:
    """Sets and clears flags.

    Args:
        tell: sends a request until it is answered, and raises where it is refused.
        is_flagged: whether a problem is flagged, as far as has been published.
    """

    def __init__(
        self, link: ExperimentLink, tell: Callable[[int, object], None], is_flagged: Callable[[int], bool]
    ) -> None:
        self._link = link
        self._tell = tell
        self._is_flagged = is_flagged
        self._states_before: dict[int, int] = {}
        """How many control states had been published when this client flagged a problem."""

    def flag(self, problem: int) -> None:
        """Flag a problem. After the end of the experiment the record says nevertheless that it was seen."""
        states = self._link.view.count("ControlState")
        try:
            self._tell(ControlRequest.ADD_EXP_PRBLM, problem)
        except ExperimentEnded:
            self._link.send_only(ControlRequest.ADD_EXP_PRBLM, problem)
            raise
        self._states_before[problem] = states

    def clear(self, problem: int) -> None:
        """Clear a flag. A scheduler of version 1 ends over one that is not set, and is not asked for that."""
        if self._link.version is wire.Version.OURS or self._is_seen_flagged(problem):
            self._tell(ControlRequest.RMV_EXP_PRBLM, problem)

    def _is_seen_flagged(self, problem: int) -> bool:
        link, states = self._link, self._states_before.get(problem)
        if states == link.view.count("ControlState"):  # that we have flagged it ourselves is to be published yet
            link.wait(lambda: link.view.count("ControlState") != states, link.until(SETTLED_WITHIN_S))
        return self._is_flagged(problem)
