"""The lease: a holder that does nothing while the microscope is free loses control."""

from __future__ import annotations

from afspm.model import ScopeState


class Lease:
    """Counts how long the holder has done nothing, in experiment time: a simulated night decides as a real one.

    Args:
        lease_ns: how long it may; None for as long as it likes.
    """

    def __init__(self, lease_ns: int | None = None) -> None:
        self._lease_ns = lease_ns
        self._holder: str | None = None
        self._free = True
        self._idle_since_ns = 0

    def held_by(self, holder: str | None, now_ns: int) -> None:
        """Somebody, or nobody, is in control now."""
        if holder != self._holder:
            self._holder, self._idle_since_ns = holder, now_ns

    def used(self, now_ns: int) -> None:
        """The holder did something: a request of it was accepted."""
        self._idle_since_ns = now_ns

    def scope_is(self, state: ScopeState, now_ns: int) -> None:
        """The microscope says what it is doing. While it does something, the holder is not idle."""
        free = state is ScopeState.FREE
        if free != self._free:
            self._free, self._idle_since_ns = free, now_ns

    def deadline_ns(self) -> int | None:
        """When, in experiment time, the lease runs out; None: it does not."""
        if self._lease_ns is None or self._holder is None or not self._free:
            return None
        return self._idle_since_ns + self._lease_ns
