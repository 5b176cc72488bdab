"""The event log: what was asked and answered, who is in control, orders; published some at a time.

To add an entry costs next to nothing, since nobody waits longer for an answer because of it: words are found when it
is published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from afspm.logic.arbitration import ArbitrationState, ControlInput, Transition
from afspm.logic.descriptions import asked
from afspm.model import (
    CLOCK_REQUEST,
    RESTART_REQUEST,
    TELL_REQUEST,
    JournalEntries,
    JournalEntry,
    ProblemNames,
    Request,
    Response,
)

ENTRIES = "JournalEntries"
PERIOD_S = 0.1
"""Real time between two publications, at least."""
MOST = 1000
"""Requests written down within that time; of more it is only said how many there were."""
LONGEST = 1000
"""Characters of what was asked, and of the reason."""

REQUEST, CONTROL, ORDER = "request", "control", "order"
SCHEDULER = "scheduler"
"""Who asks for what nobody else did."""
_UNWRITTEN = frozenset({CLOCK_REQUEST, TELL_REQUEST})


@dataclass(frozen=True, slots=True)
class AnsweredRequest:
    """A request with its answer, not in words yet.

    Attributes:
        took_s: real time from the question to the answer.
        note: what there is to say of the answer beside its reason.
    """

    time_ns: int
    who: str
    request: Request
    response: Response
    took_s: float
    note: str = ""

    def entry(self, problems: ProblemNames) -> JournalEntry:
        kind = ORDER if self.request.kind == RESTART_REQUEST else REQUEST
        what = asked(self.request, problems)[:LONGEST]
        reason = "; ".join(filter(None, (self.note, self.response.reason[:LONGEST])))
        return JournalEntry(self.time_ns, kind, self.who, what, self.response.code, reason, self.took_s)


@dataclass(frozen=True, slots=True)
class EventLog:
    """The entries that are still to be published.

    Attributes:
        due_s: when, in real monotonic time, they are to be published; None: there are none.
        left_out: requests beyond `most`.
    """

    most: int = MOST
    due_s: float | None = None
    gathered: tuple[AnsweredRequest | JournalEntry, ...] = ()
    left_out: int = 0

    def add(self, now_s: float, *entries: AnsweredRequest | JournalEntry) -> EventLog:
        if not entries:
            return self
        due_s = now_s + PERIOD_S if self.due_s is None else self.due_s
        return replace(self, due_s=due_s, gathered=(*self.gathered, *entries))

    def add_request(self, now_s: float, entry: AnsweredRequest | JournalEntry) -> EventLog:
        """Add one of those of which there may be any number."""
        if isinstance(entry, AnsweredRequest) and entry.request.kind in _UNWRITTEN:
            return self
        if len(self.gathered) >= self.most:
            return replace(self, left_out=self.left_out + 1)
        return self.add(now_s, entry)

    def take(self, problems: ProblemNames, now_ns: int) -> tuple[EventLog, JournalEntries]:
        """Return the entries in words, oldest first: they are the caller's to publish."""
        entries = [one if isinstance(one, JournalEntry) else one.entry(problems) for one in self.gathered]
        if self.left_out:
            entries.append(JournalEntry(now_ns, REQUEST, SCHEDULER, f"{self.left_out} more requests are left out"))
        return EventLog(self.most), JournalEntries(tuple(entries))


def unreadable_entry(now_ns: int, who: str, response: Response) -> JournalEntry:
    """Return the entry of a request that could not be read."""
    return JournalEntry(now_ns, REQUEST, who, "what can't be read", response.code, response.reason[:LONGEST], 0.0)


def start_entry(now_ns: int, control: ArbitrationState, *, is_restart: bool) -> JournalEntry:
    """Return the entry of the scheduler's start."""
    what = f"started again; {control.holder or 'nobody'} is in control" if is_restart else "started"
    return JournalEntry(now_ns, CONTROL, SCHEDULER, what)


def control_entries(
    now_ns: int,
    before: ArbitrationState,
    after: ArbitrationState,
    ask: ControlInput,
    row: Transition,
    problems: ProblemNames,
) -> list[JournalEntry]:
    """Return an entry for each change of control, mode and problems: in whose name it was, and why."""
    entries, name = list[JournalEntry](), problems.name

    def say(who: str, what: str, reason: str = "") -> None:
        entries.append(JournalEntry(now_ns, CONTROL, who, what, None, reason))

    if before.holder is not None and after.holder != before.holder:
        say(before.holder, "no longer in control", row.cause.value if row.cause is not None else "")
    for number in sorted(after.problems.keys() - before.problems.keys()):
        say(ask.who, f"flagged {name(number)}")
    for number in sorted(before.problems.keys() - after.problems.keys()):
        say(ask.who, f"cleared {name(number)}", f"it was flagged by {before.problems[number]}")
    if after.mode is not before.mode:
        say(ask.who, f"mode {after.mode.name}")
    if after.holder is not None and (after.holder, after.solving) != (before.holder, before.solving):
        say(after.holder, f"in control to solve {name(after.solving)}" if after.solving else "in control")
    if after.ended and not before.ended:
        say(ask.who, "ended the experiment")
    return entries
