"""Faults on demand: what goes wrong with controllers and with the way to them."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.errors import ConfigError, Refused
from afspm.model import ControlResponse
from afspm.plain_data import Plain

KINDS = ("slow", "hang", "refuse", "lose", "crash", "half-file")


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: "slow": answers are delayed by `duration_s` of real time. "hang": the process hangs for `duration_s`
            of real time. "refuse": the controller refuses requests. "lose": answers are never sent.
            "crash": the process ends at once. "half-file": the next file is written to half, and completed after
            `duration_s` of the experiment.
        at_s: experiment seconds after the start.
        count: number of requests affected ("slow", "refuse", "lose").
    """

    kind: str
    at_s: float = 0.0
    count: int = 1
    duration_s: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"there is no fault {self.kind!r}", where="kind", hint=", ".join(KINDS))
        if self.count < 1 or self.duration_s < 0:
            raise ConfigError(f"{self} has no effect")


class Faults:
    """The faults to come and those in force.

    Args:
        scheduled: in any order.
        kept: what is in force and what has been, over a restart (a crash must not come again and again).
        start_s: experiment time that `Fault.at_s` counts from.
    """

    def __init__(self, scheduled: list[Fault], kept: Plain, start_s: float) -> None:
        self._scheduled = sorted(scheduled, key=lambda fault: fault.at_s)
        self._kept = kept
        self._start_s = start_s
        self._demanded: list[Fault] = []
        kept.setdefault("done", 0)
        kept.setdefault("armed", {})

    def next_s(self) -> float | None:
        """Experiment time of the next scheduled fault."""
        if self._demanded:
            return self._start_s
        left = self._scheduled[self._kept["done"] :]
        return self._start_s + left[0].at_s if left else None

    def due(self, now_s: float) -> Fault | None:
        """The next fault whose time has come, each once; those with a count are in force from now on."""
        if self._demanded:
            demanded = self._demanded.pop(0)
            self.arm(demanded)
            return demanded
        at_s = self.next_s()
        if at_s is None or at_s > now_s:
            return None
        fault: Fault = self._scheduled[self._kept["done"]]
        self._kept["done"] += 1
        self.arm(fault)
        return fault

    def demand(self, fault: Fault) -> None:
        """Have a fault now (after the answer to who demands it)."""
        self._demanded.append(fault)

    def arm(self, fault: Fault) -> None:
        """Put a fault that affects what comes next in force."""
        if fault.kind not in ("hang", "crash"):
            self._kept["armed"][fault.kind] = [fault.count, fault.duration_s]

    def strikes(self, kind: str) -> float | None:
        """Return the duration of the fault if the next request (or file) is affected, and count it."""
        count, duration_s = self._kept["armed"].get(kind, (0, 0.0))
        if not count:
            return None
        self._kept["armed"][kind] = [count - 1, duration_s]
        return float(duration_s)

    def maybe_refuse(self) -> None:
        """Raises Refused as long as that fault is in force."""
        if self.strikes("refuse") is not None:
            raise Refused(ControlResponse.FAILURE, "the controller refused (a simulated fault)")
