"""The idempotency cache: the outcome of each request id, so that a repeated request is not carried out twice.

Memory is bounded, so old outcomes are forgotten. A forgotten request is not carried out again: numbers rise within a
session, and an unknown id is refused at and below the highest forgotten number of its session (its floor). Ids without
a rising number (attempts at a measurement, and a client's own forms) are kept apart, so that other requests do not
displace them.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto

from afspm.basics.frozen import replace
from afspm.model import ControlResponse, Request, Response
from afspm.model.sessions import number_of

TOO_OLD = (
    "the number of its id is not above one that was forgotten: it may have been carried out. Numbers rise within a"
    " session, and a client that is started again takes another token"
)
_SENT_REMEMBERED = 100


class RequestStatus(Enum):
    """The state of a request without an answer to repeat."""

    PENDING = auto()
    """Waiting, or sent to the translator: a repetition gets the answer to the first request."""
    UNKNOWN = auto()
    """Sent, with an unknown outcome."""
    FORGOTTEN = auto()
    """The number is at or below the floor of its session: the request may have been carried out."""


_Outcomes = Mapping[str, tuple[int, RequestStatus | Response]]
_NONE: tuple[_Outcomes, _Outcomes] = ({}, {})
# the state is immutable, so each new id copies a dict: ids are added to a small dict (an eighth), and merged when full
_PART = 8
SentAction = tuple[str, str, int]
"""An action that was sent: client, request id, fingerprint."""
_Shelf = tuple[str, bool]
"""A client, and whether the ids have numbers."""


@dataclass(frozen=True)
class Floors:
    """The highest forgotten number of each session: ids at or below this number are never new.

    Attributes:
        most: maximum number of sessions.
        numbers: the forgotten numbers by client and session, in the order of their last change.
    """

    most: int = 1000
    numbers: Mapping[str, int] = field(default_factory=dict)

    def forgetting(self, client: str, request_ids: Iterable[str]) -> Floors:
        """Return the floors, raised to the numbers of forgotten ids."""
        raised = dict(self.numbers)
        for request_id in request_ids:
            if (numbered := number_of(request_id)) is not None:
                session = f"{client} {numbered[0]}"
                raised[session] = max(raised.pop(session, -1), numbered[1])
        return replace(self, numbers=dict([*raised.items()][-self.most :]))

    def is_below(self, client: str, request_id: str) -> bool:
        """Return whether an id may belong to a forgotten request."""
        numbered = number_of(request_id)
        return numbered is not None and numbered[1] <= self.numbers.get(f"{client} {numbered[0]}", -1)


@dataclass(frozen=True)
class IdempotencyCache:
    """The status or answer of the latest request ids of each client.

    Attributes:
        per_client: number of ids kept for each client, up to an eighth more between two merges, separately for ids with
            and without numbers.
        clients: maximum number of clients; a client with both kinds of ids counts twice.
        sent_actions: latest actions sent to the translator, kept over a restart. The translator would not repeat such
            an action, but the scheduler must not move the microscope in preparation for it again.
        floors: the highest forgotten numbers, kept over a restart.
        table: the outcomes of the older and the latest ids of each client.
    """

    per_client: int = 256
    clients: int = 256
    sent_actions: tuple[SentAction, ...] = ()
    floors: Floors = field(default_factory=Floors)
    table: Mapping[_Shelf, tuple[_Outcomes, _Outcomes]] = field(default_factory=dict)

    def look_up(self, client: str, request: Request) -> RequestStatus | Response | None:
        """Return the status or answer of an id; None for a new or empty id.

        The answer is a FAILURE if the id was used for another request before.
        """
        older, latest = self.table.get(_shelf(client, request.id), _NONE)
        entry = latest.get(request.id) or older.get(request.id) if request.id else None
        # an id at or below its floor may have been executed, so it is not new
        if entry is None:
            return RequestStatus.FORGOTTEN if self.floors.is_below(client, request.id) else None
        if entry[0] != fingerprint(request):
            return Response(ControlResponse.FAILURE, reason="its id was used for another request before", id=request.id)
        return entry[1]

    def noted(self, client: str, request: Request, outcome: RequestStatus | Response) -> IdempotencyCache:
        """Remember the status or answer of a request with an id."""
        return self._with(client, request.id, fingerprint(request), outcome) if request.id else self

    def forgotten(self, client: str, request: Request) -> IdempotencyCache:
        """Forget a request that was not carried out, so that the client may repeat it."""
        shelf = _shelf(client, request.id)
        parts = self.table.get(shelf, _NONE)
        older, latest = ({id_: one for id_, one in part.items() if id_ != request.id} for part in parts)
        return replace(self, table={**self.table, shelf: (older, latest)})

    def sent(self, client: str, request: Request) -> IdempotencyCache:
        """Remember a sent action over a restart; the oldest beyond a hundred are forgotten and raise the floors."""
        others = (one for one in self.sent_actions if one[:2] != (client, request.id))
        actions = (*others, (client, request.id, fingerprint(request)))
        floors = self.floors
        for former, request_id, _ in actions[:-_SENT_REMEMBERED]:
            floors = floors.forgetting(former, [request_id])
        return replace(self, sent_actions=actions[-_SENT_REMEMBERED:], floors=floors)

    def not_sent(self, client: str, request: Request) -> IdempotencyCache:
        """Forget a request and its sent action."""
        rest = tuple(one for one in self.sent_actions if one[:2] != (client, request.id))
        return replace(self.forgotten(client, request), sent_actions=rest)

    def was_sent(self, client: str, request: Request) -> bool:
        return any(one[:2] == (client, request.id) for one in self.sent_actions)

    def restored(self, sent_actions: Iterable[SentAction], floors: Mapping[str, int]) -> IdempotencyCache:
        """Restore the actions sent before a restart; their outcome is unknown."""
        cache = replace(self, sent_actions=tuple(sent_actions), floors=replace(self.floors, numbers=dict(floors)))
        for client, request_id, print_ in cache.sent_actions:
            cache = cache._with(client, request_id, print_, RequestStatus.UNKNOWN)
        return cache

    def _with(self, client: str, request_id: str, print_: int, outcome: RequestStatus | Response) -> IdempotencyCache:
        table, floors, shelf = dict(self.table), self.floors, _shelf(client, request_id)
        older, latest = table.pop(shelf, ({}, {}))  # clients in the order of their last request: the first is dropped
        latest = {**latest, request_id: (print_, outcome)}
        if len(latest) * _PART > self.per_client:  # merge the small dict into the large one
            all_ = [*{**older, **latest}.items()]
            floors = floors.forgetting(client, (id_ for id_, _ in all_[: -self.per_client]))
            older, latest = dict(all_[-self.per_client :]), {}
        table[shelf] = older, latest
        if len(table) > self.clients:
            former = next(iter(table))
            floors = floors.forgetting(former[0], (id_ for part in table.pop(former) for id_ in part))
        return replace(self, table=table, floors=floors)


def _shelf(client: str, request_id: str) -> _Shelf:
    return client, number_of(request_id) is not None


def fingerprint(request: Request) -> int:
    """Return a checksum that distinguishes requests with the same id; equal in every process."""
    return zlib.crc32(request.payload, request.kind)
