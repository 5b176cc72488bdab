"""`Script`: the baseline of afspm's own components and a few lines for each task.

It knows the kind of each task, and nothing of its sample. Planted agents derive from it, and spoil one method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from typing import Any, Iterator

from afspm.basics.errors import Refused, RequestError
from afspm.components.tip_judge import Opinion, TipJudge
from afspm.model import Region, ScanSet, Spectrum, names
from afspm.plugins.bench import analysis
from afspm.plugins.bench.session import Session

XY = tuple[float, float]


class Script:
    """The script; one method for each task, "family_name"."""

    session: Session
    cites: list[int]

    def solve(self, session: Session) -> None:
        self.session, self.scope, self.given, self.cites = session, session.scope, session.given, []
        method: Callable[[], None] = getattr(self, session.task.replace("/", "_").replace("-", "_"))
        method()

    # --- what planted agents spoil ---

    def report(self, status: str, answer: Mapping[str, Any] | None = None, asks: tuple[str, ...] = ()) -> None:
        self.session.report(status, answer, self.cites, asks)

    def number(self, value: float, error: float) -> dict[str, float]:
        return {"value": value, "error": error}

    # --- steps ---

    def scan(self, center_m: XY, size_m: float, pixels: int, key: str | None = None) -> ScanSet:
        found = self.scope.scan(Region(tuple(center_m), (size_m, size_m)), shape=(pixels, pixels), key=key)
        self.cite(found.time_ns)
        return found

    def spectrum(self, at_m: XY, kind: str = "IV") -> Spectrum:
        found = self.scope.spectrum(tuple(at_m), kind=kind)
        self.cite(found.time_ns)
        return found

    def cite(self, time_ns: int | None) -> None:
        assert time_ns is not None
        self.cites.append(time_ns)

    @contextmanager
    def bias(self, bias_v: float) -> Iterator[None]:
        before = self.scope.get(names.TIP_BIAS_VOLTAGE)
        self.scope.set(names.TIP_BIAS_VOLTAGE, bias_v)
        yield
        self.scope.set(names.TIP_BIAS_VOLTAGE, before)

    def sleep_until(self, minutes: float) -> None:
        left = minutes - self.session.elapsed_minutes
        if left > 0:
            self.scope.sleep(left * 60.0)

    # --- operate ---

    def operate_settings(self) -> None:
        given = self.given
        with self.scope.control():
            self.scope.set_feedback(setpoint=given["setpoint_v"])
            self.scope.set(names.SCAN_SPEED, given["speed_m_s"])
            self.scan(given["scans"][0], given["size_m"], given["pixels"])
        self.report("done")

    def operate_places(self) -> None:
        for center_m in self.given["scans"]:
            self.scan(center_m, self.given["size_m"], self.given["pixels"])
        self.report("done")

    def operate_curves(self) -> None:
        for point in self.given["points"]:
            self.spectrum(point, self.given["kind"])
        self.report("done")

    def operate_restore(self) -> None:
        speed = self.scope.get(names.SCAN_SPEED)
        with self.scope.control(), self.bias(self.given["bias_v"]):
            self.scope.set(names.SCAN_SPEED, self.given["speed_m_s"])
            self.scan(self.given["scans"][0], self.given["size_m"], self.given["pixels"])
            self.scope.set(names.SCAN_SPEED, speed)
        self.report("done")
