"""The queue of requests to the translator: one request is in flight, the others wait, and each has a deadline.

A translator serves one request after the other and is silent meanwhile. So one request is in flight. The others wait
here, where they can still be removed; a request that has waited too long is answered unsent. The queue keeps the order
and the times. In it, commands go before reads, and the clients take turns, so that no client holds up the others.
Whether a request is sent, and in which form, is decided when its turn comes (`request_pipeline.send_next`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

from afspm.basics.frozen import replace
from afspm.model import ControlRequest, ControlResponse, Request, Response, ResponseDetail
from afspm.scheduler.coordinate_frame import MappedRequest
from afspm.scheduler.events import Forward, RequestIn


@dataclass(frozen=True, slots=True)
class ReadForTurn:
    """The purpose of reading `name` before the request `number` is decided."""

    number: int
    name: str


@dataclass(frozen=True, slots=True)
class ReadForOrder:
    """The purpose of reading `name` before the order `number` is given to an instrument."""

    number: int
    name: str


@dataclass(frozen=True, slots=True)
class MoveForTurn:
    """The purpose of moving the microscope before the action `number`."""

    number: int


@dataclass(frozen=True, slots=True)
class CompareForTurn:
    """The purpose of comparing the values in force before the request `number` is decided."""

    number: int


@dataclass(frozen=True, slots=True)
class SetForTurn:
    """The purpose of a step on the way of a loan before the request `number` is decided.

    Attributes:
        key: the key of the loan.
        is_back: whether it is on the way back.
        ends_loan: whether the base is in force again after it.
    """

    number: int
    key: str
    is_back: bool
    ends_loan: bool


@dataclass(frozen=True, slots=True)
class ReadAhead:
    """The purpose of reading `name` when a translator connects."""

    name: str


@dataclass(frozen=True, slots=True)
class AskForFrame:
    """The purpose of a coordinate frame's request; only the frame reads `purpose`."""

    purpose: object


OwnPurpose = ReadForTurn | ReadForOrder | MoveForTurn | CompareForTurn | SetForTurn | ReadAhead | AskForFrame


class ForwardedRequest(NamedTuple):
    """A request for the translator or an instrument.

    Attributes:
        client: the name of the client; empty for a request of the scheduler itself.
        command: for a client's request, whether it may change the microscope or an instrument; if so, it is authorised
            again before sending. Always True for the scheduler's own requests, even reads; these are sent without
            authorisation.
        deadline_s: the deadline of the answer, real; 0: no deadline yet.
        sent_s: the real time of sending; None while the request waits.
        answered: whether "no response" was returned in place of an overdue answer; False again once the client repeats
            the request.
        connection: the connection over which the request arrived.
        states_seen: for a client's request to the translator, the number of microscope states reported before sending.
        mapped: the request in the coordinates of the microscope, if they differ.
        heard_s: the real time of arrival.
        sent_ns: for a client's request, the experiment time of the first sending; None before. Never set for the
            scheduler's own requests.
        is_repeated: whether the request was sent before under its id, with an unknown outcome.
        is_by_hand: whether it was sent in MANUAL, and so by a person.
        purpose: the purpose of a request of the scheduler itself; None: the tip's safety, or a client's request.
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
    sent_ns: int | None = None
    is_repeated: bool = False
    is_by_hand: bool = False
    purpose: OwnPurpose | None = None

    @classmethod
    def of(cls, event: RequestIn, *, command: bool = True, is_repeated: bool = False) -> ForwardedRequest:
        return cls(
            event.name, event.request, command,
            connection=event.connection, heard_s=event.heard_s, is_repeated=is_repeated,
        )  # fmt: skip

    @property
    def outgoing(self) -> Request:
        """The request in the coordinates of the microscope."""
        return self.request if self.mapped is None else self.mapped.request


class ForwardOutcome(Enum):
    ANSWERED = auto()
    NOT_SENT = auto()
    UNKNOWN = auto()
    LATE = auto()
    """The translator's answer came after the client had got "no response"."""


class SettledRequest(NamedTuple):
    job: ForwardedRequest
    end: ForwardOutcome
    response: Response


Settled = tuple[SettledRequest, ...]


