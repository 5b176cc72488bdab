"""Who may look and who may steer: names, passwords, and the cookies that remember them."""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import os
import re
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from afspm.errors import ConfigError

PASSWORD = "AFSPM_DASHBOARD_PASSWORD"
TOKEN = "AFSPM_DASHBOARD_TOKEN"
COOKIE = "afspm_dashboard"
REMEMBERED_S = 30 * 24 * 3600
LONGEST_NAME = 40
_COST = {"n": 2**14, "r": 8, "p": 1}
_NAME = re.compile(r"[\w][\w .'-]*", re.UNICODE)
_TRIES, _TRIES_WITHIN_S = 5, 60.0
_MOST_ADDRESSES = 1000


def hashed(password: str) -> str:
    """A password as it may be written down: "scrypt:<salt>:<hash>"."""
    salt = os.urandom(16)
    return f"scrypt:{_text(salt)}:{_text(_scrypt(password, salt))}"


def matches(password: str, kept: str) -> bool:
    """Whether a password is the one of `kept`, a result of `hashed`."""
    _, salt, digest = kept.split(":")
    return hmac.compare_digest(_scrypt(password, base64.b64decode(salt)), base64.b64decode(digest))


def is_hash(text: str) -> bool:
    """Whether a text is what `hashed` makes."""
    return re.fullmatch(r"scrypt:[A-Za-z0-9+/=]{24}:[A-Za-z0-9+/=]{44,88}", text) is not None


def is_loopback(host: str) -> bool:
    """Whether an address to listen at is reached from this computer only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_name(name: str) -> str:
    """The name of a person as it may stand in the record; empty if it may not."""
    name = " ".join(name.split())
    return name if len(name) <= LONGEST_NAME and _NAME.fullmatch(name) else ""


@dataclass(frozen=True)
class Visitor:
    """Whoever looks at the page.

    Attributes:
        person: the name; empty: only looks.
    """

    person: str = ""

    @property
    def may_steer(self) -> bool:
        return bool(self.person)


class Access:
    """Decides who comes in.

    Args:
        host: the address that is listened at. On loopback everybody may look, and gives a name to steer.
        password_hash: see `hashed`; the password itself may be in the environment instead (AFSPM_DASHBOARD_PASSWORD),
            as may a token (AFSPM_DASHBOARD_TOKEN) for programs and links.
        now_s: the time in real seconds, for what is remembered and how often one may try.
        secret: what cookies are signed with.

    Raises:
        ConfigError: other computers could reach it, and there is neither password nor token.
    """

    def __init__(
        self,
        host: str,
        password_hash: str,
        now_s: Callable[[], float],
        secret: bytes,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        if password_hash and not is_hash(password_hash):
            raise ConfigError(
                "password_hash is not the hash of a password", where="dashboard",
                hint="`afspm dashboard --make-password` makes one; the password itself doesn't belong into the file",
            )  # fmt: skip
        password, token = environment.get(PASSWORD, ""), environment.get(TOKEN, "")
        self._password = hashed(password) if password else password_hash
        self._token = hashlib.sha256(token.encode()).digest() if token else b""
        self.is_open = is_loopback(host) and not self._password and not self._token
        if not is_loopback(host) and not self._password and not self._token:
            raise ConfigError(
                f"at {host} other computers can reach the dashboard, and it has neither password nor token",
                where="dashboard",
                hint=f"set password_hash (`afspm dashboard --make-password`), or {PASSWORD} or {TOKEN} in the "
                "environment; or listen on 127.0.0.1",
            )
        # with another password, what was signed before counts no more
        self._key = hmac.digest(secret, f"{self._password and password_hash}|{password}|{token}".encode(), "sha256")
        self._now_s = now_s
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    @property
    def wants_password(self) -> bool:
        return bool(self._password)

    def visitor(self, cookie: str | None) -> Visitor | None:
        """Who shows a cookie; None: nobody who may come in."""
        found = self._signed(cookie or "")
        return Visitor() if found is None and self.is_open else found

    def by_token(self, token: str, person: str, address: str) -> Visitor | None:
        """Who shows a token; None if it is wrong, or was wrong too often."""
        if self.wait_s(address):
            return None
        if self._is_token(token):
            return Visitor(check_name(person))
        self._remember_failure(address)
        return None

    def wait_s(self, address: str) -> float:
        """How long an address that was wrong too often has to wait until it may try again; 0 if it needn't."""
        failures = self._failures.get(address)
        if failures is None or len(failures) < _TRIES:
            return 0.0
        return max(0.0, failures[0] + _TRIES_WITHIN_S - self._now_s())

    def enter(self, person: str, password: str, address: str) -> str | None:
        """Come in by password or token; returns the cookie, None if it is wrong (then `wait_s` may be above zero).

        It takes some hundredths of a second. Whoever has to wait is not even looked at.
        """
        if self.wait_s(address):
            return None
        if not self.is_open and not self._is_right(password):
            self._remember_failure(address)
            return None
        self._failures.pop(address, None)
        return self.cookie(person)

    def cookie(self, person: str) -> str:
        """What the browser shows next time."""
        body = base64.urlsafe_b64encode(f"{int(self._now_s())}|{person}".encode()).decode()
        return f"{body}.{self._signature(body)}"

    def _signed(self, cookie: str) -> Visitor | None:
        body, _, signature = cookie.partition(".")
        if not signature or not hmac.compare_digest(self._signature(body).encode(), signature.encode()):
            return None
        since, _, person = base64.urlsafe_b64decode(body).decode().partition("|")
        return Visitor(person) if self._now_s() - float(since) < REMEMBERED_S else None

    def _signature(self, body: str) -> str:
        return hmac.new(self._key, body.encode(), "sha256").hexdigest()

    def _is_right(self, password: str) -> bool:
        return self._is_token(password) or (bool(self._password) and matches(password, self._password))

    def _is_token(self, token: str) -> bool:
        return bool(self._token) and hmac.compare_digest(hashlib.sha256(token.encode()).digest(), self._token)

    def _remember_failure(self, address: str) -> None:
        failures = self._failures.setdefault(address, deque(maxlen=_TRIES))
        failures.append(self._now_s())
        self._failures.move_to_end(address)
        if len(self._failures) > _MOST_ADDRESSES:
            self._failures.popitem(last=False)
        while failures and failures[0] < self._now_s() - _TRIES_WITHIN_S:
            failures.popleft()


def secret_in(file: Path | None) -> bytes:
    """The secret that cookies are signed with, kept so that they outlive a restart; None: of this life only."""
    if file is None:
        return os.urandom(32)
    try:
        return file.read_bytes()
    except FileNotFoundError:
        pass
    secret = os.urandom(32)
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(secret)
    return secret


def _scrypt(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, dklen=32, maxmem=64 << 20, **_COST)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
