"""Published events beside the measurements: requests, states of processes, log lines, progress, notes."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Protocol

from afspm.basics.errors import InvalidValue
from afspm.model.requests import WAIT_FOR_CONTROL, ControlRequest, ControlResponse, Parameter
from afspm.model.state import ControlMode

SUPERVISOR = "supervisor"
"""Owner of the key that allows reports on processes. A supervisor's own name is "supervisor:" and a suffix."""
LOGGED_AS = "afspm"
"""Name of the supervisor's own log lines."""
NO_LONGER_TRUE = "no longer true: "
"""In a log line, the words before the first clause of an earlier CRITICAL line, whose cause has ended. A process logs
to its standard error, which has no field for this."""
LONGEST_ANNOUNCEMENT = 256 * 1024
"""Largest size, in bytes, of a message that the scheduler publishes for another process."""
PERSON = ":"
"""The separator between a component and the person for whom the component acts: "dashboard:Ada"."""
LONGEST_PROCESS_NAME = 100
"""In bytes: files are named after processes, on every system."""
LONGEST_NOTE = 1000
"""In characters."""
_NOT_REFUSED = (None, ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE, ControlResponse.NOT_FREE)
_PROCESS_NAME = re.compile(r"\w([\w .+-]*[\w+-])?")


def is_process_name(name: str) -> bool:
    """Return whether a name is valid for a process, as a part of file names on every system.

    It has letters, digits, `_`, `-`, `+`, and between them dots and spaces; it begins with a letter, a digit or `_`,
    and has at most `LONGEST_PROCESS_NAME` bytes.
    """
    return _PROCESS_NAME.fullmatch(name) is not None and len(name.encode()) <= LONGEST_PROCESS_NAME


def component_of(who: str) -> str:
    """Return the component in a name of the form "component:person"."""
    return who.partition(PERSON)[0]


class Role(Enum):
    """The role of a process in the experiment."""

    TRANSLATOR = "translator"
    SCHEDULER = "scheduler"
    COMPONENT = "component"


class ProcessCondition(IntEnum):
    """The condition of a process; numbers as on the wire."""

    UNDEFINED = 0
    STARTING = 1
    ALIVE = 2
    BUSY = 3
    """The process works on a step."""
    SILENT = 4
    """A heartbeat is overdue."""
    RESTARTING = 5
    ENDED = 6
    GIVEN_UP = 7


class ControlEvent(IntEnum):
    """A change of control, mode or problems, or an act at the microscope itself; numbers as on the wire."""

    UNDEFINED = 0
    STARTED = 1
    RESTARTED = 2
    CONTROL_GAINED = 3
    CONTROL_LOST = 4
    PROBLEM_FLAGGED = 5
    PROBLEM_CLEARED = 6
    MODE_CHANGED = 7
    EXPERIMENT_ENDED = 8
    BY_HAND = 9


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """One event of the run. Programs use the codes; `what` and `reason` are for people.

    Attributes:
        time_ns: experiment time, ns since the Unix epoch.
        kind: "request", "control" (holder, mode or problems changed), "order" (of a person, e.g. to restart a process)
            or, only in the record, "note".
        who: the component; "component:person" if it acts for a person.
        what: the event as text, with units.
        response: the number of a ControlResponse; None for an event without a request.
        reason: reason for the refusal of a request, or the cause of the event.
        took_s: real time from request to answer; None for an event without a request.
        event: the change, for entries of the kind "control".
        request: the number of the ControlRequest; None without a request, or for an unreadable one.
        problem: the number of the flagged or cleared problem; for a CONTROL_GAINED, of the problem to solve.
        mode: the new mode, for a MODE_CHANGED.
        late: whether the answer came after the client had received a NO_RESPONSE.
        sent_ns: time of forwarding to the translator; None for requests that the scheduler answers.
        again_ns: the time at which a refusal by a limit on time may be gone; None for other entries.
        key: key of the measurement that the request starts; empty without a key.
        subject: the action, or the parameter to set; empty for other requests.
        value, unit: value and unit of that parameter, as requested.
    """

    time_ns: int
    kind: str
    who: str
    what: str
    response: int | None = None
    reason: str = ""
    took_s: float | None = None
    event: ControlEvent = ControlEvent.UNDEFINED
    request: int | None = None
    problem: int | None = None
    mode: ControlMode | None = None
    late: bool = False
    sent_ns: int | None = None
    again_ns: int | None = None
    key: str = ""
    subject: str = ""
    value: str = ""
    unit: str = ""

    @property
    def refused(self) -> bool:
        """Return whether a request was refused.

        A request that has to wait, for control, for a busy microscope or for a limit on time, and a request without an
        answer are not. Nor is control given back twice, as a component does at its end after it has lost it: nothing
        was asked for.
        """
        waits = self.request == ControlRequest.REQUEST_CTRL and self.response in WAIT_FOR_CONTROL
        waits = waits or self.again_ns is not None
        had_none = self.request == ControlRequest.RELEASE_CTRL and self.response == ControlResponse.NOT_IN_CONTROL
        return not (waits or had_none) and self.response not in _NOT_REFUSED


