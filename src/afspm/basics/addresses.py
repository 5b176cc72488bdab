"""Addresses in ZeroMQ's notation, and the annotation of settings that hold a listening address."""

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
    """Return whether a text is an address of this computer's or another's socket."""
    match = _ADDRESS.fullmatch(text)
    return match is not None and _has_port(match)


def hint_on(text: str) -> str:
    """Return the hint for an `inproc` address or a port out of range; empty for any other text."""
    if text.startswith("inproc://"):
        return "inproc:// stays within one process, and each component is a process: use tcp:// or ipc://"
    match = _ADDRESS.fullmatch(text)
    return f"a port is {HIGHEST_PORT} at most" if match and not _has_port(match) else ""


def _has_port(match: re.Match[str]) -> bool:
    return match[3] in (None, "*") or int(match[3]) <= HIGHEST_PORT


def reaches(connect: str, bind: str) -> bool:
    """Return whether a connection to `connect` reaches a socket bound to `bind`; a wildcard in `bind` matches any host.

    The hosts 127.0.0.1, localhost and [::1] count as equal; other host names are compared as text.
    """
    if connect == bind:
        return True
    a, b = _ADDRESS.fullmatch(connect), _ADDRESS.fullmatch(bind)
    if not a or not b or a[3] is None or a[3] != b[3]:
        return False
    here = {LOOPBACK, "localhost", "[::1]"}
    return b[2] in {"*", "0.0.0.0", "[::]"} or {a[2], b[2]} <= here


def connectable(bind: str) -> str:
    """Return the address at which processes on this computer reach a socket bound to `bind`.

    The wildcard hosts `*`, 0.0.0.0 and [::] become loopback.
    """
    bind = re.sub(r"^tcp://\[::\](?=:)", "tcp://[::1]", bind)
    return re.sub(r"^tcp://(\*|0\.0\.0\.0)(?=:)", f"tcp://{LOOPBACK}", bind)


@dataclass(frozen=True)
class Listens:
    """Annotation of a setting that holds a listening address, or a port (0: any free port).

    `afspm check` uses the annotation to find two components that listen at the same address.

    Attributes:
        host: for a port, the setting that names the host; empty: this computer only.
        keyed: whether the experiment's keys protect the address; False for web pages, which have passwords.
    """

    host: str = ""
    keyed: bool = True

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> object:
        # only pydantic calls this, so pydantic is not loaded at the top
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.checked, handler(source))

    def checked(self, value: object) -> object:
        """Return `value` if it is an address or a port.

        Raises:
            InvalidValue: `value` is neither an address nor a port.
        """
        if isinstance(value, str) and not is_address(value):
            raise InvalidValue("this is not an address", hint=hint_on(value) or EXAMPLE)
        if isinstance(value, int) and not 0 <= value <= HIGHEST_PORT:
            raise InvalidValue("this is not a port", hint=f"0 to {HIGHEST_PORT}")
        return value

    def address(self, value: object, settings: Mapping[str, object]) -> str | None:
        """Return the component's listening address; None for port 0 (any free port) or an invalid value.

        Args:
            value: value of the setting.
            settings: all settings of the component, defaults included.
        """
        if isinstance(value, int) and value:
            host = str(settings.get(self.host, LOOPBACK))
            value = f"tcp://{f'[{host}]' if ':' in host else host}:{value}"
        return value if isinstance(value, str) and is_address(value) else None


ListeningAddress = Annotated[str, Listens()]
