"""The one scheduler that a translator obeys: that of its own run, in its newest life.

A scheduler puts its epoch before each request. Two experiments with
the same addresses would else command one microscope, and neither would notice.
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
    """One life of the scheduler of one run.

    Attributes:
        run: the identity of the run.
        life: grows from one life to the next.
        simulated: whether its experiment is called so.
    """

    run: str
    life: int
    simulated: bool = False

    def is_followed_by(self, epoch: Epoch | None, run: str) -> bool:
        """True for the same scheduler, a later life of it, and a component of its run."""
        return run == self.run and (epoch is None or epoch.life >= self.life)

    def encode(self) -> bytes:
        return f"{self.run}:{self.life}:{int(self.simulated)}".encode()

    @classmethod
    def decode(cls, frame: bytes) -> Epoch | None:
        """Return what `encode` was given; None: it is something else."""
        found = _EPOCH.fullmatch(frame)
        return None if found is None else cls(found[1].decode(), int(found[2]), found[3] == b"1")


class SchedulerFence:
    """Decides whether a translator obeys who asks.

    Args:
        run: the identity of the translator's run; empty: the scheduler that asks first is obeyed while it is connected.
        simulated: whether its microscope is.
    """

    def __init__(self, run: str, *, simulated: bool) -> None:
        self._run = run
        self._simulated = simulated
        self._obeyed: Epoch | None = None

    def refusal(self, epoch: Epoch | None, run: str, is_connected: Callable[[], bool]) -> str:
        """Why who asks is not obeyed; empty: it is.

        Args:
            epoch: of a scheduler that told it.
            run: else that of a component that asks by itself, as its id says; empty: nothing is known.
            is_connected: says whether the scheduler that was obeyed last still has its connection.
        """
        if epoch is not None and epoch.simulated and not self._simulated:
            return NOT_SIMULATED
        told = epoch.run if epoch is not None else run
        if told and self._run and told != self._run:
            return ANOTHER
        if self._obeyed is None or self._obeyed.is_followed_by(epoch, told):
            self._obeyed = epoch or self._obeyed
            return ""
        if is_connected():
            return ANOTHER
        self._obeyed = epoch
        return ""
