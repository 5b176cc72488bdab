"""The newest of each state that the scheduler has published."""

from __future__ import annotations

from collections import Counter
from typing import Any

from afspm.model import ControlState, Feedback, ProbePosition, ScanParameters, ScopeState, ScopeStatus


class PublishedState:
    """The newest published states, and how often each was published, so that a caller can wait for the next."""

    def __init__(self) -> None:
        self._newest: dict[str, Any] = {}
        self._published: Counter[str] = Counter()
        self.newest_ns: int | None = None

    def take(self, message: str, thing: Any) -> None:
        """`thing` was published as `message`."""
        self._newest[message] = thing
        self._published[message] += 1

    def take_time(self, time_ns: int | None) -> None:
        """The scheduler published something at that time."""
        if time_ns is not None and (self.newest_ns is None or time_ns > self.newest_ns):
            self.newest_ns = time_ns

    def count(self, message: str) -> int:
        """Return how often `message` has been published."""
        return self._published[message]

    @property
    def status(self) -> ScopeStatus | None:
        return self._newest.get("ScopeStateMsg")

    @property
    def state(self) -> ScopeState:
        return self.status.state if self.status else ScopeState.UNDEFINED

    @property
    def control(self) -> ControlState | None:
        return self._newest.get("ControlState")

    @property
    def scan_parameters(self) -> ScanParameters | None:
        return self._newest.get("ScanParameters2d")

    @property
    def feedback(self) -> Feedback | None:
        return self._newest.get("ZCtrlParameters")

    @property
    def probe_position(self) -> ProbePosition | None:
        return self._newest.get("ProbePosition")
