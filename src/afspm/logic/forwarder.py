"""Requests on their way to the translator: one at a time, each with its deadline, and every one is answered.

A translator of version 1 serves one request after the other and says nothing while it does. So one is in flight; the
others wait here, where they can still be called back, and whoever waited too long is told that nothing was done.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from afspm.logic.coordinate_frame import MappedRequest
from afspm.logic.events import Forward
from afspm.model import ControlResponse, Request, Response, ResponseDetail


@dataclass(slots=True, eq=False)
class ForwardedRequest:
    """A request for the translator.

    Attributes:
        client: who asked; empty for the scheduler's own.
        connection: the one it was asked by.
        deadline_s: when (real) it must be answered at the latest.
        command: whether it is a command, which only who is in control may give.
        sent_s: when it was sent; None while it waits.
        answered: the client has been told that there was no response in time.
        states_seen: how many states the microscope had told when it was sent on its way.
        heard_s: when it was asked, real.
        mapped: what is sent in place of `request`, where the microscope has other coordinates; None: that itself.
    """

    client: str
    request: Request
    command: bool
    number: int = 0
    deadline_s: float = 0.0
    sent_s: float | None = None
    answered: bool = False
    connection: int = -1
    states_seen: int = 0
    mapped: MappedRequest | None = None
    heard_s: float = 0.0

    @property
    def outgoing(self) -> Request:
        """What the microscope is asked."""
        return self.request if self.mapped is None else self.mapped.request


class ForwardOutcome(Enum):
    """How a job ended."""

    ANSWERED = auto()
    NOT_SENT = auto()
    UNKNOWN = auto()
    LATE = auto()
    """The true answer, after the client was told that none had come."""


@dataclass(slots=True)
class SettledRequest:
    job: ForwardedRequest
    end: ForwardOutcome
    response: Response


class Forwarder:
    """The one line to the translator.

    Every call returns what it settled; requests to be sent are appended to `outbox`, which the caller empties.

    Args:
        timeout_s: how long (real) a client waits for an answer.
        patience_s: how much longer the line is kept for an answer that is overdue, before the next is sent.
        longest_queue: how many may wait.
    """

    def __init__(self, timeout_s: float = 5.0, patience_s: float = 5.0, longest_queue: int = 64) -> None:
        self.timeout_s = timeout_s
        self.patience_s = patience_s
        self.longest_queue = longest_queue
        self.outbox: list[Forward] = []
        self.up = False
        self.flight: ForwardedRequest | None = None
        self.number = 0
        self._own: deque[ForwardedRequest] = deque()
        self._queue: deque[ForwardedRequest] = deque()
        self._overdue: OrderedDict[int, ForwardedRequest] = OrderedDict()

    def connected(self) -> list[SettledRequest]:
        """The translator can be asked, for the first time or again. (A reconnection is a loss before it.)"""
        settled = self.lost() if self.up else []
        self.up = True
        return settled

    def lost(self) -> list[SettledRequest]:
        """The translator is gone: all are answered at once."""
        self.up = False
        settled = []
        if self.flight is not None:
            if not self.flight.answered:
                settled.append(_unknown(self.flight, "the connection to the translator was lost before it answered"))
            self.flight = None
        waiting = [*self._own, *self._queue]
        self._own.clear()
        self._queue.clear()
        return settled + [_not_sent(job, "the translator is not connected") for job in waiting]

    def ask(self, job: ForwardedRequest, now_s: float) -> SettledRequest | None:
        """Send a client's request, now or when its turn comes. Returns what it was refused with, if it was.

        One that has a deadline already, since it waited for something else before, keeps it.
        """
        self.number += 1
        job.number, job.deadline_s = self.number, job.deadline_s or now_s + self.timeout_s
        if not self.up:
            return _not_sent(job, "the translator is not connected")
        if self.flight is None:
            self._send(job, now_s)
        elif len(self._queue) >= self.longest_queue:
            return _not_sent(job, f"{self.longest_queue} requests wait for the translator already")
        else:
            at = len(self._queue)
            while at and self._queue[at - 1].deadline_s > job.deadline_s:
                at -= 1
            self._queue.insert(at, job)
        return None

    def ask_own(self, request: Request, now_s: float) -> ForwardedRequest | None:
        """Send a request of the scheduler's own before all that wait. None: the translator is not connected."""
        if not self.up:
            return None
        self.number += 1
        deadline_s = now_s + self.timeout_s
        job = ForwardedRequest("", request, command=True, number=self.number, deadline_s=deadline_s, heard_s=now_s)
        if self.flight is None:
            self._send(job, now_s)
        else:
            self._own.append(job)
        return job

    def answered(self, number: int, response: Response, now_s: float) -> SettledRequest | None:
        """The translator answered. None: nobody knows what (it was settled long ago, or never asked)."""
        job = self.flight
        if job is not None and job.number == number:
            self.flight = None
            self._next(now_s)
            return SettledRequest(job, ForwardOutcome.LATE if job.answered else ForwardOutcome.ANSWERED, response)
        late = self._overdue.pop(number, None)
        return None if late is None else SettledRequest(late, ForwardOutcome.LATE, response)

    def expire(self, now_s: float) -> list[SettledRequest]:
        """Answer whoever has waited too long."""
        settled = []
        job = self.flight
        if job is not None and not job.answered and now_s >= job.deadline_s:
            job.answered = True
            settled.append(_unknown(job, f"the translator did not answer within {self.timeout_s:g} s"))
        for queue in (self._own, self._queue):
            while queue and now_s >= queue[0].deadline_s:
                settled.append(_not_sent(queue.popleft(), f"the translator was busy for {self.timeout_s:g} s"))
        if job is not None and job.answered and now_s >= self._patience_ends_s(job):
            self._overdue[job.number] = job
            if len(self._overdue) > self.longest_queue:
                self._overdue.popitem(last=False)
            self.flight = None
            self._next(now_s)
        return settled

    def requests(self) -> list[tuple[str, Request]]:
        """What clients have asked that is on its way: who, and what."""
        jobs = [job for job in (self.flight, *self._queue) if job is not None and job.client]
        return [(job.client, job.request) for job in jobs]

    def ask_again(self, client: str, request_id: str, now_s: float) -> bool:
        """The client repeats a request that it was told is overdue: if it still is, it waits for it once more."""
        job = self.flight
        if job is None or job.client != client or job.request.id != request_id:
            return False
        job.answered, job.deadline_s = False, now_s + self.timeout_s
        return True

    def call_back(self, which: Callable[[ForwardedRequest], bool]) -> list[ForwardedRequest]:
        """Take back what waits and has not been sent; the caller answers it."""
        called = [job for job in self._queue if which(job)]
        for job in called:
            self._queue.remove(job)
        return called

    def deadline_s(self) -> float | None:
        """When `expire` has something to do."""
        times = [queue[0].deadline_s for queue in (self._own, self._queue) if queue]
        if self.flight is not None:
            times.append(self._patience_ends_s(self.flight) if self.flight.answered else self.flight.deadline_s)
        return min(times, default=None)

    def _send(self, job: ForwardedRequest, now_s: float) -> None:
        job.sent_s = now_s
        self.flight = job
        self.outbox.append(Forward(job.number, job.outgoing))

    def _patience_ends_s(self, job: ForwardedRequest) -> float:
        assert job.sent_s is not None
        return job.sent_s + self.timeout_s + self.patience_s

    def _next(self, now_s: float) -> None:
        if self._own:
            self._send(self._own.popleft(), now_s)
        elif self._queue:
            self._send(self._queue.popleft(), now_s)


def _not_sent(job: ForwardedRequest, why: str) -> SettledRequest:
    return SettledRequest(job, ForwardOutcome.NOT_SENT, _no_response(job, "not sent: " + why, ResponseDetail.NOT_SENT))


def _unknown(job: ForwardedRequest, why: str) -> SettledRequest:
    return SettledRequest(
        job, ForwardOutcome.UNKNOWN, _no_response(job, "outcome unknown: " + why, ResponseDetail.OUTCOME_UNKNOWN)
    )


def _no_response(job: ForwardedRequest, reason: str, detail: ResponseDetail) -> Response:
    return Response(int(ControlResponse.NO_RESPONSE), b"", reason, job.request.id, detail)
