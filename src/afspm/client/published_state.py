"""The newest published states of microscope and control."""

from __future__ import annotations

from collections import Counter

from afspm import wire
from afspm.model import ControlState, Feedback, ProbePosition, ScanParameters, ScopeState, ScopeStatus


class PublishedState:
    """The newest published states, and the number of publications of each, so that a caller can wait for the next."""

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
        """Take `thing`, published as the message `message`."""
        setattr(self, wire.declaration(message).attribute, thing)
        self._published[message] += 1

    def take_time(self, time_ns: int | None) -> None:
        """Take the time of a packet of the scheduler."""
        if time_ns is not None and (self.newest_ns is None or time_ns > self.newest_ns):
            self.newest_ns = time_ns

    def count(self, message: str) -> int:
        """Return the number of publications of `message`."""
        return self._published[message]
