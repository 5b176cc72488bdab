"""Sessions of signed-in viewers: signed cookies, and a list of sessions that were ended early."""

from __future__ import annotations

import contextlib
import json
import secrets
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics import from_json
from afspm.components import replace_file

if TYPE_CHECKING:
    from itsdangerous import URLSafeSerializer

COOKIE = "afspm_dashboard"
REMEMBERED_S = 30 * 24 * 3600
MOST_ENDED = 1000
"""Limit of remembered ended sessions; beyond this limit all sessions end."""


@dataclass(frozen=True)
class Session:
    """The content of a cookie.

    Attributes:
        person: empty for a viewer who may only look.
        proof: derived from the password at the beginning of the session.
        generation: number of the person's sign-outs everywhere before the session.
        since_s: beginning of the session, real time.
    """

    person: str
    proof: str
    number: str
    generation: int
    since_s: float


@dataclass
class _Kept:
    # a reader of this file can sign cookies; with the same rights it reads the run's keys, which also steer
    key: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    ended: dict[str, float] = field(default_factory=dict)
    generations: dict[str, int] = field(default_factory=dict)


class Sessions:
    """A thread-safe signer and verifier of session cookies.

    Args:
        file: keeps the key and ended sessions over a restart, readable by its owner alone; None: sessions end with this
            process.
        now_s: the time in real seconds.
    """

    def __init__(self, file: Path | None, now_s: Callable[[], float]) -> None:
        self._file = file
        self._now_s = now_s
        self._lock = threading.Lock()
        self._kept = _read(file)
        self._save()

    def begin(self, person: str, proof: str) -> str:
        """Begin a session and return its cookie."""
        with self._lock:
            generation = self._kept.generations.get(person, 0)
            session = Session(person, proof, secrets.token_hex(8), generation, self._now_s())
            return str(self._signer().dumps(list(asdict(session).values())))

    def find(self, cookie: str) -> Session | None:
        """Return the session of a cookie; None if its signature is invalid or the session has ended."""
        with self._lock:
            is_signed, content = self._signer().loads_unsafe(cookie)
            if not is_signed or not cookie.isascii():  # base64 skips unknown letters
                return None
            session, kept = Session(*content), self._kept
            is_over = session.number in kept.ended or session.generation != kept.generations.get(session.person, 0)
            return None if is_over or self._now_s() - session.since_s >= REMEMBERED_S else session

    def end(self, cookie: str, *, everywhere: bool = False) -> None:
        """End the session of a cookie, or all sessions of its person."""
        session = self.find(cookie)
        if session is None:
            return
        with self._lock:
            kept = self._kept
            if everywhere:
                kept.generations[session.person] = kept.generations.get(session.person, 0) + 1
            oldest_s = self._now_s() - REMEMBERED_S
            kept.ended = {number: since_s for number, since_s in kept.ended.items() if since_s > oldest_s}
            kept.ended[session.number] = session.since_s
            # forgetting single sessions would revive them: a new key ends them all
            if len(kept.ended) > MOST_ENDED:
                self._kept = _Kept()
            self._save()

    def _signer(self) -> URLSafeSerializer:
        from itsdangerous import URLSafeSerializer

        return URLSafeSerializer(self._kept.key, salt="session")

    def _save(self) -> None:
        if self._file is not None:
            # on a full disk, ended sessions are remembered only until this process ends
            with contextlib.suppress(OSError):
                replace_file(self._file, [json.dumps(asdict(self._kept)).encode()], mode=0o600)


def _read(file: Path | None) -> _Kept:
    if file is None:
        return _Kept()
    try:
        return _Kept(**from_json(file.read_bytes()))
    except (OSError, ValueError, TypeError):
        return _Kept()  # missing or damaged: every person signs in again
