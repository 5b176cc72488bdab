"""Names and passwords of those who may look at an experiment, or steer it, over HTTP."""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import os
import re
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping

from afspm.errors import ConfigError

LONGEST_NAME = 40
_COST = {"n": 2**14, "r": 8, "p": 1}
_NAME = re.compile(r"[\w][\w .'-]*", re.UNICODE)
_TRIES, _TRIES_WITHIN_S = 5, 60.0
_MOST_ADDRESSES = 1000


def hashed(password: str) -> str:
    """Return a password as it may be written down: "scrypt:<salt>:<hash>"."""
    salt = os.urandom(16)
    return f"scrypt:{_text(salt)}:{_text(_scrypt(password, salt))}"


def matches(password: str, kept: str) -> bool:
    """Return whether a password is the one of `kept`, a result of `hashed`."""
    _, salt, digest = kept.split(":")
    return hmac.compare_digest(_scrypt(password, base64.b64decode(salt)), base64.b64decode(digest))


def is_hash(text: str) -> bool:
    """Return whether a text is what `hashed` makes."""
    return re.fullmatch(r"scrypt:[A-Za-z0-9+/=]{24}:[A-Za-z0-9+/=]{44,88}", text) is not None


def is_loopback(host: str) -> bool:
    """Return whether an address to listen at is reached from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_name(name: str) -> str:
    """Return the name of a person as it may stand in the record; empty if it may not."""
    name = " ".join(name.split())
    return name if len(name) <= LONGEST_NAME and _NAME.fullmatch(name) else ""


class Passwords:
    """Decides whom a server lets look, and whom it believes a name.

    On loopback without passwords everybody may look, and any name is believed. Where there is a common password, only
    those who know it may look. Where there are persons, only they have names, each with a password of the own.

    Args:
        host: the address that is listened at.
        password_hash: of the common password, see `hashed`.
        people: the hash of each person's password.
        now_s: the time in real seconds, for how often an address may try.

    Raises:
        ConfigError: a hash or a name is none.
    """

    def __init__(self, host: str, password_hash: str, people: Mapping[str, str], now_s: Callable[[], float]) -> None:
        for person, kept in {"": password_hash, **people}.items():
            _require_hash(person, kept)
        # "" is the name of those who only look
        self._hashes = {**people, "": password_hash}
        self._local = is_loopback(host)
        self._now_s = now_s
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()
        self._proved: set[bytes] = set()

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
        """True if everybody may look."""
        return self._local and not self._hashes[""]

    def wait_s(self, address: str) -> float:
        """Return how long an address that was wrong too often has to wait; 0 if it needn't."""
        failures = self._failures.get(address)
        if failures is None or len(failures) < _TRIES:
            return 0.0
        return max(0.0, failures[0] + _TRIES_WITHIN_S - self._now_s())

    def proves(self, person: str, password: str, address: str) -> bool:
        """Return whether a password is that of a person; False also if the address has to wait.

        It takes some hundredths of a second. An address that has to wait is not even looked at.
        """
        return not self.wait_s(address) and self._proves(person, password, address)

    def knows(self, person: str) -> bool:
        """Return whether there is a password of this person."""
        return person in self._hashes

    def forgive(self, address: str) -> None:
        """Forget how often an address was wrong."""
        self._failures.pop(address, None)

    def proof_of(self, person: str) -> str:
        """Return what stands for a person's password: with another one it is another."""
        if self.is_open:
            return ""
        return hashlib.sha256(self._hashes.get(person, "nobody").encode()).hexdigest()

    def _proves(self, person: str, password: str, address: str) -> bool:
        if self.is_open or (not person and self.lets_look):
            return True
        shown = hashlib.sha256(f"{person}\0{password}".encode()).digest()
        if shown in self._proved:
            return True
        # for a name that nobody has it takes as long as for the others
        kept = self._hashes.get(person) or _NOBODYS
        if matches(password, kept) and kept is not _NOBODYS:
            self._proved.add(shown)
            return True
        self._remember_failure(address)
        return False

    def _remember_failure(self, address: str) -> None:
        failures = self._failures.setdefault(address, deque(maxlen=_TRIES))
        failures.append(self._now_s())
        self._failures.move_to_end(address)
        if len(self._failures) > _MOST_ADDRESSES:
            self._failures.popitem(last=False)
        while failures and failures[0] < self._now_s() - _TRIES_WITHIN_S:
            failures.popleft()


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


_NOBODYS = f"scrypt:{_text(bytes(16))}:{_text(bytes(32))}"
