"""Clock of a run: experiment time, which a simulation may start at any date and run faster than real time.

Timestamps, scan durations and periods are in experiment time. Heartbeats, request timeouts and other times that
concern processes are in real time: `monotonic_s`.
"""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache, cached_property
from pathlib import Path
from typing import Protocol, Self

from afspm.basics.errors import ConfigError
from afspm.basics.plain_data import PlainMapping
from afspm.basics.shared_time import Publication, SharedSimulationTime, SharedTime, TimeHold, opened

NS_PER_S = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def utc_time(time_ns: int) -> datetime:
    """Return a time in ns since the Unix epoch as a datetime, exact to the microsecond.

    `datetime.fromtimestamp` refuses times before the epoch on Windows.
    """
    return _EPOCH + timedelta(microseconds=time_ns // 1000)


def iso_utc(time_ns: int | None) -> str:
    """Return a time in ns since the Unix epoch as ISO 8601 in UTC, to the microsecond; "" for None."""
    if time_ns is None:
        return ""
    return f"{utc_time(time_ns):%Y-%m-%dT%H:%M:%S.%f}Z"


class Clock(Protocol):
    """Interface of a run's clock."""

    def now_ns(self) -> int:
        """Return the experiment time in ns since the Unix epoch."""
        ...

    def now_s(self) -> float:
        """Return the experiment time in s since the Unix epoch."""
        ...

    def monotonic_s(self) -> float:
        """Return real time in s that never jumps, from an arbitrary zero: for timeouts and heartbeats."""
        ...

    def real_s(self, experiment_s: float) -> float:
        """Convert a duration from experiment time to real time, both in s."""
        ...

    def late(self, since: float | Publication | None = None) -> AbstractContextManager[None]:
        """Hold simulated time down to real time while the block runs; see `ExperimentClock.late`."""
        ...

    def passing(self) -> AbstractContextManager[None]:
        """Let simulated time pass while the block runs, although this thread is late."""
        ...

    def published(self, what: Publication) -> None:
        """Let the holds begin that begin with a publication."""
        ...

    def awaits(self, what: Publication) -> bool:
        """Return whether simulated time will wait for a receiver of a publication; see `ExperimentClock.late`."""
        ...


def _anchor_s() -> float:
    # wall-clock time at the zero of time.monotonic(): a system clock that is corrected later never makes a run jump
    return time.time() - time.monotonic()


_BOOT = Path("/proc/sys/kernel/random/boot_id")


@cache
def monotonic_id() -> str:
    """Return an id for the origin of `time.monotonic()`: this computer, its boot, and the clock that Python reads.

    All processes of one boot share the origin: Python's documentation calls the function system-wide (since 3.5; on
    macOS since 3.10). On Windows the clock that Python reads depends on the version of Python. Only Linux gives a boot
    an identity. Elsewhere the computer's name is enough, since no run passes times of this clock to another run.
    """
    boot = ""
    if sys.platform == "linux":  # Wine shows the file only to processes on its drive Z:
        with suppress(OSError):
            boot = _BOOT.read_text(encoding="ascii").strip()
    if not boot:
        import platform

        boot = platform.node()
    return f"{boot} {time.get_clock_info('monotonic').implementation}"


class NeverLate:
    """The part of a `Clock` that never waits: of real time, and of a simulation in which no process is late."""

    def late(self, since: float | Publication | None = None) -> AbstractContextManager[None]:
        return nullcontext()

    def passing(self) -> AbstractContextManager[None]:
        return nullcontext()

    def published(self, what: Publication) -> None:
        """Do nothing: no process is late."""

    def awaits(self, what: Publication) -> bool:
        return False


@dataclass(frozen=True)
class ExperimentClock:
    """Clock of a run: experiment time = start + (real time - origin) · speed.

    All processes of a run get the same origin, start and speed, and on one computer the same anchor of real time. So on
    one computer their clocks agree, whenever a process starts, and after any change of the system clock. A clock that
    waits for late processes (`waiting_in`) reads the experiment time from a shared file instead.

    Attributes:
        origin_s: real time, s since the Unix epoch, at which the run began.
        start_s: experiment time at that moment, s since the Unix epoch.
        speed: experiment seconds per real second; 1 on a real microscope.
    """

    origin_s: float = 0.0
    start_s: float = 0.0
    speed: float = 1.0
    _wall_at_zero_s: float = field(default_factory=_anchor_s, repr=False, compare=False)
    _waiting: SharedSimulationTime | None = field(default=None, repr=False, compare=False)

    @classmethod
    def real(cls) -> ExperimentClock:
        """Return a clock that shows the real time."""
        return cls()

    @classmethod
    def starting_now(cls, start_s: float | None = None, speed: float = 1.0) -> Self:
        """Return a clock that shows `start_s` (default: the real time) now and runs at `speed` from then on."""
        origin_s = time.time()
        return cls(origin_s, origin_s if start_s is None else start_s, speed)

    @classmethod
    def from_dict(cls, values: PlainMapping) -> ExperimentClock:
        """Return the clock that an `as_dict` table describes; the real-time clock for an empty table.

        Raises:
            ConfigError: the clock waits for late processes, and the table is from another computer.
        """
        if not values:
            return cls.real()
        times = (float(values["origin_s"]), float(values["start_s"]), float(values["speed"]))
        waits = values.get("waits")
        if values.get("monotonic") != monotonic_id():  # of another computer: its own system clock must do
            if waits:
                raise ConfigError(
                    "the simulated clock waits for late processes, which works on one computer only",
                    where="[clock]",
                    hint="set waits = false where the scheduler is started",
                )
            return cls(*times)
        return cls(*times, float(values["wall_at_zero_s"]), opened(waits))

    def as_dict(self) -> dict[str, object]:
        """Return the clock in JSON's types, for the other processes of the run."""
        return {
            "origin_s": self.origin_s,
            "start_s": self.start_s,
            "speed": self.speed,
            "wall_at_zero_s": self._wall_at_zero_s,
            "monotonic": monotonic_id(),
            **({"waits": str(self._waiting.path)} if self._waiting else {}),
        }

    def waiting_in(self, path: Path) -> ExperimentClock:
        """Return a clock that waits for late processes through a shared file; unchanged at speed 1 or below.

        Args:
            path: file that the processes of the run share.
        """
        if self.speed <= 1.0 or self._waiting is not None:
            return self
        return replace(self, _waiting=SharedSimulationTime.create(path, self.now_ns()))

    def late(self, since: float | Publication | None = None) -> AbstractContextManager[None]:
        """Slow the experiment's time down to real time while the block runs, for at most `LONGEST_HOLD_S`.

        Use it around work that takes computing time but no experiment time: starting a scan that is due, or
        registering a finished scan. Waits that need experiment time belong outside, or into `passing`. Without effect
        unless the clock is from `waiting_in`.

        Args:
            since: experiment time, in s, from which time is slow: for a process that sleeps until then, and may wake
                up late; or the publication from which on its receiver is late. None: at once.
        """
        return nullcontext() if self._waiting is None else self._waiting.late(self.speed, since)

    def passing(self) -> AbstractContextManager[None]:
        """Withdraw the holds of this thread while the block runs: it waits for something that takes experiment time."""
        return nullcontext() if self._waiting is None else self._waiting.passing(self.speed)

    def published(self, what: Publication) -> None:
        """Let the holds begin that begin with a publication: call it when something was published."""
        if self._waiting is not None:
            self._waiting.published(what, self.speed)

    def awaits(self, what: Publication) -> bool:
        """Return whether a receiver of a publication has declared that it is late from then on."""
        return self._waiting is not None and self._waiting.awaits(what)

    def holds(self) -> SharedTime | None:
        """Return the processes for which simulated time waits, or will wait; None if it waits for none."""
        return None if self._waiting is None else self._waiting.read()

    def hold(self) -> TimeHold | None:
        """Slow the experiment's time down as `late` does, until `drop`; None if the clock waits for no process."""
        return None if self._waiting is None else self._waiting.hold(self.speed)

    def drop(self, hold: TimeHold) -> bool:
        """Let simulated time wait no longer for a process; return False if that must be tried again."""
        return self._waiting is None or self._waiting.drop(hold, self.speed)

    def wall_ahead_s(self) -> float:
        """Return the lead of the system clock over the run's clock in s: nonzero after a clock change or a suspend."""
        return _anchor_s() - self._wall_at_zero_s

    def now_s(self) -> float:
        if self._waiting is not None:
            return self.now_ns() / NS_PER_S
        return self.start_s + (self._wall_at_zero_s + time.monotonic() - self.origin_s) * self.speed

    def now_ns(self) -> int:
        if self._waiting is not None:
            return self._waiting.now_ns(time.monotonic_ns(), self.speed)
        real_ns = time.monotonic_ns() + self._since_origin_ns
        return self._start_ns + (real_ns if self.speed == 1.0 else int(real_ns * self.speed))

    # whole nanoseconds, since float64 rounds a time since 1970 to a quarter of a microsecond; cached, since now_ns is
    # called for every packet

    @cached_property
    def _since_origin_ns(self) -> int:
        # age of the run at the zero of time.monotonic()
        return int(self._wall_at_zero_s * NS_PER_S) - int(self.origin_s * NS_PER_S)

    @cached_property
    def _start_ns(self) -> int:
        return int(self.start_s * NS_PER_S)

    def monotonic_s(self) -> float:
        return time.monotonic()

    def real_s(self, experiment_s: float) -> float:
        return experiment_s / self.speed
