"""Access to the dashboard: viewers and persons who may steer, by a cookie or by a password with each request."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from afspm.basics import ConfigError
from afspm.plugins.web.dashboard.sessions import Sessions
from afspm.plugins.web.passwords import Passwords, check_name, hashed

PASSWORD = "AFSPM_DASHBOARD_PASSWORD"


@dataclass(frozen=True)
class Visitor:
    """A viewer of the page.

    Attributes:
        person: the name; empty for a viewer who may only look.
        cookie: cookie of the session; empty for a program that sends its password with each request.
        recorded: the page shows a recorded night, in which nothing can be steered.
    """

    person: str = ""
    cookie: str = ""
    recorded: bool = False

    @property
    def may_steer(self) -> bool:
        return bool(self.person) and not self.recorded


class Access:
    """The rules that decide which viewers may look, and which may steer; see `Passwords`.

    Args:
        host: the address to listen at.
        password_hash: hash of the common password; the password itself may be in the environment instead
            (AFSPM_DASHBOARD_PASSWORD).
        people: the hash of each person's password.
        now_s: the time in real seconds, for sessions and for the rate limit of password attempts.
        sessions: the sessions of signed-in viewers.

    Raises:
        ConfigError: other computers could reach the page without a password; or a malformed hash or name.
    """

    def __init__(
        self,
        host: str,
        password_hash: str,
        people: Mapping[str, str],
        now_s: Callable[[], float],
        sessions: Sessions,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        password = environment.get(PASSWORD, "")
        self._passwords = Passwords(host, hashed(password) if password else password_hash, people, now_s)
        if self._passwords.is_unprotected:
            raise ConfigError(
                f"other computers can reach the dashboard at {host}, and it has no password", where="dashboard",
                hint="set people or password_hash (`afspm dashboard --make-password`), or "
                f"{PASSWORD} in the environment; or listen on 127.0.0.1",
            )  # fmt: skip
        self._sessions = sessions

    @property
    def is_open(self) -> bool:
        """True if a name alone is enough to steer."""
        return self._passwords.is_open

    @property
    def lets_look(self) -> bool:
        """True if every viewer may look."""
        return self._passwords.lets_look

    def visitor(self, cookie: str | None) -> Visitor | None:
        """Return the viewer of a cookie; None: access is refused."""
        session = self._sessions.find(cookie or "")
        if session is not None and session.proof == self._passwords.proof_of(session.person):
            return Visitor(session.person, cookie or "")
        return Visitor() if self.lets_look else None

    def is_signed_in(self, visitor: Visitor) -> bool:
        """Return whether a visitor's session is still valid; True for a visitor without a cookie."""
        return not visitor.cookie or self._sessions.find(visitor.cookie) is not None

    def person_of(self, visitor: Visitor) -> str:
        """Return the name of a signed-in visitor; empty for all others."""
        return check_name(visitor.person) if self.is_signed_in(visitor) else ""

    def by_password(self, person: str, password: str, address: str) -> Visitor | None:
        """Return the visitor with this name and password; None if the password is wrong or checks are suspended."""
        return Visitor(person) if self._passwords.proves(person, password, address) else None

    def wait_s(self, person: str, address: str) -> float:
        """Return the real seconds until another password of this person is checked from this address; 0: now."""
        return self._passwords.wait_s(person, address)

    def enter(self, person: str, password: str, address: str) -> str | None:
        """Sign in and return the cookie; None if the password was not accepted (see `wait_s`)."""
        if not self._passwords.proves(person, password, address):
            return None
        return self.cookie(person)

    def cookie(self, person: str) -> str:
        """Begin a session and return its cookie."""
        return self._sessions.begin(person, self._passwords.proof_of(person))

    def leave(self, cookie: str | None, *, everywhere: bool = False) -> None:
        """End a session, or all sessions of its person."""
        self._sessions.end(cookie or "", everywhere=everywhere)
