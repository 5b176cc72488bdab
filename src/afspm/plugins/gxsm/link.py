"""Calls of GXSM's functions: one protocol for both transports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from afspm.basics import ConfigError
from afspm.driver import ControllerLost, host_and_port
from afspm.plugins.gxsm.errors import BadReply, GxsmError

BLOCK = "gxsm4_py_shm_data_block"
PROCESS = "gxsm4"
HINT = 'address = "127.0.0.1:65431", or "shm" for Gxsm4 without the bridge'


class Link(Protocol):
    """A transport for calls of GXSM's own module `gxsm`."""

    def call(self, method: str, *arguments: str | int | float) -> Any:
        """Call a function.

        Raises:
            GxsmError: GXSM reports an error, or the call is too long; the link stays usable.
            ControllerLost: no answer, or a malformed answer; the link is closed.
        """

    def working_folder(self) -> Path | None:
        """Return the folder in which GXSM was started; None: unknown. Raises the errors of `call`."""

    def close(self) -> None:
        """Close the link."""


@dataclass(frozen=True)
class Address:
    """The address of GXSM: a bridge, or shared memory.

    Attributes:
        host, port: address of the bridge; empty for shared memory.
        block, process: name of the shared memory, name or number of its process; empty for a bridge.
    """

    host: str = ""
    port: int = 0
    block: str = ""
    process: str = ""

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse "HOST:PORT" or "shm[:BLOCK[@PROCESS]]". Raises ConfigError: another form, or a "/" in BLOCK."""
        kind, _, rest = text.partition(":")
        if kind == "shm":
            block, _, process = rest.partition("@")
            if "/" in block:
                raise ConfigError(f"{block!r} is not a name of shared memory", where="address", hint=HINT)
            return cls(block=block or BLOCK, process=process or PROCESS)
        host, port = host_and_port(text, HINT)
        return cls(host=host, port=port)


def open_link(
    address: Address, timeout_s: float, monotonic_s: Callable[[], float], secret_file: Path | None = None
) -> Link:
    """Open a link to GXSM.

    Args:
        timeout_s: longest wait for an answer, real time.
        monotonic_s: returns real time.
        secret_file: copy of the bridge's secret. Default: the bridge's own file in this user's home.

    Raises:
        ControllerLost: no program listens at the address, or no single GXSM serves the shared memory.
        ConfigError: shared memory on another system than Linux.
    """
    if address.block:
        from afspm.plugins.gxsm.shared_memory import SharedMemoryLink

        return SharedMemoryLink(address.block, address.process, timeout_s, monotonic_s)
    from afspm.plugins.gxsm.bridge_client import BridgeLink

    return BridgeLink((address.host, address.port), timeout_s, monotonic_s, secret_file)


class Asking:
    """A link with type-checked answers."""

    def __init__(self, link: Link) -> None:
        self.call = link.call
        self.working_folder = link.working_folder
        self.close = link.close

    def number(self, method: str, *arguments: str | int | float) -> float:
        """Call a function that returns a number. Raises BadReply: the answer is no number. See `Link.call`."""
        value = self.call(method, *arguments)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}{arguments}, which is not a number")
        return float(value)

    def text(self, method: str, *arguments: str | int | float) -> str:
        """Call a function that returns text. Raises BadReply: the answer is no text. See `Link.call`."""
        value = self.call(method, *arguments)
        if not isinstance(value, str):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}{arguments}, which is not a text")
        return value

    def numbers(self, method: str, *arguments: str | int | float) -> list[float]:
        """Call a function that returns numbers. Raises BadReply: the answer is no list of numbers. See `Link.call`."""
        value = self.call(method, *arguments)
        if not isinstance(value, tuple | list) or not all(isinstance(one, int | float) for one in value):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}{arguments}, which are not numbers")
        return [float(one) for one in value]

    def names(self, method: str) -> frozenset[str]:
        """Call a function that returns names. Raises BadReply: the answer is no list of names. See `Link.call`."""
        value = self.call(method)
        if not isinstance(value, tuple | list) or not all(isinstance(one, str) for one in value):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}, which are not names")
        return frozenset(value)


__all__ = ["Address", "Asking", "BadReply", "ControllerLost", "GxsmError", "Link", "open_link"]
