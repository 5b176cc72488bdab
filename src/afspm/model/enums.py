"""The enumerations of the wire, with its numbers. Where peers may send others (problems), plain ints are kept."""

from __future__ import annotations

from enum import IntEnum


class ScopeState(IntEnum):
    """The states of a microscope."""

    UNDEFINED = 0
    MOVING = 1
    SCANNING = 2
    FREE = 3
    INTERRUPTED = 4
    COARSE_MOTOR = 5
    BUSY_PARAM = 6
    SPEC = 7


class ControlMode(IntEnum):
    """Components control the microscope (AUTOMATED), or only the person at it (MANUAL)."""

    UNDEFINED = 0
    MANUAL = 1
    AUTOMATED = 2


class Problem(IntEnum):
    """Problems of an experiment. Experiment files name more of them, with numbers above these."""

    NONE = 0
    TIP_SHAPE_CHANGED = 1
    DEVICE_MALFUNCTION = 2
    FEEDBACK_NON_OPTIMAL = 3
    THERMAL_DRIFT = 4


class ControlRequest(IntEnum):
    """The requests to scheduler and translator."""

    UNDEFINED = 0
    ACTION = 1
    PARAM = 2
    SET_SCAN_PARAMS = 3
    SET_ZCTRL_PARAMS = 4
    SET_PROBE_POS = 5
    REQUEST_CTRL = 6
    RELEASE_CTRL = 7
    ADD_EXP_PRBLM = 8
    RMV_EXP_PRBLM = 9
    SET_CONTROL_MODE = 10
    END_EXPERIMENT = 11
    ACTION_SUPPORT = 12


CLOCK_REQUEST = 101
"""A request of ours, not in version 1: what time it is in the experiment."""
RELAY_REQUEST = 102
"""A request of ours, not in version 1: a supervisor has something to publish; its answer are orders to it."""
RESTART_REQUEST = 103
"""A request of ours, not in version 1: a process is to be started anew; its subject is the process's name."""

OTHER_RUN_RESPONSE = 100
"""A response of ours, not in version 1, and only to those who named their run: it is not that of the scheduler."""

_OURS = {CLOCK_REQUEST: "CLOCK", RELAY_REQUEST: "TELL", RESTART_REQUEST: "RESTART"}


def request_name(kind: int) -> str:
    """Return a request in words."""
    known = next((request.name for request in ControlRequest if request == kind), None)
    return known or _OURS.get(kind, f"request {kind}")


class ControlResponse(IntEnum):
    """The answers to a request."""

    SUCCESS = 0
    FAILURE = 1
    CMD_NOT_SUPPORTED = 2
    NO_RESPONSE = 3
    ALREADY_UNDER_CONTROL = 4
    WRONG_CONTROL_MODE = 5
    NOT_IN_CONTROL = 6
    NOT_FREE = 7
    PARAM_NOT_SUPPORTED = 8
    PARAM_ERROR = 9
    WRONG_EXP_PROBLEM = 10
    ACTION_NOT_SUPPORTED = 11
    ACTION_ERROR = 12


class RescanKind(IntEnum):
    """Requests to a Rescanner; a message of ours."""

    AGAIN = 1
    """The same region."""
    OPPOSITE = 2
    """In the other direction of the slow axis."""
    SEARCH = 3
    """A wider region, until the sample is found."""
