"""Targets of a survey: found by the ready-made finder of particles or by a function of the user's."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from afspm.client.targets import xy_of
from afspm.errors import ConfigError
from afspm.model import Scan
from afspm.model.geometry import XY
from afspm.process.loading import find_object
from afspm.survey.targets import Target, find_particles, nearest

Finder = Callable[[Scan], Iterable[object]]


@dataclass(frozen=True)
class TargetFinder:
    """Finds targets in a survey, and each of them again in its zoom.

    Attributes:
        function: of the user, "module.name"; None: particles.
        count: at most so many.
        min_height: of a particle, in the unit of the scan; None: what stands out of the noise.
        separation_m: of two particles that are nearer, only the higher counts.
        widest_m: of the survey: a particle in a zoom may fill it, and is not ground.
        refines: whether they are found again in their zooms.
    """

    function: str | None
    count: int
    min_height: float | None
    separation_m: float
    widest_m: float
    refines: bool

    def check(self) -> None:
        """Raise ConfigError: the function is not there."""
        if self.function is not None:
            self._function(self.function)

    def targets(self, survey: Scan) -> list[Target]:
        """Return the targets in a survey, in the order in which they are to be visited."""
        if self.function is None:
            return find_particles(survey, self.count, min_height=self.min_height, separation_m=self.separation_m)
        return self._of_function(self.function, survey)[: self.count]

    def again(self, zoom: Scan, target: Target) -> XY:
        """Return where a target lies in its zoom, or where the survey showed it if it is not found there."""
        if not self.refines:
            return target.position_m
        if self.function is None:
            least = None if target.height is None else target.height / 2
            found = find_particles(zoom, min_height=least, separation_m=self.separation_m, widest_m=self.widest_m)
        else:
            found = self._of_function(self.function, zoom)
        near = nearest(found, target.position_m, min(zoom.region.size_m) / 2)
        return target.position_m if near is None else near.position_m

    def _of_function(self, path: str, scan: Scan) -> list[Target]:
        places = self._function(path)(scan)
        return [Target(xy) for place in places if all(map(math.isfinite, xy := xy_of(place)))]

    @staticmethod
    def _function(path: str) -> Finder:
        function: object = find_object(path, "targets")
        if not callable(function):
            raise ConfigError(f"{path} is not a function", where="targets", hint="it is given a Scan")
        found: Finder = function
        return found
