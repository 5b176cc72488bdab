"""Fencing: a translator obeys only the scheduler of its own run, and of this scheduler only the newest life.

A life lasts from a start of the process to its end. A scheduler sends its epoch before each request. Without epochs two
experiments at the same addresses would command one microscope unnoticed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

ANOTHER = "this translator obeys another scheduler: two experiments have the same address"
NOT_SIMULATED = "this scheduler's experiment is called simulated, and this microscope is not"
_EPOCH = re.compile(rb"([\w-]{1,40}):(\d{1,20}):([01])")


@dataclass(frozen=True)
class Epoch:
    """The identity of one life of a run's scheduler.

    Attributes:
        run: the identity of the run.
        life: a number that grows from life to life.
        simulated: whether the experiment file declares a simulation.
    """

    run: str
    life: int
    simulated: bool = False

    def is_followed_by(self, epoch: Epoch | None, run: str) -> bool:
        """Return whether a sender is this life of the scheduler, a later life, or a component of the run."""
        return run == self.run and (epoch is None or epoch.life >= self.life)

    def encode(self) -> bytes:
        return f"{self.run}:{self.life}:{int(self.simulated)}".encode()

    @classmethod
    def decode(cls, frame: bytes) -> Epoch | None:
        """Return the epoch in a frame; None if the frame holds none."""
        found = _EPOCH.fullmatch(frame)
        return None if found is None else cls(found[1].decode(), int(found[2]), found[3] == b"1")


class SchedulerFence:
    """A guard that decides which senders a translator obeys.

    Args:
        run: the identity of the translator's run; empty: the first scheduler is obeyed while it stays connected.
        simulated: whether the microscope is simulated.
    """

    def __init__(self, run: str, *, simulated: bool) -> None:
        self._run = run
        self._simulated = simulated
        self._obeyed: Epoch | None = None

    def refusal(self, epoch: Epoch | None, run: str, is_connected: Callable[[], bool]) -> str:
        """Return the reason for refusing a sender; empty if the translator obeys it.

        Args:
            epoch: epoch of the request; None for a request without an epoch.
            run: identity of the run in the id of a component's own request; empty: unknown.
            is_connected: returns whether the scheduler that was obeyed last is still connected.
        """
        if epoch is not None and epoch.simulated and not self._simulated:
            return NOT_SIMULATED
        run_of_sender = epoch.run if epoch is not None else run
        if run_of_sender and self._run and run_of_sender != self._run:
            return ANOTHER
        if self._obeyed is None or self._obeyed.is_followed_by(epoch, run_of_sender):
            self._obeyed = epoch or self._obeyed
            return ""
        if is_connected():
            return ANOTHER
        self._obeyed = epoch
        return ""
