"""Blocking code in simulated time: each process has its own thread, and only the thread with the baton runs.

The simulation passes the baton to a thread. The thread returns the baton when it waits for an event or ends. So the
timeline alone determines the order of events, and blocking code is reproducible.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

_LONGEST_STEP_S = 60.0


class LifeEnded(BaseException):
    """The exception raised at each wait in the code of a killed process."""


class Baton:
    """A thread of blocking code that runs only while it has the baton.

    Args:
        body: the code. An exception other than `LifeEnded` is kept in `error`.
    """

    def __init__(self, name: str, body: Callable[[], int]) -> None:
        self._body = body
        # locks as binary semaphores, since only one side runs: `threading.Semaphore` costs ten times as much
        self._to_thread, self._to_simulation = threading.Lock(), threading.Lock()
        self._to_thread.acquire()
        self._to_simulation.acquire()
        self._killed = False
        self.over = False
        self.code: int | None = None
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    # --- on the side of the simulation ---

    def go_on(self) -> None:
        """Run the code until it waits again or ends.

        Raises:
            TimeoutError: the code neither waits nor ends within a minute of real time.
        """
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

    def abandon(self) -> None:
        """End the code where it waits, from any thread, without waiting for the end of its own thread."""
        if not (self._killed or self.over):
            self._killed = True
            self._to_thread.release()

    # --- on the side of the code ---

    def wait(self) -> None:
        """Return the baton to the simulation, and wait until it comes back."""
        if self._killed:
            raise LifeEnded
        self._to_simulation.release()
        self._to_thread.acquire()
        if self._killed:
            raise LifeEnded

    def die(self) -> None:
        """End the simulated process at once, from its own code."""
        self._killed = True
        raise LifeEnded

    def _run(self) -> None:
        self._to_thread.acquire()
        try:
            if not self._killed:
                self.code = self._body()
        except LifeEnded:
            self.code = None
        except BaseException as error:  # the simulation raises it in its own thread, where a test sees it
            self.error = error
        self.over = True
        self._to_simulation.release()
