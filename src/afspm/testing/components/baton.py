"""Code that blocks, in simulated time: each runs in a thread of its own, and only who has the baton runs.

The simulation gives the baton to a thread and waits until the thread gives it back, by waiting for something or by
ending. So there is one order of events, which the timeline alone decides, and blocking code replays as exactly as any
other.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

_LONGEST_STEP_S = 60.0


class LifeEnded(BaseException):
    """This life has ended: raised wherever the code waits, as often as it tries to."""


class Baton:
    """One thread of blocking code.

    Args:
        body: the code. What it raises, but for `LifeEnded`, is kept in `error`.
    """

    def __init__(self, name: str, body: Callable[[], int]) -> None:
        self._body = body
        self._to_thread = threading.Semaphore(0)
        self._to_simulation = threading.Semaphore(0)
        self._killed = False
        self.over = False
        self.code: int | None = None
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    # --- on the side of the simulation ---

    def go_on(self) -> None:
        """Let the code run until it waits again, or ends."""
        if self.over:
            return
        self._to_thread.release()
        if not self._to_simulation.acquire(timeout=_LONGEST_STEP_S):
            raise TimeoutError(f"{self._thread.name} neither waits nor ends: it blocks on something else")
        if self.over:
            self._thread.join()

    def kill(self) -> None:
        """End the code where it waits."""
        self._killed = True
        while not self.over:
            self.go_on()

    # --- on the side of the code ---

    def wait(self) -> None:
        """Give the baton back, until it comes again."""
        if self._killed:
            raise LifeEnded
        self._to_simulation.release()
        self._to_thread.acquire()
        if self._killed:
            raise LifeEnded

    def die(self) -> None:
        """End this life here and now."""
        self._killed = True
        raise LifeEnded

    def _run(self) -> None:
        self._to_thread.acquire()
        try:
            if not self._killed:
                self.code = self._body()
        except LifeEnded:
            self.code = None
        except BaseException as error:
            self.error = error
        self.over = True
        self._to_simulation.release()
