"""What happens, gathered to be published some at a time: what was asked and answered, who is in control, orders.

To note something costs next to nothing, since nobody waits longer for an answer because of it: words are found when it
is published.
"""

from __future__ import annotations

from afspm.logic.arbitration import ArbitrationState, ControlInput, Transition
from afspm.logic.descriptions import asked
from afspm.model import (
    CLOCK_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
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
_UNWRITTEN = frozenset({CLOCK_REQUEST, RELAY_REQUEST})

_Answered = tuple[int, str, Request, Response, float, str]


class EventLog:
    """Gathers entries. Whoever owns it says at each step what time it is, and publishes what it gives when that is due.

    Attributes:
        due_s: when, in real monotonic time, what has been gathered is to be published; None: nothing has been.
    """

    def __init__(self, problems: ProblemNames, most: int = MOST) -> None:
        self.due_s: float | None = None
        self._problems = problems
        self._most = most
        self._now_s, self._now_ns = 0.0, 0
        self._gathered: list[_Answered | JournalEntry] = []
        self._left_out = 0

    def at(self, now_s: float, now_ns: int) -> None:
        """What follows happens now: real monotonic time, and the experiment's."""
        self._now_s, self._now_ns = now_s, now_ns

    def answered(self, who: str, request: Request, response: Response, heard_s: float, note: str = "") -> None:
        """A request got its answer.

        Args:
            heard_s: when, in real monotonic time, it was heard.
            note: what there is to say of the answer beside its reason.
        """
        if request.kind not in _UNWRITTEN:
            self._add_request((self._now_ns, who, request, response, self._now_s - heard_s, note))

    def unreadable(self, who: str, response: Response) -> None:
        """Somebody asked for what could not be read."""
        reason = response.reason[:LONGEST]
        self._add_request(JournalEntry(self._now_ns, REQUEST, who, "what can't be read", response.code, reason, 0.0))

    def began(self, control: ArbitrationState, *, again: bool) -> None:
        """The scheduler was started."""
        what = "started" if not again else f"started again; {control.holder or 'nobody'} is in control"
        self._add(JournalEntry(self._now_ns, CONTROL, SCHEDULER, what))

    def changed(self, before: ArbitrationState, after: ArbitrationState, ask: ControlInput, row: Transition) -> None:
        """ArbitrationState, mode or problems changed: an entry for each, in whose name it was, and why."""
        name = self._problems.name
        cause = row.cause.value if row.cause is not None else ""
        if before.holder is not None and after.holder != before.holder:
            self._say(before.holder, "no longer in control", cause)
        for number in sorted(after.problems.keys() - before.problems.keys()):
            self._say(ask.who, f"flagged {name(number)}")
        for number in sorted(before.problems.keys() - after.problems.keys()):
            self._say(ask.who, f"cleared {name(number)}", f"it was flagged by {before.problems[number]}")
        if after.mode is not before.mode:
            self._say(ask.who, f"mode {after.mode.name}")
        if after.holder is not None and (after.holder, after.solving) != (before.holder, before.solving):
            solving = f" to solve {name(after.solving)}" if after.solving else ""
            self._say(after.holder, f"in control{solving}")
        if after.ended and not before.ended:
            self._say(ask.who, "ended the experiment")

    def take(self) -> JournalEntries:
        """What has been gathered, oldest first; from here on it is the owner's to publish."""
        gathered, left_out = self._gathered, self._left_out
        self._gathered, self._left_out, self.due_s = [], 0, None
        entries = [one if isinstance(one, JournalEntry) else self._worded(one) for one in gathered]
        if left_out:
            entries.append(JournalEntry(self._now_ns, REQUEST, SCHEDULER, f"{left_out} more requests are left out"))
        return JournalEntries(tuple(entries))

    def _say(self, who: str, what: str, reason: str = "") -> None:
        self._add(JournalEntry(self._now_ns, CONTROL, who, what, None, reason))

    def _add_request(self, entry: _Answered | JournalEntry) -> None:
        """Of requests there may be any number."""
        if len(self._gathered) >= self._most:
            self._left_out += 1
        else:
            self._add(entry)

    def _add(self, entry: _Answered | JournalEntry) -> None:
        if self.due_s is None:
            self.due_s = self._now_s + PERIOD_S
        self._gathered.append(entry)

    def _worded(self, answered: _Answered) -> JournalEntry:
        time_ns, who, request, response, took_s, note = answered
        kind = ORDER if request.kind == RESTART_REQUEST else REQUEST
        what = asked(request, self._problems)[:LONGEST]
        reason = "; ".join(filter(None, (note, response.reason[:LONGEST])))
        return JournalEntry(time_ns, kind, who, what, response.code, reason, took_s)
