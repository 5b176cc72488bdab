"""Calls of GXSM: one small protocol, whichever way they go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from afspm.basics.errors import ConfigError
from afspm.plugins.gxsm.errors import BadReply, GxsmError
from afspm.translator.driver_base import ControllerLost
from afspm.translator.tcp import host_and_port

BLOCK = "gxsm4_py_shm_data_block"
PROCESS = "gxsm4"
HINT = 'address = "127.0.0.1:65431", or "shm" for Gxsm4 without the bridge'


class Link(Protocol):
    """Calls of the functions of GXSM's own module `gxsm`."""

    def call(self, method: str, *arguments: str | int | float) -> Any:
        """Call one.

        Raises:
            GxsmError: it could not be done; the link is as before.
            ControllerLost: no answer, or none to be believed; the link is of no more use.
        """

    def working_folder(self) -> Path | None:
        """Return the folder in which GXSM was started; None: that can't be told. Raises as `call`."""

    def close(self) -> None:
        """Let go of it."""


@dataclass(frozen=True)
class Address:
    """Where GXSM is.

    Attributes:
        host, port: of the bridge; or
        block, process: of the shared memory, and the name or number of the process that has it.
    """

    host: str = ""
    port: int = 0
    block: str = ""
    process: str = ""

    @classmethod
    def parse(cls, text: str) -> Address:
        """From "HOST:PORT", or "shm[:BLOCK[@PROCESS]]".

        Raises:
            ConfigError: neither.
        """
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
    """A link to GXSM.

    Args:
        timeout_s: how long an answer may take, in real time.
        monotonic_s: real time.
        secret_file: of the bridge, if it is not where the bridge puts it.

    Raises:
        ControllerLost: it is not there. ConfigError: not on this computer.
    """
    if address.block:
        from afspm.plugins.gxsm.shared_memory import SharedMemoryLink

        return SharedMemoryLink(address.block, address.process, timeout_s, monotonic_s)
    from afspm.plugins.gxsm.bridge_client import BridgeLink

    return BridgeLink((address.host, address.port), timeout_s, monotonic_s, secret_file)


class Asking:
    """A link whose answers are of the kind that they should be."""

    def __init__(self, link: Link) -> None:
        self.call = link.call
        self.working_folder = link.working_folder
        self.close = link.close

    def number(self, method: str, *arguments: str | int | float) -> float:
        """A number. Raises BadReply: another thing. As `Link.call`."""
        value = self.call(method, *arguments)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}{arguments}, which is not a number")
        return float(value)

    def text(self, method: str, *arguments: str | int | float) -> str:
        """A text. Raises BadReply: another thing. As `Link.call`."""
        value = self.call(method, *arguments)
        if not isinstance(value, str):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}{arguments}, which is not a text")
        return value

    def numbers(self, method: str, *arguments: str | int | float) -> list[float]:
        """Several numbers. Raises BadReply: another thing. As `Link.call`."""
        value = self.call(method, *arguments)
        if not isinstance(value, tuple | list) or not all(isinstance(one, int | float) for one in value):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}{arguments}, which are no numbers")
        return [float(one) for one in value]

    def names(self, method: str) -> frozenset[str]:
        """A list of names. Raises BadReply: another thing. As `Link.call`."""
        value = self.call(method)
        if not isinstance(value, tuple | list) or not all(isinstance(one, str) for one in value):
            raise BadReply(f"GXSM replied {value!r:.100} to {method}, which are no names")
        return frozenset(value)


__all__ = ["Address", "Asking", "BadReply", "ControllerLost", "GxsmError", "Link", "open_link"]
