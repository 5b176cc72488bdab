"""The table `drift` of the experiment file."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.basics.plain_data import Plain
from afspm.basics.units import Duration, Length

_STRICT = {"extra": "forbid"}


@dataclass(frozen=True)
class RescanRule:
    """When the Rescanner is asked to take a scan again.

    Attributes:
        rule: "tolerance": the sample was found further off than `tolerance`, with two standard deviations of that
            added; "paper": what the scan and the region it was meant for share is less than `f_rescan`; "never".
        tolerance: None: a tenth of the scan's smaller side.
        f_rescan: part of the area (paper, "Overarching workflow").
    """

    rule: Literal["tolerance", "paper", "never"] = "tolerance"
    tolerance: Length | None = None
    f_rescan: float = 0.75

    __pydantic_config__: ClassVar[object] = _STRICT

    def __post_init__(self) -> None:
        if self.tolerance is not None and not self.tolerance > 0.0:
            raise InvalidValue(f"tolerance = {self.tolerance} m is not above zero", where="rescan")
        if not 0.0 <= self.f_rescan <= 1.0:
            raise InvalidValue(f"f_rescan = {self.f_rescan} is not a part of an area", where="rescan", hint="0 to 1")


@dataclass(frozen=True)
class Compensate:
    """Parameters of the controller by which it moves the tip along by itself, in m/s."""

    x: str
    y: str

    __pydantic_config__: ClassVar[object] = _STRICT


@dataclass(frozen=True)
class DriftCompensationSettings:
    """The settings by which drift is followed and corrected.

    Attributes:
        estimator, tracker: a name, or a table with the name as its `class` and the settings of it.
        channel: of the scans that are compared; None: the first that is published in a unit of length.
        correct: whether components are given sample coordinates; else drift is followed and told, and nothing changed.
        correct_after: since the start of the experiment; until then as if `correct` were false.
        rescan: when a scan is taken again.
        most_unregistered: share of the last ten scans that may lie where they were predicted, since they were not
            recognised or could not be registered; above it thermal-drift is flagged. 1: never.
        at_start: "up-down": the first scan is followed by one in the other direction, which tells the velocity, where
            a component solves thermal-drift and the microscope reports its direction; "nothing": it is not.
        compensate: hands the velocity over to a controller that compensates by itself.
        longest_registration: for how long (real) what the microscope publishes waits for a scan to be registered.
    """

    estimator: str | Plain = "least-squares"
    tracker: str | Plain = "bank"
    channel: str | None = None
    correct: bool = True
    correct_after: Duration = 0.0
    rescan: RescanRule = field(default_factory=RescanRule)
    most_unregistered: float = 0.5
    at_start: Literal["up-down", "nothing"] = "up-down"
    compensate: Compensate | None = None
    longest_registration: Duration = 30.0

    __pydantic_config__: ClassVar[object] = _STRICT

    def __post_init__(self) -> None:
        for name in ("correct_after", "longest_registration"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InvalidValue(f"{name} = {value} s is not zero or more", where="drift")

        if not 0.0 <= self.most_unregistered <= 1.0:
            said = f"most_unregistered = {self.most_unregistered} is not a share"
            raise InvalidValue(said, where="drift", hint="0 to 1")

    def beside(self, solved: Collection[str]) -> DriftCompensationSettings:
        """Return these settings for a run whose components solve these problems: without a component that scans again,
        the first scan is taken in one direction."""
        return self if "thermal-drift" in solved else replace(self, at_start="nothing")

    @classmethod
    def from_table(cls, table: Plain) -> DriftCompensationSettings:
        """Out of plain JSON, already in SI.

        Raises:
            ConfigError, InvalidValue: an unknown setting, or a value that can't be.
        """
        plain = dict(table)
        try:
            if isinstance(rescan := plain.get("rescan"), dict):
                plain["rescan"] = RescanRule(**rescan)
            if isinstance(compensate := plain.get("compensate"), dict):
                plain["compensate"] = Compensate(**compensate)
            return cls(**plain)
        except TypeError as error:
            raise ConfigError(f"the table can't be used: {error}", where="drift") from error