@dataclass(frozen=True)
class Forwarder:
    """The queue of requests to the translator.

    Attributes:
        timeout_s: the real time that a client waits for an answer.
        patience_s: the further time to wait for an overdue answer before the next request is sent.
        longest_queue: the largest number of waiting requests, without commands.
        most_of_client: the largest number of waiting requests of one client.
        flooders: the clients that exceeded `most_of_client`, newest last.
        up: whether the translator is connected.
        number: the number of the newest request.
        flight: the request that the translator is serving.
        own: waiting requests of the scheduler itself, in order; they go first.
        queue: waiting requests of clients, in order.
        overdue: requests whose answer may still come, by number.
        outbox: requests to send now; the caller empties it.
    """

    timeout_s: float = 5.0
    patience_s: float = 5.0
    longest_queue: int = 64
    most_of_client: int = 32
    flooders: tuple[str, ...] = ()
    up: bool = False
    number: int = 0
    flight: ForwardedRequest | None = None
    own: tuple[ForwardedRequest, ...] = ()
    queue: tuple[ForwardedRequest, ...] = ()
    overdue: Mapping[int, ForwardedRequest] = field(default_factory=dict)
    outbox: tuple[Forward, ...] = ()

    def connected(self) -> tuple[Forwarder, Settled]:
        """Register that the translator is connected; settle the requests of a lost connection first."""
        forwarder, settled = self.lost() if self.up else (self, ())
        return replace(forwarder, up=True), settled

    def lost(self) -> tuple[Forwarder, Settled]:
        """Register that the translator is disconnected; settle all requests that are not answered."""
        waiting = tuple(_not_sent(job, "the translator is not connected") for job in (*self.own, *self.queue))
        if self.flight is not None and not self.flight.answered:
            why = "the connection to the translator was lost before it answered"
            waiting = (_unknown(self.flight, why), *waiting)
        return replace(self, up=False, flight=None, own=(), queue=()), waiting

    @property
    def is_free(self) -> bool:
        """Whether a request can be sent."""
        return self.up and self.flight is None

    @property
    def action_in_flight(self) -> str | None:
        """The action that the translator executes; None: none."""
        request = None if self.flight is None else self.flight.request
        return str(request.subject) if request is not None and request.kind == ControlRequest.ACTION else None

    def ask(self, job: ForwardedRequest, now_s: float) -> tuple[Forwarder, SettledRequest | None]:
        """Queue a client's request; return its refusal if it can't be queued."""
        if not self.up:
            return self, _not_sent(job, "the translator is not connected")
        if sum(other.client == job.client for other in self.queue) >= self.most_of_client:
            flooders = tuple(client for client in self.flooders if client != job.client)
            # bounded: the names are the clients' choice
            forwarder = replace(self, flooders=(*flooders, job.client)[-self.longest_queue :])
            return forwarder, _not_sent(job, f"{self.most_of_client} requests of {job.client} wait already")
        # the reads of many names must not keep out a command
        if not job.command and len(self.queue) >= self.longest_queue:
            return self, _not_sent(job, f"{self.longest_queue} requests wait for the translator already")
        job = job._replace(number=self.number + 1, deadline_s=now_s + self.timeout_s)
        at = self._place(job)
        return replace(self, number=job.number, queue=(*self.queue[:at], job, *self.queue[at:])), None

    def _place(self, job: ForwardedRequest) -> int:
        # behind all requests of its client, and behind each request with as many or fewer of its own client before it
        turns, of_clients = list[tuple[bool, int]](), Counter[str]()
        for other in (*self.queue, job):
            turns.append((not other.command, of_clients[other.client]))
            of_clients[other.client] += 1
        at = len(self.queue)
        while at and self.queue[at - 1].client != job.client and turns[-1] < turns[at - 1]:
            at -= 1
        return at

    def ask_own(
        self, request: Request, now_s: float, purpose: OwnPurpose | None = None, mapped: MappedRequest | None = None
    ) -> tuple[Forwarder, ForwardedRequest | None]:
        """Queue a request of the scheduler before clients' requests, and return the queued request.

        Returns:
            None in its place if no translator is connected.
        """
        if not self.up:
            return self, None
        number, deadline_s = self.number + 1, now_s + self.timeout_s
        job = ForwardedRequest(
            "", request, command=True, number=number, deadline_s=deadline_s,
            mapped=mapped, heard_s=now_s, purpose=purpose,
        )  # fmt: skip
        return replace(self, number=number, own=(*self.own, job)), job

    def without_own_actions(self) -> tuple[Forwarder, bool]:
        """Remove the scheduler's own waiting actions; return whether there were any."""
        rest = tuple(job for job in self.own if job.request.kind != ControlRequest.ACTION or job.purpose is not None)
        return replace(self, own=rest), rest != self.own

    def sent(self, job: ForwardedRequest, now_s: float) -> Forwarder:
        """Send a waiting request."""
        assert self.is_free
        rest = self.without(job.number)
        return replace(
            rest, flight=job._replace(sent_s=now_s), outbox=(*self.outbox, Forward(job.number, job.outgoing))
        )

    def without(self, number: int) -> Forwarder:
        """Remove a waiting request."""
        own, queue = (tuple(job for job in jobs if job.number != number) for jobs in (self.own, self.queue))
        return replace(self, own=own, queue=queue)

    def waiting_longer(self, number: int, by_s: float) -> Forwarder:
        """Return the queue with a later deadline for a client's waiting request."""
        queue = tuple(
            job._replace(deadline_s=job.deadline_s + by_s) if job.number == number else job for job in self.queue
        )
        return replace(self, queue=queue)

    def waiting(self, number: int) -> ForwardedRequest | None:
        """Return a client's waiting request by its number; None: it was sent, answered or removed."""
        return next((job for job in self.queue if job.number == number), None)

    def answered(self, number: int, response: Response) -> tuple[Forwarder, SettledRequest | None]:
        """Match the translator's answer to its request; return None if that request is no longer open."""
        job = self.flight
        if job is not None and job.number == number:
            outcome = ForwardOutcome.LATE if job.answered else ForwardOutcome.ANSWERED
            return replace(self, flight=None), SettledRequest(job, outcome, response)
        late = self.overdue.get(number)
        if late is None:
            return self, None
        rest = {other: one for other, one in self.overdue.items() if other != number}
        return replace(self, overdue=rest), SettledRequest(late, ForwardOutcome.LATE, response)

    def expired(self, now_s: float) -> tuple[Forwarder, Settled]:
        """Settle the requests whose deadline has passed; free the line after the wait for an overdue answer."""
        settled, flight = list[SettledRequest](), self.flight
        if flight is not None and not flight.answered and now_s >= flight.deadline_s:
            flight = flight._replace(answered=True)
            settled.append(_unknown(flight, f"the translator did not answer within {self.timeout_s:g} s"))
        late = [job for job in (*self.own, *self.queue) if now_s >= job.deadline_s]
        settled += [_not_sent(job, f"the translator was busy for {self.timeout_s:g} s") for job in late]
        own, queue = (tuple(job for job in jobs if now_s < job.deadline_s) for jobs in (self.own, self.queue))
        forwarder = replace(self, flight=flight, own=own, queue=queue)
        if flight is not None and flight.answered and now_s >= self._patience_ends_s(flight):
            # bounded: a translator that never answers must not fill the memory
            overdue = [*self.overdue.items(), (flight.number, flight)][-self.longest_queue :]
            forwarder = replace(forwarder, overdue=dict(overdue), flight=None)
        return forwarder, tuple(settled)

    def asked_again(self, client: str, request_id: str, now_s: float) -> Forwarder | None:
        """Extend the deadline of an overdue request that its client repeats; None if it is not in flight."""
        job = self.flight
        if job is None or job.client != client or job.request.id != request_id:
            return None
        return replace(self, flight=job._replace(answered=False, deadline_s=now_s + self.timeout_s))

    def called_back(self, which: Callable[[ForwardedRequest], bool]) -> tuple[Forwarder, list[ForwardedRequest]]:
        """Remove clients' unsent requests selected by `which`, for the caller to answer."""
        called = [job for job in self.queue if which(job)]
        return replace(self, queue=tuple(job for job in self.queue if job not in called)), called

    def deadline_s(self) -> float | None:
        """Return the real time at which `expired` is due; None: no request waits or is in flight."""
        times = [job.deadline_s for job in (*self.own, *self.queue)]
        if self.flight is not None:
            times.append(self._patience_ends_s(self.flight) if self.flight.answered else self.flight.deadline_s)
        return min(times, default=None)

    def _patience_ends_s(self, job: ForwardedRequest) -> float:
        # not at once: the next request would only wait in the translator's queue, where it can't be called back
        assert job.sent_s is not None
        return job.sent_s + self.timeout_s + self.patience_s


def _not_sent(job: ForwardedRequest, why: str) -> SettledRequest:
    return SettledRequest(job, ForwardOutcome.NOT_SENT, _no_response(job, "not sent: " + why, ResponseDetail.NOT_SENT))


def _unknown(job: ForwardedRequest, why: str) -> SettledRequest:
    response = _no_response(job, "outcome unknown: " + why, ResponseDetail.OUTCOME_UNKNOWN)
    return SettledRequest(job, ForwardOutcome.UNKNOWN, response)


def _no_response(job: ForwardedRequest, reason: str, detail: ResponseDetail) -> Response:
    return Response(int(ControlResponse.NO_RESPONSE), b"", reason, job.request.id, detail)
