"""States of the microscope and of the experiment."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from afspm.model.geometry import XY


class _NamedEnum(IntEnum):
    """An enumeration whose members are shown by name."""

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


MEASURING = frozenset({ScopeState.SCANNING, ScopeState.SPEC})


class ControlMode(_NamedEnum):
    """The source of commands: components (AUTOMATED), or only the person at the microscope (MANUAL)."""

    UNDEFINED = 0
    MANUAL = 1
    AUTOMATED = 2


@dataclass(frozen=True)
class ScopeStatus:
    """The activity of the microscope.

    Attributes:
        paused: a scan is running but stands still; None if the microscope does not report it.
    """

    state: ScopeState
    paused: bool | None = None


@dataclass(frozen=True)
class Feedback:
    """The z feedback. A field is None if unknown, or unchanged by a request.

    Attributes:
        on: whether the feedback regulates.
        proportional_gain, integral_gain, setpoint: values in the units of the microscope's operating mode.
    """

    on: bool | None = None
    proportional_gain: float | None = None
    integral_gain: float | None = None
    setpoint: float | None = None


@dataclass(frozen=True)
class FeedbackUnits:
    """The units of the numbers of a `Feedback`; empty: without a unit, or not known."""

    proportional_gain: str = ""
    integral_gain: str = ""
    setpoint: str = ""


@dataclass(frozen=True)
class ProbePosition:
    """The position of the probe between scans: (x, y) in m.

    The position is in tip coordinates; for components of a run whose scheduler corrects drift, in sample coordinates.
    """

    xy_m: XY


@dataclass(frozen=True)
class PositionChange:
    """One axis or both of a probe position in a request, in m; None stays unchanged."""

    x_m: float | None = None
    y_m: float | None = None


@dataclass(frozen=True)
class ControlState:
    """The holder of control, and the flagged problems.

    Attributes:
        mode: automated or manual.
        holder: the name of the component in control; None if no component is.
        problems: the numbers of the flagged problems, ascending.
    """

    mode: ControlMode = ControlMode.AUTOMATED
    holder: str | None = None
    problems: tuple[int, ...] = ()
