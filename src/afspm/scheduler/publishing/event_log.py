"""The event log: requests with their answers, changes of control, and orders; published in batches.

Adding an entry must not delay an answer, so entries are put into words only when they are published.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from afspm.basics.frozen import replace
from afspm.model import (
    CLOCK_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ActByHand,
    ControlEvent,
    ControlRequest,
    ControlResponse,
    JournalEntries,
    JournalEntry,
    Parameter,
    ProblemNames,
    Request,
    Response,
    names,
)
from afspm.model.sessions import key_of
from afspm.scheduler.control.arbitration import ArbitrationState, ControlInput, Transition
from afspm.scheduler.control.descriptions import request_text

PERIOD_S = 0.1
"""Real time from the first entry of a batch to its publication. A kill of the scheduler loses at most this time of
entries; control, mode and problems are saved before they are announced."""
MOST = 1000
"""The largest number of entries gathered within `PERIOD_S`; further requests are only counted."""
LONGEST = 1000
"""The longest text of a request or a reason, in characters."""

REQUEST, CONTROL, ORDER = "request", "control", "order"
LATE = "late: the client had got no answer in time"
"""The reason logged with an answer that came after the client had got "no response"."""
SCHEDULER = "scheduler"
"""The author of requests of the scheduler itself."""
_UNWRITTEN = frozenset({CLOCK_REQUEST, RELAY_REQUEST})  # sent all the time by supervisors and starting processes
# with the treatments of a tip: a kill must not lose a pulse, and its repetitions must not look like other pulses
_STARTS = frozenset({names.START_SCAN, names.START_SPEC, *names.TREATMENTS})
_STARTS_KEPT = 16
"""Number of starts kept over a restart: many more than can be forwarded while one entry waits to be published."""
_CUT_OFF = "the scheduler was restarted before the answer was written down"


class AnsweredRequest(NamedTuple):
    """A request with its answer, before the log entry is put into words.

    Attributes:
        time_ns: the experiment time of the answer.
        took_s: real time from the request to its answer.
        late: whether the answer came after the client had got "no response".
        sent_ns: the experiment time of forwarding to the translator; None if not forwarded.
    """

    time_ns: int
    who: str
    request: Request
    response: Response
    took_s: float
    late: bool = False
    sent_ns: int | None = None

    def entry(self, problems: ProblemNames) -> JournalEntry:
        kind = ORDER if self.request.kind == RESTART_REQUEST else REQUEST
        what = request_text(self.request, problems)[:LONGEST]
        reason = "; ".join(filter(None, (LATE if self.late else "", self.response.reason[:LONGEST])))
        subject, value, unit = _subject_of(self.request)
        flags = (ControlRequest.ADD_EXP_PRBLM, ControlRequest.RMV_EXP_PRBLM)
        return JournalEntry(
            self.time_ns,
            kind,
            self.who,
            what,
            self.response.code,
            reason,
            self.took_s,
            request=self.request.kind,
            problem=int(self.request.subject or 0) if self.request.kind in flags else None,
            late=self.late,
            sent_ns=self.sent_ns,
            again_ns=self.response.again_ns,
            key=key_of(self.who, self.request.id),
            subject=subject,
            value=value,
            unit=unit,
        )


def _subject_of(request: Request) -> tuple[str, str, str]:
    # the action, or the parameter that was to be set, with its value and unit
    asked = request.subject
    if request.kind == ControlRequest.ACTION:
        return str(asked)[:LONGEST], "", ""
    if request.kind != ControlRequest.PARAM or not isinstance(asked, Parameter) or asked.value is None:
        return "", "", ""
    return asked.name[:LONGEST], asked.value[:LONGEST], (asked.unit or "")[:LONGEST]


@dataclass(frozen=True)
class SentStart:
    """The request that starts a measurement or a treatment of the tip, saved before forwarding.

    The log entry of a measurement holds its key.

    Attributes:
        sent_ns: experiment time of its first forwarding.
    """

    who: str
    action: str
    request_id: str
    sent_ns: int

    def entry(self, now_ns: int) -> JournalEntry:
        """Return the journal entry of a start whose answer was lost when the scheduler was killed."""
        return JournalEntry(
            now_ns,
            REQUEST,
            self.who,
            self.action,
            int(ControlResponse.NO_RESPONSE),
            _CUT_OFF,
            request=int(ControlRequest.ACTION),
            sent_ns=self.sent_ns,
            key=key_of(self.who, self.request_id),
            subject=self.action,
        )


@dataclass(frozen=True)
class EventLog:
    """The entries that are not published yet.

    Attributes:
        due_s: the due time of their publication, in real monotonic time; None without entries.
        left_out: the number of requests that were only counted, with `most` entries gathered.
        starts: the last starts of measurements and treatments, each saved before forwarding, since a kill loses the
            gathered entries.
    """

    most: int = MOST
    due_s: float | None = None
    gathered: tuple[AnsweredRequest | JournalEntry, ...] = ()
    left_out: int = 0
    starts: tuple[SentStart, ...] = ()

    def add(self, now_s: float, *entries: AnsweredRequest | JournalEntry) -> EventLog:
        if not entries:
            return self
        due_s = now_s + PERIOD_S if self.due_s is None else self.due_s
        return replace(self, due_s=due_s, gathered=(*self.gathered, *entries))

    def add_request(self, now_s: float, entry: AnsweredRequest | JournalEntry) -> EventLog:
        """Add the entry of a request; with `most` entries gathered, the request is only counted.

        Clock requests and messages for publication are not logged.
        """
        if isinstance(entry, AnsweredRequest) and entry.request.kind in _UNWRITTEN:
            return self
        if len(self.gathered) >= self.most:
            return replace(self, left_out=self.left_out + 1)
        return self.add(now_s, entry)

    def sent_ns(self, who: str, request: Request, now_ns: int) -> int:
        """Return the experiment time of a request's first forwarding: now, unless the request repeats a start."""
        known = (one.sent_ns for one in self.starts if (one.who, one.request_id) == (who, request.id) and request.id)
        return next(known, now_ns)

    def sending(self, who: str, request: Request, sent_ns: int) -> EventLog:
        """Remember a forwarded request that starts a measurement or a treatment; ignore all other requests."""
        if request.kind != ControlRequest.ACTION or request.subject not in _STARTS:
            return self
        start = SentStart(who, str(request.subject), request.id, sent_ns)
        return self if start in self.starts else replace(self, starts=(*self.starts, start)[-_STARTS_KEPT:])

    def restored(
        self, starts: Sequence[SentStart], published: Iterable[JournalEntry], now_s: float, now_ns: int
    ) -> EventLog:
        """Restore the starts saved before a restart; add an entry for each start without a published entry.

        Args:
            published: the entries in the restored cache.
        """
        known = {(entry.who, entry.sent_ns) for entry in published}
        lost = [one.entry(now_ns) for one in starts if (one.who, one.sent_ns) not in known]
        return replace(self, starts=tuple(starts)).add(now_s, *lost)

    def take(self, problems: ProblemNames, now_ns: int) -> tuple[EventLog, JournalEntries]:
        """Return the log without its entries, and these entries as text, oldest first."""
        entries = [one if isinstance(one, JournalEntry) else one.entry(problems) for one in self.gathered]
        if self.left_out:
            entries.append(JournalEntry(now_ns, REQUEST, SCHEDULER, f"{self.left_out} more requests are left out"))
        return EventLog(self.most, starts=self.starts), JournalEntries(tuple(entries))


