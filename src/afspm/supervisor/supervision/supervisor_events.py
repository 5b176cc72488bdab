"""Events that the supervisor decides on, and effects that result."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from enum import Enum, auto

from afspm.basics.exit_codes import ExitCode
from afspm.basics.own_fault import OwnFault
from afspm.supervisor.supervision.child import HeartbeatReport


@dataclass(frozen=True, slots=True)
class RunBegan:
    """The event that the run begins: all processes start."""


@dataclass(frozen=True, slots=True)
class ProcessStarted:
    """The event that the operating system has created the process."""

    name: str
    pid: int


@dataclass(frozen=True, slots=True)
class StartFailed:
    """The event that the operating system could not create the process."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class Beaten:
    """The event that a heartbeat arrived."""

    name: str
    report: HeartbeatReport


@dataclass(frozen=True, slots=True)
class ActivitySeen:
    """The event that the activity of a process without heartbeats was sampled; `works` is None if unknown.

    Attributes:
        processor_s: processor time used since the process started; None: unknown.
    """

    name: str
    works: bool | None
    processor_s: float | None = None


@dataclass(frozen=True, slots=True)
class Exited:
    """The exit of a child; a negative code is the number of the signal that ended it, as in `subprocess`."""

    name: str
    pid: int
    code: int
    last_error: str = ""
    fault: OwnFault | None = None


@dataclass(frozen=True, slots=True)
class EndSignal:
    """The signal of a person, or of the system, to end the run."""

    number: int

    @property
    def name(self) -> str:
        return "Ctrl-C" if self.number == signal.SIGINT else signal.Signals(self.number).name


@dataclass(frozen=True, slots=True)
class RestartOrdered:
    """The order of a person to restart a process."""

    name: str


@dataclass(frozen=True, slots=True)
class SchedulerAnswered:
    """The event that the scheduler of this run has answered, so that components may send requests."""


@dataclass(frozen=True, slots=True)
class UseReported:
    """The scheduler's answer about the use of the microscope: the reason `why`; empty if not in use."""

    why: str


@dataclass(frozen=True, slots=True)
class EndRefused:
    """The scheduler's refusal to end the experiment."""

    why: str


@dataclass(frozen=True, slots=True)
class TimePassed:
    """The event that time has passed, so that deadlines are checked."""


SupervisorEvent = (
    RunBegan
    | ProcessStarted
    | StartFailed
    | Beaten
    | ActivitySeen
    | Exited
    | EndSignal
    | RestartOrdered
    | SchedulerAnswered
    | UseReported
    | EndRefused
    | TimePassed
)


class ProcessAction(Enum):
    """An action of the supervisor on a process."""

    START = auto()
    """`ProcessStarted` or `StartFailed` follows."""
    KILL = auto()
    """Kill the process, and the processes that it has started."""
    CLOSE_INPUT = auto()
    """Ask the process to end, by closing its standard input."""
    ABANDON = auto()
    """Stop waiting for the process, which can't be killed."""


@dataclass(frozen=True, slots=True)
class ProcessCommand:
    """The effect that carries out an action on a process."""

    action: ProcessAction
    name: str


@dataclass(frozen=True, slots=True)
class ReleaseComponents:
    """The effect that sends the waiting components their launch lines, so that they begin."""


@dataclass(frozen=True, slots=True)
class AskUse:
    """The effect that asks the scheduler if the microscope is in use; `UseReported` is the answer."""


@dataclass(frozen=True, slots=True)
class EndExperiment:
    """The effect that asks the scheduler to end the experiment; `EndRefused` follows a refusal."""


@dataclass(frozen=True, slots=True)
class WriteLog:
    """The effect that logs a line under the name of a process; `level` is a name of `logging`."""

    name: str
    level: str
    text: str


SupervisorEffect = ProcessCommand | ReleaseComponents | AskUse | EndExperiment | WriteLog


_EXIT_REASONS = {
    ExitCode.DONE: "done",
    ExitCode.CRASHED: "crashed",
    ExitCode.OWN_FAULT: "crashed",
    ExitCode.CONFIG: "its settings can't work",
    ExitCode.ENDED: "ended with the experiment",
    ExitCode.ORPHAN: "ended as it was asked to",
}


_WINDOWS_REASONS = {
    0xC0000005: "access violation",
    0xC0000017: "out of memory",
    0xC00000FD: "stack overflow",
    0xC0000135: "a DLL is missing",
    0xC000013A: "its console was closed",
    0xC0000374: "damaged heap",
    0xC0000409: "aborted",
}
"""Exit codes of Windows itself that occur in practice; they correspond to signals elsewhere."""


def describe_exit(code: int) -> str:
    """Return an exit code as text for people, such as "killed by SIGKILL"."""
    if code in _WINDOWS_REASONS:
        return f"killed by Windows: {_WINDOWS_REASONS[code]} (0x{code:08X})"
    if code < 0:
        try:
            return f"killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"killed by signal {-code}"
    return next((words for known, words in _EXIT_REASONS.items() if known == code), f"exit code {code}")
