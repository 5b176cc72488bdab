"""Nothing is done twice: what became of each request id, for when it is asked again."""

from __future__ import annotations

from collections import OrderedDict
from enum import Enum, auto

from afspm.model import Response


class Fate(Enum):
    """What became of a request that has no answer to repeat."""

    PENDING = auto()
    """It waits or is with the translator: whoever asks again gets the same answer."""
    UNKNOWN = auto()
    """It was sent and nobody knows what became of it."""


class OnceTable:
    """The fate or answer of the latest request ids of each client.

    Args:
        per_client: how many ids of a client are remembered.
        clients: of how many clients.
    """

    def __init__(self, per_client: int = 256, clients: int = 256) -> None:
        self._per_client = per_client
        self._clients = clients
        self._table: OrderedDict[str, OrderedDict[str, Fate | Response]] = OrderedDict()

    def look_up(self, client: str, request_id: str) -> Fate | Response | None:
        """None: the id is new, or long forgotten."""
        of_client = self._table.get(client)
        return None if of_client is None else of_client.get(request_id)

    def note(self, client: str, request_id: str, outcome: Fate | Response) -> None:
        """Remember what became of a request; of one without an id nothing is."""
        if not request_id:
            return
        of_client = self._table.get(client)
        if of_client is None:
            of_client = self._table[client] = OrderedDict()
            if len(self._table) > self._clients:
                self._table.popitem(last=False)
        of_client[request_id] = outcome
        if len(of_client) > self._per_client:
            of_client.popitem(last=False)

    def forget(self, client: str, request_id: str) -> None:
        """It was not done and may be tried anew."""
        of_client = self._table.get(client)
        if of_client is not None:
            of_client.pop(request_id, None)
