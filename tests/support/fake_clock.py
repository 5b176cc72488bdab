"""A clock that goes when a test says so."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext


class FakeClock:
    """Stands still at `t_s`, experiment time and real time in one, until that is changed."""

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

    def late(self) -> AbstractContextManager[None]:
        return nullcontext()
