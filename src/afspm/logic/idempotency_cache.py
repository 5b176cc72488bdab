"""The idempotency cache: the outcome of each request id, so that a repeated request is not carried out twice."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto

from afspm.logic.frozen import replace
from afspm.model import ControlResponse, Request, Response

_SENT_REMEMBERED = 100


class RequestStatus(Enum):
    """The state of a request that has no answer to repeat."""

    PENDING = auto()
    """It waits or is with the translator: whoever asks again gets the same answer."""
    UNKNOWN = auto()
    """It was sent and nobody knows whether it was carried out."""


_Outcomes = Mapping[str, tuple[int, RequestStatus | Response]]
_NONE: tuple[_Outcomes, _Outcomes] = ({}, {})
_PART = 8  # a part of those remembered is new, and copied with each
SentAction = tuple[str, str, int]
"""An action that was sent: client, request id, fingerprint."""


@dataclass(frozen=True)
class IdempotencyCache:
    """The status or answer of the latest request ids of each client.

    Attributes:
        per_client: most ids remembered of a client.
        table: of each client the older ids and the latest.
        clients: most clients.
        sent_actions: those that only we know of, kept over a restart. A translator of version 1 would do them again;
            one of ours would not, but for an action that was done already the microscope must not be moved.
        ids_known: whether the translator knows request ids; None: not known yet.
    """

    per_client: int = 256
    clients: int = 256
    sent_actions: tuple[SentAction, ...] = ()
    ids_known: bool | None = None
    table: Mapping[str, tuple[_Outcomes, _Outcomes]] = field(default_factory=dict)

    def look_up(self, client: str, request: Request) -> RequestStatus | Response | None:
        """Return the status or answer of an id; None: it is new, or long forgotten, or there is none."""
        older, latest = self.table.get(client, _NONE)
        entry = latest.get(request.id) or older.get(request.id) if request.id else None
        if entry is None:
            return None
        if entry[0] != fingerprint(request):
            return Response(ControlResponse.FAILURE, reason="its id was used for another request before", id=request.id)
        return entry[1]

    def noted(self, client: str, request: Request, outcome: RequestStatus | Response) -> IdempotencyCache:
        """Remember the status or answer of a request that has an id."""
        return self._with(client, request.id, fingerprint(request), outcome) if request.id else self

    def forgotten(self, client: str, request: Request) -> IdempotencyCache:
        """Forget a request that was not carried out: it may be tried anew."""
        parts = self.table.get(client, _NONE)
        older, latest = ({id_: one for id_, one in part.items() if id_ != request.id} for part in parts)
        return replace(self, table={**self.table, client: (older, latest)})

    def sent(self, client: str, request: Request) -> IdempotencyCache:
        """Remember an action over a restart."""
        action = (client, request.id, fingerprint(request))
        return replace(self, sent_actions=(*self.sent_actions, action)[-_SENT_REMEMBERED:])

    def not_sent(self, client: str, request: Request) -> IdempotencyCache:
        """Forget a request, and the action that it was."""
        rest = tuple(one for one in self.sent_actions if one[:2] != (client, request.id))
        return replace(self.forgotten(client, request), sent_actions=rest)

    def was_sent(self, client: str, request: Request) -> bool:
        return any(one[:2] == (client, request.id) for one in self.sent_actions)

    def restored(self, sent_actions: Iterable[SentAction]) -> IdempotencyCache:
        """Take up the actions that were sent before a restart: nobody knows whether they were carried out."""
        cache = replace(self, sent_actions=tuple(sent_actions))
        for client, request_id, print_ in cache.sent_actions:
            cache = cache._with(client, request_id, print_, RequestStatus.UNKNOWN)
        return cache

    def _with(self, client: str, request_id: str, print_: int, outcome: RequestStatus | Response) -> IdempotencyCache:
        table = dict(self.table)
        older, latest = table.pop(client, ({}, {}))  # the client heard last is last
        latest = {**latest, request_id: (print_, outcome)}
        if len(latest) * _PART > self.per_client:  # few are copied each time
            older, latest = dict([*{**older, **latest}.items()][-self.per_client :]), {}
        table[client] = older, latest
        if len(table) > self.clients:
            del table[next(iter(table))]
        return replace(self, table=table)


def fingerprint(request: Request) -> int:
    """Return a number that tells requests apart that were given the same id; the same in every process."""
    return zlib.crc32(request.payload, request.kind)
