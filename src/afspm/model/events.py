"""Events beside the measurements: requests, states of processes, log lines, progress."""

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
"""The name of the key that allows to report on processes; each supervisor adds ":" and a suffix of its own."""
LOGGED_AS = "afspm"
"""The name of the supervisor's own lines in the log."""
LONGEST_ANNOUNCEMENT = 256 * 1024
"""Bytes that a supervisor may send at a time."""
PERSON = ":"
"""Between a component and the person that it acts for: "dashboard:Ada"."""
LONGEST_PROCESS_NAME = 100
"""In bytes: it is also the name of files, on every system."""
LONGEST_NOTE = 1000
"""In characters."""
_NOT_REFUSED = (None, ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE, ControlResponse.NOT_FREE)
_PROCESS_NAME = re.compile(r"\w([\w .+-]*[\w+-])?")


def is_process_name(name: str) -> bool:
    """Return whether a process may be called so: letters, digits, _, -, +, dots and spaces between them."""
    return _PROCESS_NAME.fullmatch(name) is not None and len(name.encode()) <= LONGEST_PROCESS_NAME


def component_of(who: str) -> str:
    """Return the component in whose name something was asked, without the person."""
    return who.partition(PERSON)[0]


class Role(Enum):
    """The role of a process in the experiment."""

    TRANSLATOR = "translator"
    SCHEDULER = "scheduler"
    COMPONENT = "component"


class ProcessCondition(IntEnum):
    """The condition of a process; the numbers of the wire."""

    UNDEFINED = 0
    STARTING = 1
    ALIVE = 2
    BUSY = 3
    """It works on a step."""
    SILENT = 4
    """It should have been heard of."""
    RESTARTING = 5
    ENDED = 6
    GIVEN_UP = 7


class ControlEvent(IntEnum):
    """A change of control, mode or problems; the numbers of the wire."""

    UNDEFINED = 0
    STARTED = 1
    RESTARTED = 2
    CONTROL_GAINED = 3
    CONTROL_LOST = 4
    PROBLEM_FLAGGED = 5
    PROBLEM_CLEARED = 6
    MODE_CHANGED = 7
    EXPERIMENT_ENDED = 8


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """Something that happened. Programs go by the codes; `what` and `reason` are for people.

    Attributes:
        time_ns: experiment time, ns since the Unix epoch.
        kind: "request", "control" (holder, mode or problems changed) or "order" (of a person, to start anew …).
        who: the component; "component:person" where it acts for one.
        what: in words, with units.
        response: the number of a ControlResponse; None where nothing was asked.
        reason: why it was refused, or why it happened.
        took_s: real, from the question to the answer; None where nothing was asked.
        event: what changed, of the kind "control".
        request: the number of the ControlRequest that was asked; None where nothing was, or it could not be read.
        problem: the number of the problem that was flagged, cleared or is to be solved.
        mode: the new mode, of a MODE_CHANGED.
        late: the answer came after the client had been told that there was none.
        sent_ns: when it was passed on to the translator; None where it was not.
        key: of a measurement that is taken exactly once.
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
    key: str = ""

    @property
    def refused(self) -> bool:
        """True if it was asked for, and the answer was no.

        To wait for control or for a busy microscope, and to get no answer, is not to be refused.
        """
        waits = self.request == ControlRequest.REQUEST_CTRL and self.response in WAIT_FOR_CONTROL
        return not waits and self.response not in _NOT_REFUSED


@dataclass(frozen=True, slots=True)
class ProcessState:
    """The state of one process.

    Attributes:
        role: "scheduler", "translator", "component" …
        since_ns: since when it is in this condition, experiment time.
        step_age_s: real, for how long it has been working on its step.
        starts: how often it was started.
        pid: of the operating system; 0 if there is none.
        last_exit: how it ended last, in words.
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
    """All processes of one supervisor, of which there is one on each computer."""

    time_ns: int
    supervisor: str
    processes: tuple[ProcessState, ...]


@dataclass(frozen=True, slots=True)
class LogLine:
    """Something that a process said; `level` is a name of the logging module."""

    time_ns: int
    name: str
    level: str
    text: str


@dataclass(frozen=True, slots=True)
class JournalEntries:
    """Some that happened, oldest first; what a scheduler publishes at a time."""

    entries: tuple[JournalEntry, ...]


@dataclass(frozen=True, slots=True)
class LogLines:
    """Some that were said, oldest first; what a supervisor tells at a time."""

    lines: tuple[LogLine, ...]


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of the component `name` with what it set out to do.

    Attributes:
        done, of: how many of how many, of whatever it counts.
        left_s: experiment time that the rest will take, if it goes on as it does; None if it does not say.
    """

    time_ns: int
    name: str
    done: int
    of: int
    left_s: float | None = None

    def remaining_ns(self, now_ns: int) -> int | None:
        """Return how long it will still take, told now; None if it does not say."""
        return None if self.left_s is None else max(0, round(self.left_s * 1e9) - max(0, now_ns - self.time_ns))


class HasTime(Protocol):
    """Something that was measured, and says when it was finished; None if it does not know."""

    @property
    def time_ns(self) -> int | None: ...


@dataclass(frozen=True, slots=True)
class Note:
    """A remark of a person, or of a component, on a scan or on a moment.

    Attributes:
        time_ns: the moment that it is about; of a scan: when that was finished.
        who: the author; "component:person" where a person wrote it.
        scan_ns: of the scan that it belongs to, as in `Scan.time_ns`; None: it belongs to none.
        written_ns: when it was written, experiment time; after the end of the experiment real time.

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
        parameters: none: its next measurements are not part of a sweep.
        key: of the measurement, if it is taken exactly once.
    """

    time_ns: int
    who: str
    parameters: tuple[Parameter, ...] = ()
    key: str = ""


@dataclass(frozen=True, slots=True)
class RelayedMessage:
    """A message that the scheduler publishes for others: ProcessStates and LogLines of a supervisor, Progress,
    MeasurementSettings, Note.

    Its envelope is the message's name, for ProcessStates and Progress followed by "_" and whose it is.
    """

    message: str
    payload: bytes
