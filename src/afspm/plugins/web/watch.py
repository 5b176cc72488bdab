"""The state of the experiment, written by the component's thread and read by the server's thread."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from afspm.basics import Clock
from afspm.components import Array, tip_verdict
from afspm.model import ChannelRoles, ProblemNames, Scan, ScanLines, ScopeState, Spectrum
from afspm.night import Overview, Plans
from afspm.plugins.web.frames import FrameStore
from afspm.record import AllowedBands

MOST_SPECTRA, SPECTRA_BYTES = 200, 64 << 20


class SpectrumStore:
    """The newest spectra, in the order of their arrival. Not thread-safe."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, Spectrum]] = deque()
        self._bytes = 0
        self._newest_ns = -1

    def take(self, spectrum: Spectrum, time_ns: int) -> None:
        """Add a published spectrum; a replayed spectrum (not newer) is ignored."""
        if time_ns <= self._newest_ns:
            return
        self._newest_ns = time_ns
        self._kept.append((spectrum.time_ns or time_ns, spectrum))
        self._bytes += spectrum.values.nbytes
        while len(self._kept) > MOST_SPECTRA or (self._bytes > SPECTRA_BYTES and len(self._kept) > 1):
            self._bytes -= self._kept.popleft()[1].values.nbytes

    def newest(self, count: int = 1) -> list[tuple[int, Spectrum]]:
        """Return the newest (time_ns, spectrum) pairs, newest last."""
        return list(self._kept)[-count:]

    def at(self, time_ns: int) -> Spectrum | None:
        """Return the spectrum of this time; None if the store does not contain it."""
        return next((spectrum for at_ns, spectrum in self._kept if at_ns == time_ns), None)


class Watch:
    """The overview, the newest pictures and spectra, and the time of the last message.

    Args:
        clock: clock of the experiment.
        past: the overview before the start; None: unknown.
        cut_off: returns a text if the experiment's processes are gone, else an empty text.
        plans: planned work of each component; None: no estimate.
        began_ns: experiment time at the start of the run; None: unknown.
        bands: required value ranges of other instruments.
    """

    def __init__(
        self,
        clock: Clock,
        problems: ProblemNames | None = None,
        past: Overview | None = None,
        cut_off: Callable[[], str] = str,
        plans: Plans | None = None,
        began_ns: int | None = None,
        bands: AllowedBands | None = None,
    ) -> None:
        self.clock = clock
        self.problems = problems or ProblemNames()
        self.cut_off = cut_off
        self._plans, self._began_ns = plans or {}, began_ns
        self._bands = bands
        self.overview = past or Overview(self.problems, bands=bands)
        self.frames = FrameStore()
        self.spectra = SpectrumStore()
        self.tip_to_sample: Array | None = None
        """The newest drift correction as a 2 x 3 matrix; None without drift correction."""
        self.connected = False
        self.ended = False
        self.changes = 0
        self._last_message_s = clock.monotonic_s()
        self._changed = threading.Condition()
        self._callbacks: list[Callable[[], None]] = []

    @property
    def moment_ns(self) -> int | None:
        """The displayed time of a recorded night; None for the present."""
        return None

    @property
    def revision(self) -> int:
        """A number that changes with a jump to another time, which invalidates earlier content."""
        return 0

    @property
    def is_over(self) -> bool:
        """Whether no process of the run is left at the displayed time."""
        return self.ended

    def expected_end_ns(self, overview: Overview, now_ns: int) -> int | None:
        """Return the experiment time of the end, estimated from plans and progress; None if unknown."""
        return overview.expected_end_ns(self._plans, self._began_ns, now_ns)

    @contextlib.contextmanager
    def reading(self) -> Iterator[Overview]:
        """Lock the state during the `with` block; keep the block short."""
        with self._changed:
            yield self.overview

    def take(self, message: str, thing: Any, time_ns: int, envelope: str = "") -> None:
        """Process a published message."""
        # only stored here, and drawn on request: the component must read its socket before it fills
        with self._changed:
            self.overview.take(message, thing, time_ns, envelope)
            if isinstance(thing, Scan):
                self.frames.take_scan(thing, time_ns)
            elif isinstance(thing, ScanLines):
                self.frames.take_lines(thing)
            elif isinstance(thing, ChannelRoles):
                self.frames.roles = thing
            elif isinstance(thing, Spectrum):
                self.spectra.take(self.frames.roles.shown(thing), time_ns)
            elif message == tip_verdict.OF_LINES and (verdict := tip_verdict.read_line_verdict(thing)) is not None:
                self.frames.take_change(verdict.began_ns, verdict.since_row)
            elif message == "DriftMapping":
                # without correction components use tip coordinates, so the map needs no conversion
                is_mapping = len(thing.matrix) == 6 and thing.correcting
                self.tip_to_sample = np.array(thing.matrix, dtype=np.float64).reshape(2, 3) if is_mapping else None
            self._last_message_s = self.clock.monotonic_s()
            self.connected = True
            self._announce()

    def end(self) -> None:
        with self._changed:
            self.ended = True
            self._announce()

    def silent_s(self) -> float:
        """Return the real seconds since the last message."""
        return self.clock.monotonic_s() - self._last_message_s

    def on_change(self, callback: Callable[[], None]) -> None:
        """Call `callback` after each change, in the thread that makes the change; `callback` must not block."""
        self._callbacks.append(callback)

    def wait_for(self, condition: Callable[[Overview], bool], within_s: float) -> bool:
        """Wait until `condition` holds; return False after a timeout. Not for the thread that calls `take`."""
        with self._changed:
            return self._changed.wait_for(lambda: condition(self.overview), within_s)

    def wait_free(self, within_s: float) -> bool:
        """Wait until the microscope is free; return False after a timeout."""
        return self.wait_for(is_free, within_s)

    def wake(self) -> None:
        """Let all waiting threads test their conditions again."""
        with self._changed:
            self._changed.notify_all()

    def _announce(self) -> None:
        self.changes += 1
        self._changed.notify_all()
        for callback in self._callbacks:
            callback()


def is_free(overview: Overview) -> bool:
    """Return whether the microscope is free."""
    return overview.status is not None and overview.status.state is ScopeState.FREE


class Bell:
    """A thread-safe event that wakes tasks of the page's loop. Several rings wake each task once."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._event = asyncio.Event()
        self._is_ringing = False

    def attach(self) -> None:
        """Wake tasks of the running loop from now on."""
        self._loop = asyncio.get_running_loop()

    def ring(self) -> None:
        """Wake all waiting tasks. From any thread; never waits."""
        if self._loop is None or self._is_ringing:
            return
        self._is_ringing = True
        with contextlib.suppress(RuntimeError):  # the loop has just been closed
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        self._is_ringing = False
        self._event.set()
        self._event = asyncio.Event()

    async def wait(self, timeout_s: float) -> bool:
        """Wait until the bell rings; return False after a timeout."""
        try:
            await asyncio.wait_for(self._event.wait(), timeout_s)
        except TimeoutError:
            return False
        return True


class Audience:
    """A thread-safe register of open pages: the server stops once all pages show the end."""

    def __init__(self) -> None:
        self._pages: set[int] = set()
        self._changed = threading.Condition()

    def join(self, page: object) -> None:
        with self._changed:
            self._pages.add(id(page))

    def leave(self, page: object) -> None:
        """Remove a page that was closed, or that shows the end."""
        with self._changed:
            self._pages.discard(id(page))
            self._changed.notify_all()

    def wait_until_end_shown(self, within_s: float) -> bool:
        """Wait until every page shows the end; return False after a timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._pages, within_s)
