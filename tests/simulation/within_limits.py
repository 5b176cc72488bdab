"""The invariants of limits, checked against the values really in force at the simulated microscope."""

from __future__ import annotations

import math
from collections.abc import Callable

from afspm.model import ControlRequest, Region, Request, names
from afspm.scheduler.settings import SchedulerSettings
from afspm.testing.components.simulated_time import SimulatedTime
from tests.simulation.microscope import FakeMicroscope

_SLACK = 1e-6


class WithinLimits:
    """Observes the controller itself: the places of its scan and its probe, and the size and speed of changes.

    Attributes:
        memory_is_certain: the scheduler was not killed before it could save its state.
        placed, changed: how often the microscope was set.

    Args:
        must: raises a violation if a condition does not hold.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        settings: SchedulerSettings,
        microscope: FakeMicroscope,
        must: Callable[[bool, str], None],
    ) -> None:
        self._timeline = timeline
        self._limits = settings.limits
        self._microscope = microscope
        self._must = must
        self._changed_ns: dict[str, int] = {}
        self._used: dict[str, tuple[int, str]] = {}
        self.memory_is_certain = True
        self.placed = self.changed = 0
        microscope.on_changed = self.on_changed
        microscope.on_placed = self.on_placed

    def on_placed(self) -> None:
        """Check the scan's region and the probe after one was set."""
        self.placed += 1
        self._must(self._contains(self._microscope.region), f"the scan is at {self._microscope.region}")
        self._must(self._is_inside(self._microscope.probe_m), f"the probe is at {self._microscope.probe_m}")

    def on_changed(self, name: str, before: float, now: float) -> None:
        """Check a parameter that was set."""
        self.changed += 1
        limit, change = self._limits.parameters.get(name), abs(now - before)
        since_ns, self._changed_ns[name] = self._changed_ns.get(name, 0), self._timeline.now_ns()
        if limit is None or not change:
            return
        if limit.step is not None:
            self._must(change <= limit.step * (1 + _SLACK), f"{name} jumped by {change:g} from {before:g}")
        if limit.rate_per_s is not None and self.memory_is_certain:
            allowed = limit.rate_per_s * (self._timeline.now_ns() - since_ns) / 1e9
            self._must(change <= allowed * (1 + _SLACK), f"{name} changed by {change:g}, allowed was {allowed:g}")

    def executed(self, request: Request) -> None:
        """Check a command before the microscope executes it."""
        if request.kind == ControlRequest.ACTION and request.subject == names.START_SCAN:
            self._must(self._contains(self._microscope.region), f"a scan begins at {self._microscope.region}")

    def sent(self, request: Request) -> None:
        """Count a command sent to the microscope as a use, if its interval is limited."""
        action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
        limit, now_ns = self._limits.actions.get(action), self._timeline.now_ns()
        if limit is None or limit.interval_s is None or not request.id:
            return
        before_ns, id_ = self._used.get(action, (0, ""))
        self._used[action] = (now_ns, request.id)
        # one that was refused, since a person scans, is no use
        was_done = self._microscope.executed[id_, request.kind] > 0
        is_over = now_ns - before_ns >= limit.interval_s * 1e9 or not was_done
        self._must(is_over or id_ == request.id or not self.memory_is_certain, f"{action} is sent again too soon")

    def _contains(self, region: Region) -> bool:
        return all(self._is_inside((float(x), float(y))) for x, y in region.corners_m())

    def _is_inside(self, xy_m: tuple[float, float]) -> bool:
        allowed = self._limits.region
        if allowed is None:
            return True
        cos, sin = math.cos(allowed.angle_rad), math.sin(allowed.angle_rad)
        x_m, y_m = (at - center for at, center in zip(xy_m, allowed.center_m, strict=True))
        along_m = (abs(cos * x_m + sin * y_m), abs(cos * y_m - sin * x_m))
        return all(at <= size / 2 * (1 + 2e-3) for at, size in zip(along_m, allowed.size_m, strict=True))
