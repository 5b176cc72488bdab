"""Nothing is done twice: what became of each request id, for when it is asked again."""

from __future__ import annotations

import zlib
from collections import OrderedDict
from enum import Enum, auto

from afspm.model import ControlResponse, Request, Response


class RequestStatus(Enum):
    """What became of a request that has no answer to repeat."""

    PENDING = auto()
    """It waits or is with the translator: whoever asks again gets the same answer."""
    UNKNOWN = auto()
    """It was sent and nobody knows what became of it."""


class IdempotencyCache:
    """The fate or answer of the latest request ids of each client.

    Args:
        per_client: how many ids of a client are remembered.
        clients: of how many clients.
    """

    def __init__(self, per_client: int = 256, clients: int = 256) -> None:
        self._per_client = per_client
        self._clients = clients
        self._table: OrderedDict[str, OrderedDict[str, tuple[int, RequestStatus | Response]]] = OrderedDict()

    def look_up(self, client: str, request: Request) -> RequestStatus | Response | None:
        """None: the id is new, or long forgotten, or there is none."""
        of_client = self._table.get(client)
        entry = None if of_client is None else of_client.get(request.id)
        if entry is None:
            return None
        if entry[0] != fingerprint(request):
            return Response(ControlResponse.FAILURE, reason="its id was used for another request before", id=request.id)
        return entry[1]

    def note(self, client: str, request: Request, outcome: RequestStatus | Response) -> None:
        """Remember what became of a request; of one without an id nothing is."""
        if request.id:
            self.restore(client, request.id, fingerprint(request), outcome)

    def restore(self, client: str, request_id: str, print_: int, outcome: RequestStatus | Response) -> None:
        """The same of a request of which only its fingerprint is known."""
        of_client = self._table.get(client)
        if of_client is None:
            of_client = self._table[client] = OrderedDict()
            if len(self._table) > self._clients:
                self._table.popitem(last=False)
        else:
            self._table.move_to_end(client)
        of_client[request_id] = (print_, outcome)
        if len(of_client) > self._per_client:
            of_client.popitem(last=False)

    def forget(self, client: str, request: Request) -> None:
        """It was not done and may be tried anew."""
        of_client = self._table.get(client)
        if of_client is not None:
            of_client.pop(request.id, None)


def fingerprint(request: Request) -> int:
    """Tells requests apart that were given the same id; the same in every process."""
    return zlib.crc32(request.payload, request.kind)
