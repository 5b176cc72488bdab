"""Sessions: ownership of a client's name by one connection, over restarts, and with two processes under one name.

A name belongs to one session at a time: one life of one process. Its first connection binds the name. Later
connections show the session's token in their request ids ("<name>/<token>/<n>"). For peers without ids, the connection
is the session.

A ROUTER socket hands an identity over to its newest connection. The owner then gets no more answers and connects
again. So when a second process takes a name in use, the first is disconnected *after* the second was accepted, while a
restarted process connects after its former life was disconnected. This order distinguishes an impostor, which is
refused, from a restart, which is the same client. A presumed dead process that sends again was alive all the time: it
was first, and regains its name.

Peers without ids close their connection and open another when an answer is late; the order of these two events is
chance. Such a connection has to wait a moment (`Hearing.UNCLEAR`), and gets the name if the older connection closes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from functools import lru_cache

from afspm.basics.frozen import replace, without

# tokens of earlier sessions of a name that may still come back
_FORMERS = 8
_RUN = re.compile("[0-9a-f]{16}")


class Hearing(Enum):
    """The verdict on a message under a name from a connection."""

    ACCEPTED = auto()
    STALE = auto()
    """The connection is closed already: no answer is possible, and the sender will repeat its request."""
    TAKEN = auto()
    """Another live process has this name."""
    UNCLEAR = auto()
    """As TAKEN, but both may be one process: judge again when the other connection closes, or a moment later."""


@dataclass(frozen=True)
class _Session:
    token: str | None
    connection: int | None
    formers: tuple[str, ...] = ()  # tokens of the sessions that it replaced
    lost_order: int = 0
    lost_s: float = 0.0
    has_ids: bool = True  # until its first request without an id
    since_s: float = -math.inf  # first message of its connection


KEYED = "key"
"""Text in place of the token in ids that are the same in every life: "<name>/key/<key>/<n>"."""


def token_of(name: str, request_id: str) -> str | None:
    """Return the session's token in a request id; None for an id without one (a caller's own key)."""
    who, *rest = request_id.split("/")
    if who != name or not 2 <= len(rest) <= 3 or rest[0] == KEYED:
        return None
    return rest[0] if all(map(str.isdigit, rest[1:])) else None  # a number, and perhaps the number of an attempt


@lru_cache(64)  # the steps of one request ask for the number of its id seven times
def number_of(request_id: str) -> tuple[str, int] | None:
    """Return session and number of an id "<name>/<token>/<n>"; None for other forms.

    Numbers rise within a session. The ids of a measurement have two more numbers, or a key, and never count here: its
    attempts are hours apart.
    """
    session, _, number = request_id.rpartition("/")
    name, _, token = session.partition("/")
    is_numbered = bool(name and token) and token != KEYED and "/" not in token and number.isascii()
    return (session, int(number)) if is_numbered and number.isdigit() else None


def key_of(name: str, request_id: str) -> str:
    """Return the key of a measurement in a request id, "<name>/key/<key>/<n>"; empty if there is none."""
    who, _, rest = request_id.partition("/")
    parts = rest.split("/")
    return parts[1] if who == name and len(parts) == 3 and parts[0] == KEYED else ""


def run_of(name: str, request_id: str) -> str:
    """Return the identity of the run in a request id, "<name>/<run>-<life>/<n>"; empty if there is none."""
    run, dash, _ = (token_of(name, request_id) or "").partition("-")
    return run if dash and _RUN.fullmatch(run) else ""


@dataclass(frozen=True)
class SessionTable:
    """The sessions of the names in use.

    Attributes:
        takeover_s: real time for which a transferred name is reserved for its owner. A peer with an unnoticed loss of
            its connection can restart under its name after this time at the latest.
        keep: maximum number of names without a connection.
        opened: open connections, with the order of their opening.
        lost: names without a connection, oldest first.
    """

    takeover_s: float = 3.0
    keep: int = 1000
    order: int = 0
    highest: int = -1
    opened: Mapping[int, int] = field(default_factory=dict)
    names: Mapping[str, _Session] = field(default_factory=dict)
    name_of: Mapping[int, str] = field(default_factory=dict)
    lost: tuple[str, ...] = ()

    def connected(self, connection: int) -> SessionTable:
        order = self.order + 1
        highest = max(self.highest, connection)
        return replace(self, order=order, opened={**self.opened, connection: order}, highest=highest)

    def disconnected(self, connection: int, now_s: float) -> tuple[SessionTable, str | None]:
        """Drop a connection; also return the name of the session that used it, if any."""
        table = replace(self, order=self.order + 1, opened=without(self.opened, connection))
        name = self.name_of.get(connection)
        if name is None:
            return table, None
        session = replace(self.names[name], connection=None, lost_order=table.order, lost_s=now_s)
        names, lost = {**self.names, name: session}, (*self.lost, name)
        if len(lost) > self.keep:
            names, lost = without(names, lost[0]), lost[1:]
        return replace(table, names=names, lost=lost, name_of=without(self.name_of, connection)), name

    def hear(self, connection: int, name: str, request_id: str | None, now_s: float) -> tuple[SessionTable, Hearing]:
        """Judge a message from `name` over `connection`; bind the name if the message is accepted.

        Args:
            request_id: id of the request, empty without an id; None for a message with a name only.
        """
        session = self.names.get(name)
        has_ids, token = request_id != "", token_of(name, request_id or "")
        if session is not None and session.connection == connection:
            if session.token is None and (token is not None or session.has_ids != has_ids):
                formers = () if token in session.formers else session.formers
                session = replace(session, token=token, has_ids=has_ids, formers=formers)
                return replace(self, names={**self.names, name: session}), Hearing.ACCEPTED
            return self, Hearing.ACCEPTED
        table = self
        if connection not in self.opened:
            if connection <= self.highest:
                return self, Hearing.STALE
            table = self.connected(connection)
        without_ids = session is not None and not (session.has_ids or has_ids)
        if session is not None and not table._gives_way(session, token, connection, now_s, without_ids=without_ids):
            return table, Hearing.UNCLEAR if without_ids else Hearing.TAKEN
        return table.bound(name, token, connection, has_ids=has_ids, since_s=now_s), Hearing.ACCEPTED

    def connection_of(self, name: str) -> int | None:
        """Return the connection for answers to `name`; None if it has none."""
        session = self.names.get(name)
        return session.connection if session is not None else None

    def token(self, name: str) -> str | None:
        """Return the token of the newest session of a name; None if unknown."""
        session = self.names.get(name)
        return None if session is None else session.token

    def lost_since_s(self, name: str) -> float | None:
        """Return the real time at which a known name lost its connection; None if connected or unknown."""
        session = self.names.get(name)
        if session is None or session.connection is not None or session.lost_s == -math.inf:
            return None
        return session.lost_s

    def since_s(self, name: str) -> float:
        """Return the real time of the first message by the newest connection of a name; -inf for an unknown name."""
        session = self.names.get(name)
        return -math.inf if session is None else session.since_s

    def tokens(self) -> dict[str, str]:
        """Return the tokens of the connected sessions, to save over a restart."""
        return {name: s.token for name, s in self.names.items() if s.token is not None and s.connection is not None}

    def restored(self, tokens: Mapping[str, str]) -> SessionTable:
        """Restore the sessions connected before a restart; some may have ended since."""
        restored = {name: _Session(token, None, lost_s=-math.inf) for name, token in tokens.items()}
        return replace(self, names={**self.names, **restored})

    def _gives_way(
        self, session: _Session, token: str | None, connection: int, now_s: float, *, without_ids: bool
    ) -> bool:
        # the owner; or the owner before, which was presumed dead, and was first
        if token is not None and (token == session.token or token in session.formers):
            return True
        if session.connection is not None:
            return False
        if without_ids:
            return True
        handed_over = self.opened[connection] < session.lost_order
        return not handed_over or now_s - session.lost_s >= self.takeover_s

    def bound(
        self, name: str, token: str | None, connection: int, *, has_ids: bool = True, since_s: float = -math.inf
    ) -> SessionTable:
        former, name_of, formers = self.names.get(name), dict(self.name_of), tuple[str, ...]()
        if former is not None and former.connection is not None:
            name_of.pop(former.connection, None)
        # an owner that is back deletes the claims of the sessions in between
        if former is not None and (token is None or token not in (former.token, *former.formers)):
            formers = (*former.formers, *filter(None, [former.token]))[-_FORMERS:]
        session = _Session(token, connection, formers, has_ids=has_ids, since_s=since_s)
        lost = tuple(one for one in self.lost if one != name)
        return replace(self, names={**self.names, name: session}, name_of={**name_of, connection: name}, lost=lost)
