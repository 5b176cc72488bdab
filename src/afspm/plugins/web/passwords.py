"""Names and passwords of persons who may watch or steer an experiment over HTTP."""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import os
import re
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping

from afspm.basics import ConfigError

LONGEST_NAME = 40
# some hundredths of a second per password: slow for guessing, quick enough for a request
_COST = {"n": 2**14, "r": 8, "p": 1}
_NAME = re.compile(r"[\w][\w .'-]*", re.UNICODE)
_TRIES, _TRIES_WITHIN_S = 5, 60.0
AGAIN_S = 3.0
"""Real seconds between two checked tries, after too many wrong tries. Refusing all tries would lock out the owner of
the right password, since any program on the same computer could try wrong passwords under the same name. Delayed
answers instead would hold connections."""
# bounded: addresses and wrong names are chosen by clients
_MOST_REMEMBERED = 1000


def hashed(password: str) -> str:
    """Return a password's salted hash for a file: "scrypt:<salt>:<hash>"."""
    salt = os.urandom(16)
    return f"scrypt:{_text(salt)}:{_text(_scrypt(password, salt))}"


def matches(password: str, kept: str) -> bool:
    """Return whether a password matches `kept`, a result of `hashed`."""
    _, salt, digest = kept.split(":")
    return hmac.compare_digest(_scrypt(password, base64.b64decode(salt)), base64.b64decode(digest))


def is_hash(text: str) -> bool:
    """Return whether a text has the form of a result of `hashed`."""
    return re.fullmatch(r"scrypt:[A-Za-z0-9+/=]{24}:[A-Za-z0-9+/=]{44,88}", text) is not None


def is_loopback(host: str) -> bool:
    """Return whether a listening address can be reached only from this computer."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_name(name: str) -> str:
    """Return a person's name in its recorded form; empty for a forbidden name."""
    name = " ".join(name.split())
    return name if len(name) <= LONGEST_NAME and _NAME.fullmatch(name) else ""


class Passwords:
    """The check of passwords for looking and of passwords for names.

    On loopback without passwords every viewer may look, and any name is accepted. With a common password, a viewer
    needs this password to look. With `people`, only their names are accepted, each with its password.

    Args:
        host: the address to listen at.
        password_hash: hash of the common password, see `hashed`.
        people: the hash of each person's password.
        now_s: the time in real seconds, for the rate limit of attempts.

    Raises:
        ConfigError: a malformed hash or name.
    """

    def __init__(self, host: str, password_hash: str, people: Mapping[str, str], now_s: Callable[[], float]) -> None:
        for person, kept in {"": password_hash, **people}.items():
            _require_hash(person, kept)
        # "" is the name for the common password
        self._hashes = {**people, "": password_hash}
        self._local = is_loopback(host)
        self._now_s = now_s
        self._lock = threading.Lock()
        self._tries: OrderedDict[_Prover, _Tries] = OrderedDict()
        self._proved: OrderedDict[bytes, None] = OrderedDict()

    @property
    def is_unprotected(self) -> bool:
        """True if other computers can come in without a password."""
        return not self._local and not any(self._hashes.values())

    @property
    def is_open(self) -> bool:
        """True if a name alone is enough to steer."""
        return self._local and not any(self._hashes.values())

    @property
    def lets_look(self) -> bool:
        """True if every viewer may look."""
        return self._local and not self._hashes[""]

    def wait_s(self, person: str, address: str) -> float:
        """Return the real seconds until another password of this person is checked from this address; 0: now."""
        with self._lock:
            tries = self._tries.get(self._prover(person, address))
            return 0.0 if tries is None else tries.wait_s(self._now_s())

    def proves(self, person: str, password: str, address: str) -> bool:
        """Return whether a password is right; False also while checks are suspended (see `wait_s`).

        The check takes some hundredths of a second. A password that was right before, from the same address, is
        accepted at once, after any number of wrong tries there.
        """
        if self.is_open or (not person and self.lets_look):
            return True
        # a fast hash, only in memory: it recognises a password that scrypt has accepted before
        shown = hashlib.sha256(f"{address}\0{person}\0{password}".encode()).digest()
        prover = self._prover(person, address)
        with self._lock:
            if shown in self._proved:
                self._proved.move_to_end(shown)
                return True
            if not self._may_try(prover):
                return False
        # an unknown name takes as long as a known one
        kept = self._hashes.get(person) or _UNKNOWN
        if not matches(password, kept) or kept is _UNKNOWN:
            return False
        with self._lock:
            self._tries.pop(prover, None)
            self._proved[shown] = None
            if len(self._proved) > _MOST_REMEMBERED:
                self._proved.popitem(last=False)
        return True

    def proof_of(self, person: str) -> str:
        """Return a text that changes with a person's password; empty if a name alone is enough."""
        if self.is_open:
            return ""
        return hashlib.sha256(self._hashes.get(person, "nobody").encode()).hexdigest()

    def _prover(self, person: str, address: str) -> _Prover:
        # wrong passwords slow down neither other persons at this address, nor this person elsewhere
        return address, person if person in self._hashes else None

    def _may_try(self, prover: _Prover) -> bool:
        # a try counts as wrong until it is checked: many may arrive at once
        tries = self._tries.setdefault(prover, _Tries())
        self._tries.move_to_end(prover)
        if len(self._tries) > _MOST_REMEMBERED:
            self._tries.popitem(last=False)
        now_s = self._now_s()
        if tries.wait_s(now_s):
            return False
        tries.add(now_s)
        return True


_Prover = tuple[str, str | None]
"""An address, and the person whose password is tried there; None: an unknown name."""


class _Tries:
    """The times of the last attempts, in real seconds."""

    def __init__(self) -> None:
        self._at_s: deque[float] = deque(maxlen=_TRIES + 1)

    def wait_s(self, now_s: float) -> float:
        """Return the seconds until the next attempt is allowed; 0: now."""
        lately = [at_s for at_s in self._at_s if now_s - at_s < _TRIES_WITHIN_S]
        return max(0.0, lately[-1] + AGAIN_S - now_s) if len(lately) > _TRIES else 0.0

    def add(self, now_s: float) -> None:
        self._at_s.append(now_s)


def _require_hash(person: str, kept: str) -> None:
    setting = f"people, {person!r}" if person else "password_hash"
    if person != check_name(person):
        raise ConfigError(
            f"{setting}: this is not a valid name",
            hint=f"letters, digits, spaces, - . and ', at most {LONGEST_NAME}",
        )  # fmt: skip
    if (kept or person) and not is_hash(kept):
        raise ConfigError(
            f"{setting} is not the hash of a password",
            hint="`afspm dashboard --make-password` makes one; do not write the password itself into the file",
        )  # fmt: skip


def _scrypt(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, dklen=32, maxmem=64 << 20, **_COST)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


# no password has this hash; checking against it takes the same time as for a known name
_UNKNOWN = f"scrypt:{_text(bytes(16))}:{_text(bytes(32))}"
