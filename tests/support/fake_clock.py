"""A clock set by the test."""

from __future__ import annotations

from afspm.basics.clock import NeverLate


class FakeClock(NeverLate):
    """Stays at `t_s`, for experiment time and real time, until the test changes it."""

    def __init__(self, t_s: float = 1000.0) -> None:
        self.t_s = t_s

    def now_s(self) -> float:
        return self.t_s

    def now_ns(self) -> int:
        return int(self.t_s * 1e9)

    def monotonic_s(self) -> float:
        return self.t_s

    def real_s(self, experiment_s: float) -> float:
        return experiment_s
