"""Settings of drift compensation: the table `drift` of the experiment file."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

from afspm.basics import ConfigError, Duration, InvalidValue, Length, Plain
from afspm.model import ChannelName

_STRICT = {"extra": "forbid"}


@dataclass(frozen=True)
class RescanRule:
    """Rule for requesting rescans from the Rescanner.

    Attributes:
        rule: "tolerance": rescan if the offset of a corner plus two standard deviations exceeds `tolerance`; "paper":
            rescan if scan and requested region share less than `f_rescan`; "never".
        tolerance: largest tolerated offset, m; None: a tenth of the scan's smaller side.
        f_rescan: smallest common area, as a share of the smaller region (paper, "Overarching workflow").
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
    """Names of the controller's parameters (in m/s) for its own drift compensation."""

    x: str
    y: str

    __pydantic_config__: ClassVar[object] = _STRICT


@dataclass(frozen=True)
class DriftCompensationSettings:
    """Settings of drift tracking and correction.

    Attributes:
        estimator, tracker: a name, or a table with the name as its `class` and with its settings.
        channel: channel of the scans that are compared, by role or name; None: the topography, or where the microscope
            declares no roles, the first published channel in a unit of length.
        correct: whether components use sample coordinates; otherwise drift is only tracked and published.
        correct_after: time since the start of the experiment, s, before which `correct` has no effect.
        rescan: rule for requesting rescans.
        most_unregistered: largest share of unregistered scans among the last ten; above it thermal-drift is
            flagged. 1: no limit.
        at_start: "up-down": the first scan is followed by a scan in the other direction, which gives the velocity, if
            a component solves thermal-drift and the microscope reports its direction; "nothing": no second scan.
        compensate: parameters of a controller with its own drift compensation, which are set to the velocity; None:
            the controller does not compensate.
        longest_registration: longest real time, s, for which a scan and later packets wait for its registration.
    """

    estimator: str | Plain = "least-squares"
    tracker: str | Plain = "bank"
    channel: ChannelName | None = None
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
            reason = f"most_unregistered = {self.most_unregistered} is not a share"
            raise InvalidValue(reason, where="drift", hint="0 to 1")

    def beside(self, solved: Collection[str]) -> DriftCompensationSettings:
        """Return these settings, adapted to a run whose components solve the given problems.

        Without a component that takes rescans, the first scan is taken in one direction only.
        """
        return self if "thermal-drift" in solved else replace(self, at_start="nothing")

    @classmethod
    def from_table(cls, table: Plain) -> DriftCompensationSettings:
        """Return the settings from plain JSON with SI values.

        Raises:
            ConfigError, InvalidValue: a setting is unknown, or a value is impossible.
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
