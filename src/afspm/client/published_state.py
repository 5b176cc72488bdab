"""The newest of each state that the scheduler has published."""

from __future__ import annotations

from collections import Counter

from afspm import wire
from afspm.model import ControlState, Feedback, ProbePosition, ScanParameters, ScopeState, ScopeStatus


class PublishedState:
    """The newest published states, and how often each was published, so that a caller can wait for the next."""

    def __init__(self) -> None:
        self.status: ScopeStatus | None = None
        self.control: ControlState | None = None
        self.scan_parameters: ScanParameters | None = None
        self.feedback: Feedback | None = None
        self.probe_position: ProbePosition | None = None
        self.newest_ns: int | None = None
        self._published: Counter[str] = Counter()

    @property
    def state(self) -> ScopeState:
        return self.status.state if self.status else ScopeState.UNDEFINED

    def take(self, message: str, thing: object) -> None:
        """`thing` was published as `message`."""
        setattr(self, wire.declaration(message).attribute, thing)
        self._published[message] += 1

    def take_time(self, time_ns: int | None) -> None:
        """The scheduler published something at that time."""
        if time_ns is not None and (self.newest_ns is None or time_ns > self.newest_ns):
            self.newest_ns = time_ns

    def count(self, message: str) -> int:
        """Return how often `message` has been published."""
        return self._published[message]
