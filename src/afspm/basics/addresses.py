"""Addresses as ZeroMQ writes them, and settings of components that are one: what listens is known before it starts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from afspm.basics.errors import InvalidValue

LOOPBACK = "127.0.0.1"
HIGHEST_PORT = 65_535
EXAMPLE = 'as in "tcp://127.0.0.1:9000"'
_ADDRESS = re.compile(r"(tcp://(\[[0-9A-Fa-f:.%]+\]|[^:/\s]+):(\d+|\*)|ipc://\S+)")


def is_address(text: str) -> bool:
    """Return whether this is an address as ZeroMQ writes it."""
    match = _ADDRESS.fullmatch(text)
    return match is not None and _has_port(match)


def hint_on(text: str) -> str:
    """Return what to do about a text that is no address but for its port; empty: it does not even look like one."""
    match = _ADDRESS.fullmatch(text)
    return f"a port is {HIGHEST_PORT} at most" if match and not _has_port(match) else ""


def _has_port(match: re.Match[str]) -> bool:
    return match[3] in (None, "*") or int(match[3]) <= HIGHEST_PORT


def reaches(connect: str, bind: str) -> bool:
    """Return whether a connection to one address ends at what is bound at the other (a wildcard means any host)."""
    if connect == bind:
        return True
    a, b = _ADDRESS.fullmatch(connect), _ADDRESS.fullmatch(bind)
    if not a or not b or a[3] is None or a[3] != b[3]:
        return False
    here = {LOOPBACK, "localhost", "[::1]"}
    return b[2] in {"*", "0.0.0.0", "[::]"} or {a[2], b[2]} <= here


def connectable(bind: str) -> str:
    """Return how a peer on the same computer connects to what is bound: a wildcard is no address to connect to."""
    return re.sub(r"^tcp://(\*|0\.0\.0\.0)(?=:)", f"tcp://{LOOPBACK}", bind)


@dataclass(frozen=True)
class Listens:
    """Marks a setting at which a component listens, so that a check sees who else does: an address, or a port (0: any
    that is free).

    Attributes:
        host: of a port: the setting that names the host; empty: this computer only.
        keyed: whether it is ours to keep strangers out, with the keys of the experiment; a page has its passwords.
    """

    host: str = ""
    keyed: bool = True

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> object:
        """Makes pydantic refuse what is none. Called by it alone, so that we need not load it here."""
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.checked, handler(source))

    def checked(self, value: object) -> object:
        """Raises InvalidValue: neither an address nor a port."""
        if isinstance(value, str) and not is_address(value):
            raise InvalidValue("this is not an address", hint=hint_on(value) or EXAMPLE)
        if isinstance(value, int) and not 0 <= value <= HIGHEST_PORT:
            raise InvalidValue("this is not a port", hint=f"0 to {HIGHEST_PORT}")
        return value

    def address(self, value: object, settings: Mapping[str, object]) -> str | None:
        """Return where the component listens, as ZeroMQ writes it; None: it decides itself, or this is none.

        Args:
            value: of the setting.
            settings: all of the component's, those left out too.
        """
        if isinstance(value, int) and value:
            host = str(settings.get(self.host, LOOPBACK))
            value = f"tcp://{f'[{host}]' if ':' in host else host}:{value}"
        return value if isinstance(value, str) and is_address(value) else None


ListeningAddress = Annotated[str, Listens()]
