"""States of the microscope and of the experiment."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from afspm.model.geometry import XY


class _NamedEnum(IntEnum):
    """An enumeration that is shown by its names."""

    def __str__(self) -> str:
        return self.name


class ScopeState(_NamedEnum):
    """The states of a microscope."""

    UNDEFINED = 0
    MOVING = 1
    SCANNING = 2
    FREE = 3
    INTERRUPTED = 4
    COARSE_MOTOR = 5
    BUSY_PARAM = 6
    SPEC = 7


class ControlMode(_NamedEnum):
    """Components control the microscope (AUTOMATED), or only the person at it (MANUAL)."""

    UNDEFINED = 0
    MANUAL = 1
    AUTOMATED = 2


@dataclass(frozen=True)
class ScopeStatus:
    """The activity of the microscope.

    Attributes:
        paused: a scan is running but stands still; None if the microscope does not say.
    """

    state: ScopeState
    paused: bool | None = None


@dataclass(frozen=True)
class Feedback:
    """The z feedback. None is what is not said, or in a request not to be changed.

    Attributes:
        on: whether it acts.
        proportional_gain, integral_gain, setpoint: in the units of the microscope's operating mode.
    """

    on: bool | None = None
    proportional_gain: float | None = None
    integral_gain: float | None = None
    setpoint: float | None = None


@dataclass(frozen=True)
class ProbePosition:
    """Where the probe stands when it does not scan: (x, y) in m, tip coordinates unless a component maps them."""

    xy_m: XY


@dataclass(frozen=True)
class PositionChange:
    """Part of a probe position, as a request may give it: None is not to be changed. In m."""

    x_m: float | None = None
    y_m: float | None = None


@dataclass(frozen=True)
class ControlState:
    """The holder of control, and the problems that stand in the way.

    Attributes:
        mode: automated or manual.
        holder: the name of the component in control; None if nobody is.
        problems: the numbers of the problems that are flagged, ascending.
    """

    mode: ControlMode = ControlMode.AUTOMATED
    holder: str | None = None
    problems: tuple[int, ...] = ()
