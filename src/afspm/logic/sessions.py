"""Who is connected: names, connections, restarts, and two that call themselves the same.

A name belongs to one session at a time: one life of one process. Its first connection binds it. It is recognised on
later connections by the token in its request ids ("<name>/<token>/<n>"); of peers without ids the connection is the
session.

ROUTER hands a name over to its newest connection, and the owner, who hears no more answers, connects anew. So when a
second process takes a name that is in use, the first is disconnected *after* the second was accepted, while a process
that is restarted connects after its former life was disconnected. That tells the impostor, who is refused, from the
restarted, who is the same client. A former life that speaks again was none: it was first, and has its name back.

Peers without ids close their connection and open another whenever an answer is late; which of the two is seen first is
chance. Such a newcomer is asked to wait a moment (`Hearing.UNCLEAR`), and has the name if the older connection closes.
"""

from __future__ import annotations

import math
import re
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto

_FORMERS = 8
_RUN = re.compile("[0-9a-f]{16}")


class Hearing(Enum):
    """What to make of a message from a connection."""

    ACCEPTED = auto()
    STALE = auto()
    """The connection is closed already: there is nobody to answer, and whoever sent it will ask again."""
    TAKEN = auto()
    """Another live process has this name."""
    UNCLEAR = auto()
    """The same, but the two may be one: hear it again when the other's connection closes, or a moment later."""


@dataclass(slots=True)
class _Session:
    token: str | None
    connection: int | None
    formers: tuple[str, ...] = ()  # the tokens of those that it replaced
    lost_order: int = 0
    lost_s: float = 0.0
    has_ids: bool = True  # until it has asked for something without one
    since_s: float = -math.inf  # its connection spoke first


KEYED = "key"
"""Stands where the token would in ids that are the same in every life: "<name>/key/<key>/<n>"."""


def token_of(name: str, request_id: str) -> str | None:
    """The session's token in a request id; None if the id says nothing of it (a caller's own key)."""
    who, *rest = request_id.split("/")
    if who != name or not 2 <= len(rest) <= 3 or rest[0] == KEYED:
        return None
    return rest[0] if all(map(str.isdigit, rest[1:])) else None  # a number, and perhaps that of an attempt


def run_of(name: str, request_id: str) -> str:
    """The identity of the run in a request id, "<name>/<run>-<life>/<n>"; empty: the id says nothing of it."""
    run, dash, _ = (token_of(name, request_id) or "").partition("-")
    return run if dash and _RUN.fullmatch(run) else ""


class SessionTable:
    """The names in use.

    Args:
        takeover_s: for how long (real) a name that was handed over is kept for its owner to come back. A peer whose
            connection died without our noticing is restarted under its name after that long at the latest.
        keep: how many names that are not connected are remembered at most.
    """

    def __init__(self, takeover_s: float = 3.0, keep: int = 1000) -> None:
        self._takeover_s = takeover_s
        self._keep = keep
        self._order = 0
        self._highest = -1
        self._open: dict[int, int] = {}  # connection -> when, in order, it was opened
        self._names: dict[str, _Session] = {}
        self._name_of: dict[int, str] = {}
        self._lost: OrderedDict[str, None] = OrderedDict()

    def connected(self, connection: int) -> None:
        self._order += 1
        self._open[connection] = self._order
        self._highest = max(self._highest, connection)

    def disconnected(self, connection: int, now_s: float) -> str | None:
        """A connection is gone. Returns the name whose session lost its connection by that, if one did."""
        self._order += 1
        self._open.pop(connection, None)
        name = self._name_of.pop(connection, None)
        if name is None:
            return None
        session = self._names[name]
        session.connection, session.lost_order, session.lost_s = None, self._order, now_s
        self._lost[name] = None
        if len(self._lost) > self._keep:
            del self._names[self._lost.popitem(last=False)[0]]
        return name

    def hear(self, connection: int, name: str, request_id: str | None, now_s: float) -> Hearing:
        """A message came from `name` by `connection`: may it speak for that name?

        Args:
            request_id: of the request, empty if it has none; None: it only said its name.
        """
        session = self._names.get(name)
        has_ids = request_id != ""
        if session is not None and session.connection == connection:
            if session.token is None:
                session.token, session.has_ids = token_of(name, request_id or ""), has_ids
                if session.token in session.formers:
                    session.formers = ()
            return Hearing.ACCEPTED
        if connection not in self._open:
            if connection <= self._highest:
                return Hearing.STALE
            self.connected(connection)
        token = token_of(name, request_id or "")
        without_ids = session is not None and not (session.has_ids or has_ids)
        if session is not None and not self._gives_way(session, token, connection, now_s, without_ids=without_ids):
            return Hearing.UNCLEAR if without_ids else Hearing.TAKEN
        self._bind(name, token, connection)
        self._names[name].has_ids, self._names[name].since_s = has_ids, now_s
        return Hearing.ACCEPTED

    def connection_of(self, name: str) -> int | None:
        """The connection by which to answer `name`; None while it has none."""
        session = self._names.get(name)
        return session.connection if session is not None else None

    def lost_since_s(self, name: str) -> float | None:
        """Since when (real) a name that was heard of is without a connection; None if it has one, or is unknown."""
        session = self._names.get(name)
        lost = session is not None and session.connection is None and session.lost_s > -math.inf
        return session.lost_s if session is not None and lost else None

    def since_s(self, name: str) -> float:
        """Since when (real) a name speaks by the connection that it has, or had last; -inf: it was not heard of yet."""
        session = self._names.get(name)
        return -math.inf if session is None else session.since_s

    def tokens(self) -> dict[str, str]:
        """The tokens of the sessions that are connected, to be kept over a restart."""
        return {name: s.token for name, s in self._names.items() if s.token is not None and s.connection is not None}

    def restore(self, tokens: Mapping[str, str]) -> None:
        """These sessions had the names before we were restarted; whether they still live will be seen."""
        for name, token in tokens.items():
            self._names[name] = _Session(token, None, lost_s=-math.inf)

    def _gives_way(
        self, session: _Session, token: str | None, connection: int, now_s: float, *, without_ids: bool
    ) -> bool:
        # its owner; or the one before, who was taken for dead, and was first
        if token is not None and (token == session.token or token in session.formers):
            return True
        if session.connection is not None:
            return False
        if without_ids:
            return True
        handed_over = self._open[connection] < session.lost_order
        return not handed_over or now_s - session.lost_s >= self._takeover_s

    def _bind(self, name: str, token: str | None, connection: int) -> None:
        former = self._names.get(name)
        if former is not None and former.connection is not None:
            self._name_of.pop(former.connection, None)
        self._lost.pop(name, None)
        formers: tuple[str, ...] = ()
        # one that is back leaves whoever came in between without a claim
        if former is not None and (token is None or token not in (former.token, *former.formers)):
            formers = (*former.formers, *filter(None, [former.token]))[-_FORMERS:]
        self._names[name] = _Session(token, connection, formers)
        self._name_of[connection] = name
