"""The one clock of a run: experiment time, which in a simulation may begin anywhere and pass faster than real time.

All time that means something in the experiment (timestamps, scan durations, periods) comes from here. Heartbeats,
request timeouts and whatever else is about processes stays in real time: `monotonic_s`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Protocol

NS_PER_S = 1_000_000_000


def iso_utc(time_ns: int | None) -> str:
    """A time, ns since the Unix epoch, as ISO 8601 in UTC, to the microsecond; empty for none."""
    if time_ns is None:
        return ""
    seconds, rest_ns = divmod(time_ns, NS_PER_S)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns // 1000:06d}Z"


class Clock(Protocol):
    """What tells the time."""

    def now_ns(self) -> int:
        """Experiment time, ns since the Unix epoch."""
        ...

    def now_s(self) -> float:
        """Experiment time, s since the Unix epoch."""
        ...

    def monotonic_s(self) -> float:
        """Real time in s that never jumps, from an arbitrary zero: for timeouts and heartbeats."""
        ...

    def real_s(self, experiment_s: float) -> float:
        """How long `experiment_s` of the experiment last in real time, in s."""
        ...


def _anchor_s() -> float:
    """Wall-clock time at the zero of time.monotonic(), so that a corrected system clock never jumps a run."""
    return time.time() - time.monotonic()


_BOOT = Path("/proc/sys/kernel/random/boot_id")


@cache
def monotonic_id() -> str:
    """What tells apart computers, boots of one computer, and clocks of one boot, by which time.monotonic() goes.

    In one boot all processes count from one zero: the function is "system-wide" by Python's documentation (since 3.5;
    on macOS since 3.10), but which of Windows' clocks it reads depends on the version of Python. Elsewhere than on
    Linux a boot has no name here: what is handed on by a run has no use after it.
    """
    try:
        boot = _BOOT.read_text(encoding="ascii").strip()
    except OSError:
        import platform

        boot = platform.node()
    return f"{boot} {time.get_clock_info('monotonic').implementation}"


@dataclass(frozen=True)
class ExperimentClock:
    """experiment time = start + (real time - origin) · speed.

    Every process of a run is given the same origin, start and speed, and, on one computer, the same anchor of real
    time: so all show the same time, whatever becomes of the clock on the wall and whenever they were started.

    Attributes:
        origin_s: real time, s since the Unix epoch, at which the run began.
        start_s: experiment time at that moment, s since the Unix epoch.
        speed: experiment seconds in a real second; 1 on a real microscope.
    """

    origin_s: float = 0.0
    start_s: float = 0.0
    speed: float = 1.0
    _wall_at_zero_s: float = field(default_factory=_anchor_s, repr=False, compare=False)

    @classmethod
    def real(cls) -> ExperimentClock:
        """The clock on the wall."""
        return cls()

    @classmethod
    def starting_now(cls, start_s: float | None = None, speed: float = 1.0) -> ExperimentClock:
        """A clock that shows `start_s` (default: the real time) now and goes at `speed` from here."""
        origin_s = time.time()
        return cls(origin_s, origin_s if start_s is None else start_s, speed)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ExperimentClock:
        """The clock that `as_dict` told of; of nothing, the one on the wall."""
        if not values:
            return cls.real()
        told = (float(values["origin_s"]), float(values["start_s"]), float(values["speed"]))
        if values.get("monotonic") != monotonic_id():  # another computer's: real time is what the wall here says
            return cls(*told)
        return cls(*told, float(values["wall_at_zero_s"]))

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it, for the other processes of the run."""
        return {
            "origin_s": self.origin_s,
            "start_s": self.start_s,
            "speed": self.speed,
            "wall_at_zero_s": self._wall_at_zero_s,
            "monotonic": monotonic_id(),
        }

    def wall_ahead_s(self) -> float:
        """By how much the clock on the wall is ahead, s: it was set since, or the computer was suspended."""
        return _anchor_s() - self._wall_at_zero_s

    def now_s(self) -> float:
        return self.start_s + (self._wall_at_zero_s + time.monotonic() - self.origin_s) * self.speed

    def now_ns(self) -> int:
        real_ns = time.monotonic_ns() + self._since_origin_ns
        return self._start_ns + (real_ns if self.speed == 1.0 else int(real_ns * self.speed))

    # float64 would round the sum to a quarter of a microsecond: in whole nanoseconds, and reckoned once

    @cached_property
    def _since_origin_ns(self) -> int:
        """How long the run had lasted at the zero of time.monotonic()."""
        return int(self._wall_at_zero_s * NS_PER_S) - int(self.origin_s * NS_PER_S)

    @cached_property
    def _start_ns(self) -> int:
        return int(self.start_s * NS_PER_S)

    def monotonic_s(self) -> float:
        return time.monotonic()

    def real_s(self, experiment_s: float) -> float:
        return experiment_s / self.speed