@dataclass(frozen=True, slots=True)
class ProcessState:
    """The state of one process.

    Attributes:
        role: "scheduler", "translator", "component" …
        since_ns: start of this condition, experiment time.
        step_age_s: age of the current step, in real time.
        starts: number of starts.
        pid: process id of the operating system; 0 if the process is not running.
        last_exit: last end of the process, in words.
    """

    name: str
    role: str
    condition: ProcessCondition
    since_ns: int
    step_age_s: float = 0.0
    starts: int = 1
    pid: int = 0
    last_exit: str = ""


@dataclass(frozen=True, slots=True)
class ProcessStates:
    """The states of all processes of one supervisor. A run has one supervisor for each `afspm run` that takes part."""

    time_ns: int
    supervisor: str
    processes: tuple[ProcessState, ...]


@dataclass(frozen=True, slots=True)
class LogLine:
    """A log line of a process; `level` is a name of the logging module."""

    time_ns: int
    name: str
    level: str
    text: str

    @property
    def is_alarm(self) -> bool:
        """Whether the line is CRITICAL; the indented lines of a traceback belong to the line above."""
        return self.level == "CRITICAL" and not self.text[:1].isspace()

    def ends(self, alarm: LogLine) -> bool:
        """Return whether this line says that an alarm of the same process is over; see `NO_LONGER_TRUE`."""
        _, says_so, over = self.text.partition(NO_LONGER_TRUE)
        if not (says_so and over) or self.name != alarm.name or not alarm.text.startswith(over):
            return False
        return alarm.text[len(over) : len(over) + 1] in ("", ":", ";", ",")


@dataclass(frozen=True, slots=True)
class JournalEntries:
    """Entries that a scheduler publishes together, oldest first."""

    entries: tuple[JournalEntry, ...]


@dataclass(frozen=True, slots=True)
class LogLines:
    """Log lines that a supervisor sends together, oldest first."""

    lines: tuple[LogLine, ...]


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of the component `name` with its task.

    Progress is no journal entry: its entries would hide the events, and only the last of each component matters.

    Attributes:
        done, of: number of finished parts, and of all parts.
        left_s: experiment time until the end at the present rate; None if unknown.
    """

    time_ns: int
    name: str
    done: int
    of: int
    left_s: float | None = None

    def remaining_ns(self, now_ns: int) -> int | None:
        """Return the remaining experiment time in ns at the moment `now_ns`; 0 once overdue, None if unknown."""
        return None if self.left_s is None else max(0, round(self.left_s * 1e9) - max(0, now_ns - self.time_ns))


class HasTime(Protocol):
    """A measurement with the time of its end, ns since the Unix epoch; None if unknown."""

    @property
    def time_ns(self) -> int | None: ...


@dataclass(frozen=True, slots=True)
class Note:
    """A remark of a person or a component on a scan or a moment.

    Attributes:
        time_ns: the moment that the note is about; for a scan, the time of its end.
        who: the author; "component:person" if a person wrote the note.
        scan_ns: the scan of the note, as in `Scan.time_ns`; None if the note is not about a scan.
        written_ns: time of writing, experiment time; real time after the end of the experiment.

    Raises:
        InvalidValue: the text is empty or too long, or has control characters besides line feeds and tabs.
    """

    time_ns: int
    who: str
    text: str
    scan_ns: int | None = None
    written_ns: int | None = None

    def __post_init__(self) -> None:
        if not self.text.strip():
            raise InvalidValue("the note has no text", hint="write what happened")
        if len(self.text) > LONGEST_NOTE:
            raise InvalidValue(f"the note has {len(self.text)} characters", hint=f"at most {LONGEST_NOTE}")
        if strange := [c for c in self.text if unicodedata.category(c) in ("Cc", "Cs") and c not in "\n\t"]:
            raise InvalidValue(f"the note has the control character {strange[0]!r}", hint="leave it out")


@dataclass(frozen=True, slots=True)
class MeasurementSettings:
    """The parameters that a component has set for its next scan or spectrum, as the microscope reports them.

    Attributes:
        who: the component.
        parameters: empty if the component's next measurements are not part of a sweep.
        key: key of the measurement; empty without a key.
        point: number of the sweep's point, from 1 in the order of measurement; None outside of a sweep.
    """

    time_ns: int
    who: str
    parameters: tuple[Parameter, ...] = ()
    key: str = ""
    point: int | None = None


@dataclass(frozen=True, slots=True)
class RelayedMessage:
    """A serialised message that the scheduler publishes for another process.

    The message is a ProcessStates, LogLines, Progress, MeasurementSettings, Note, Proposal or InstrumentReadings. Its
    envelope is the name of the message. For ProcessStates, Progress and InstrumentReadings "_" follows, and the name of
    the supervisor, component or instrument.
    """

    message: str
    payload: bytes