def unreadable_entry(now_ns: int, who: str, response: Response) -> JournalEntry:
    return JournalEntry(now_ns, REQUEST, who, "an unreadable request", response.code, response.reason[:LONGEST], 0.0)


def start_entry(now_ns: int, control: ArbitrationState, *, is_restart: bool) -> JournalEntry:
    if not is_restart:
        return JournalEntry(now_ns, CONTROL, SCHEDULER, "started", event=ControlEvent.STARTED)
    what = f"started again; {control.holder or 'no component'} is in control"
    return JournalEntry(now_ns, CONTROL, SCHEDULER, what, event=ControlEvent.RESTARTED)


def panel_entry(now_ns: int, who: str, act: ActByHand, outside: Sequence[str]) -> JournalEntry:
    """Return the log entry of an act by hand.

    Args:
        outside: why a request for the same values would have been refused by [limits].
    """
    return JournalEntry(now_ns, CONTROL, who, str(act), reason="; ".join(outside), event=ControlEvent.BY_HAND)


def control_entries(
    now_ns: int,
    before: ArbitrationState,
    after: ArbitrationState,
    ask: ControlInput,
    row: Transition,
    problems: ProblemNames,
) -> list[JournalEntry]:
    """Return a log entry for each change of holder, mode and problems, and for the end of the experiment."""
    name, entry = problems.name, partial(JournalEntry, now_ns, CONTROL)
    entries = []
    if before.holder is not None and after.holder != before.holder:
        cause = row.cause.text if row.cause is not None else ""
        entries.append(entry(before.holder, "lost control", reason=cause, event=ControlEvent.CONTROL_LOST))
    for number in sorted(after.problems.keys() - before.problems.keys()):
        flagged = ControlEvent.PROBLEM_FLAGGED
        entries.append(entry(ask.who, f"flagged {name(number)}", event=flagged, problem=number))
    for number in sorted(before.problems.keys() - after.problems.keys()):
        why, cleared = f"it was flagged by {before.problems[number]}", ControlEvent.PROBLEM_CLEARED
        entries.append(entry(ask.who, f"cleared {name(number)}", reason=why, event=cleared, problem=number))
    if after.mode is not before.mode:
        changed = ControlEvent.MODE_CHANGED
        entries.append(entry(ask.who, f"mode {after.mode.name}", reason=ask.why, event=changed, mode=after.mode))
    if after.holder is not None and (after.holder, after.solving) != (before.holder, before.solving):
        solving, gained = f" to solve {name(after.solving)}" if after.solving else "", ControlEvent.CONTROL_GAINED
        problem = after.solving or None
        entries.append(entry(after.holder, f"in control{solving}", event=gained, problem=problem))
    if after.ended and not before.ended:
        entries.append(entry(ask.who, "ended the experiment", event=ControlEvent.EXPERIMENT_ENDED))
    return entries
