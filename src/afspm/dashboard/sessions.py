"""Who has signed in: sessions that are kept here and named by a cookie, so that they can be ended."""

from __future__ import annotations

import contextlib
import hashlib
import json
import secrets
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from afspm.storage.atomic import replace_file

COOKIE = "afspm_dashboard"
REMEMBERED_S = 30 * 24 * 3600
MOST = 1000
"""Sessions that are kept; of more the oldest end."""


@dataclass(frozen=True)
class Session:
    """A sign-in.

    Attributes:
        key: the hash of the cookie: what is on the disk opens nothing.
        person: empty for one who only looks.
        proof: stands for the password that it was begun with.
        since_s: when it began, real time.
    """

    key: str
    person: str
    proof: str
    since_s: float


class Sessions:
    """All sessions, in a file that outlives a restart. From any thread.

    Args:
        file: readable by its owner alone; None: they end with this process.
        now_s: the time in real seconds.
    """

    def __init__(self, file: Path | None, now_s: Callable[[], float]) -> None:
        self._file = file
        self._now_s = now_s
        self._lock = threading.Lock()
        self._sessions = _read(file)

    def begin(self, person: str, proof: str) -> str:
        """Begin a session; returns its cookie."""
        cookie = secrets.token_urlsafe(32)
        session = Session(_key(cookie), person, proof, self._now_s())
        with self._lock:
            self._sessions[session.key] = session
            while len(self._sessions) > MOST:
                del self._sessions[next(iter(self._sessions))]
            self._keep()
        return cookie

    def find(self, cookie: str) -> Session | None:
        """Return the session of a cookie, as long as it stands."""
        key = _key(cookie)
        with self._lock:
            return self._sessions[key] if self._stands(key) else None

    def has(self, key: str) -> bool:
        """Return whether the session of this key stands."""
        with self._lock:
            return self._stands(key)

    def end(self, cookie: str, *, everywhere: bool = False) -> None:
        """End the session of a cookie, or all of its person."""
        with self._lock:
            ended = self._sessions.pop(_key(cookie), None)
            if ended is None:
                return
            if everywhere:
                self._sessions = {k: one for k, one in self._sessions.items() if one.person != ended.person}
            self._keep()

    def _stands(self, key: str) -> bool:
        session = self._sessions.get(key)
        return session is not None and self._now_s() - session.since_s < REMEMBERED_S

    def _keep(self) -> None:
        if self._file is not None:
            text = json.dumps([asdict(session) for session in self._sessions.values()])
            with contextlib.suppress(OSError):  # on a full disk they end with this process
                replace_file(self._file, [text.encode()], mode=0o600)


def _read(file: Path | None) -> dict[str, Session]:
    if file is None:
        return {}
    try:
        found = [Session(**one) for one in json.loads(file.read_bytes())]
    except (OSError, ValueError, TypeError):
        return {}  # none yet, or damaged: everybody signs in anew
    return {session.key: session for session in found}


def _key(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()
