"""What the dashboard knows: written by the component's thread, read by the page's."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from afspm.clock import Clock
from afspm.dashboard.frames import FrameStore
from afspm.dashboard.levelling import Array
from afspm.dashboard.spectra import SpectrumStore
from afspm.model import ProblemNames, Scan, ScanLines, ScopeState, Spectrum
from afspm.record.overview import Overview

OLD_AFTER_S = 8.0  # a supervisor tells of its processes every 2 s


class Watch:
    """The overview, the newest pictures and spectra, and when anything was heard last.

    Args:
        clock: of the experiment.
        past: what was so before; None: nothing is known of that.
        cut_off: what to say if nobody runs it any more; it gives an empty text if somebody does.
    """

    def __init__(
        self,
        clock: Clock,
        problems: ProblemNames | None = None,
        past: Overview | None = None,
        cut_off: Callable[[], str] = str,
    ) -> None:
        self.clock = clock
        self.problems = problems or ProblemNames()
        self.cut_off = cut_off
        self.overview = past or Overview(self.problems)
        self.frames = FrameStore()
        self.spectra = SpectrumStore()
        self.tip_to_sample: Array | None = None
        """The newest mapping of drift, 2 x 3; None where nobody corrects drift."""
        self.connected = False
        self.ended = False
        self.changes = 0
        self._heard_s = clock.monotonic_s()
        self._changed = threading.Condition()
        self._bells: list[Callable[[], None]] = []

    @contextmanager
    def reading(self) -> Iterator[Overview]:
        """Nothing changes while in the block; be brief in it."""
        with self._changed:
            yield self.overview

    def take(self, message: str, thing: Any, time_ns: int, envelope: str = "") -> None:
        """Something was published."""
        with self._changed:
            self.overview.take(message, thing, time_ns, envelope)
            if isinstance(thing, Scan):
                self.frames.take_scan(thing, time_ns)
            elif isinstance(thing, ScanLines):
                self.frames.take_lines(thing)
            elif isinstance(thing, Spectrum):
                self.spectra.take(thing, time_ns)
            elif message == "DriftMapping":
                self.tip_to_sample = _matrix(thing)
            self._heard_s = self.clock.monotonic_s()
            self.connected = True
            self._announce()

    def tell(self, *, connected: bool | None = None, ended: bool | None = None) -> None:
        """How it is with the connection to the scheduler."""
        with self._changed:
            before = (self.connected, self.ended)
            self.connected = self.connected if connected is None else connected
            self.ended = self.ended if ended is None else ended
            if (self.connected, self.ended) != before:
                self._announce()

    def silent_s(self) -> float:
        """Real seconds since anything was heard."""
        return self.clock.monotonic_s() - self._heard_s

    def on_change(self, bell: Callable[[], None]) -> None:
        """`bell` is called after each change, in the thread that brings it; it must not wait for anything."""
        self._bells.append(bell)

    def wait_for(self, condition: Callable[[Overview], bool], within_s: float) -> bool:
        """Wait in another thread until `condition`; False when the time is up."""
        with self._changed:
            return self._changed.wait_for(lambda: condition(self.overview), within_s)

    def wait_free(self, within_s: float) -> bool:
        """Wait until the microscope says that it is free."""
        return self.wait_for(lambda o: o.status is not None and o.status.state is ScopeState.FREE, within_s)

    def _announce(self) -> None:
        self.changes += 1
        self._changed.notify_all()
        for bell in self._bells:
            bell()


def _matrix(mapping: Any) -> Array | None:
    if len(mapping.matrix) != 6 or not mapping.correcting:
        return None
    return np.array(mapping.matrix, dtype=np.float64).reshape(2, 3)
