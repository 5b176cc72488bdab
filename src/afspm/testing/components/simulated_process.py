"""Simulated processes that can be killed and frozen; a kill loses their memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from afspm.testing.components.simulated_time import SimulatedTime, Timer


class Cuttable(Protocol):
    """A connection that breaks when a process dies."""

    def cut(self) -> None: ...


_SAME_S = 1e-6


class ProcessTimer:
    """A timer of a process that may be reset often; setting the same time again costs nothing."""

    def __init__(self, process: Process, ring: Callable[[], None]) -> None:
        self._process = process
        self._ring = ring
        self._timer: Timer | None = None
        self._at_s = 0.0

    def set(self, delay_s: float | None) -> None:
        """Restart the timer with this delay; None cancels it. A kill of the process also cancels it."""
        at_s = math.inf if delay_s is None else self._process.timeline.monotonic_s() + delay_s
        if self._timer is not None:
            if abs(at_s - self._at_s) < _SAME_S:
                return
            self._timer.cancel()
        self._at_s = at_s
        self._timer = None if delay_s is None else self._process.later(delay_s, self._rings)

    def _rings(self) -> None:
        self._timer = None
        self._ring()


class Process:
    """A process over all its lives. Subclasses set up the memory of one life in `begin`.

    Attributes:
        alive: True while the process is running or frozen.
        banned: True if the process can't be started.
        frozen: True while the process does nothing, and messages wait.
        sockets: connections from other processes, including broken connections not yet noticed.
        since_s: the time of its start or of the end of its last freeze.
        step_age_s: the reported age of its current step.
        starts: number of its starts.
    """

    def __init__(self, timeline: SimulatedTime, name: str) -> None:
        self.timeline = timeline
        self.name = name
        self.alive = False
        self.frozen = False
        self.step_age_s = 0.0
        self.life = self.starts = 0
        self.banned = False
        self.since_s = 0.0
        self.exited: Callable[[int], None] = lambda code: None
        self.sockets: dict[Cuttable, None] = {}
        self._waiting: list[tuple[Callable[..., None], tuple[object, ...]]] = []

    # --- for those who start and end it ---

    def start(self) -> None:
        if self.alive:
            return
        if self.banned:
            self.exited(1)
            return
        self.alive, self.frozen = True, False
        self.life += 1
        self.starts += 1
        self.step_age_s = 0.0
        self.since_s = self.timeline.monotonic_s()
        self._waiting.clear()
        self.begin()

    def kill(self, code: int = -9) -> None:
        """End this life at once: only its disk survives."""
        if not self.alive:
            return
        self.alive = self.frozen = False
        self.life += 1
        self._waiting.clear()
        for socket in list(self.sockets):
            socket.cut()
        self.ended()
        self.exited(code)

    def freeze(self, for_s: float) -> None:
        if self.alive and not self.frozen:
            self.frozen = True
            self.timeline.after(for_s, self._thaw, self.life)

    def _thaw(self, life: int) -> None:
        if life != self.life or not self.frozen:
            return
        self.frozen = False
        self.since_s = self.timeline.monotonic_s()
        waiting, self._waiting = self._waiting, []
        for do, args in waiting:
            if life == self.life:
                do(*args)

    # --- for what happens to it ---

    def take(self, do: Callable[..., None], *args: object) -> None:
        """Call `do(*args)` now; after the end of a freeze if frozen; never if dead."""
        if not self.alive:
            return
        if self.frozen:
            self._waiting.append((do, args))
        else:
            do(*args)

    def later(self, delay_s: float, do: Callable[..., None], *args: object) -> Timer:
        """Call `do` after `delay_s`, unless this life ends before."""
        return self.timeline.after(delay_s, self._if_same_life, self.life, do, args)

    def _if_same_life(self, life: int, do: Callable[..., None], args: tuple[object, ...]) -> None:
        if life == self.life:
            self.take(do, *args)

    # --- for subclasses ---

    def begin(self) -> None:
        """Set up a new life."""

    def ended(self) -> None:
        """Close the resources of the life that has ended."""
