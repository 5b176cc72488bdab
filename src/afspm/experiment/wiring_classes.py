"""Sockets of processes: the intermediary classes that describe sockets in a file, and the resolved addresses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from afspm.experiment.findings import SourceLocation


class WiringClass(Enum):
    """Kinds of intermediary classes, which describe sockets and are never imported."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    CACHE = "cache"
    SERVER = "control server"
    ROUTER = "router"
    CLIENT = "control client"


WIRE_CLASSES: Final[dict[str, WiringClass]] = {
    "Publisher": WiringClass.PUBLISHER,
    "Subscriber": WiringClass.SUBSCRIBER,
    "Cache": WiringClass.CACHE,
    "Server": WiringClass.SERVER,
    "Router": WiringClass.ROUTER,
    "Client": WiringClass.CLIENT,
}

_REQUESTS = {"request_timeout_ms", "request_retries"}
WIRE_SETTINGS: Final[dict[WiringClass, frozenset[str]]] = {
    WiringClass.PUBLISHER: frozenset({"url"}),
    WiringClass.SUBSCRIBER: frozenset({"sub_url", "topics_to_sub"}),
    WiringClass.CACHE: frozenset({"url", "sub_url"}),
    WiringClass.SERVER: frozenset({"url"}),
    WiringClass.ROUTER: frozenset({"server_url", "router_url", *_REQUESTS}),
    WiringClass.CLIENT: frozenset({"url", *_REQUESTS}),
}
"""Valid settings of each kind of intermediary."""

# Keys of a component that name its intermediaries, and the kinds that fit.
WIRE_KEYS: Final[dict[str, tuple[WiringClass, ...]]] = {
    "subscriber": (WiringClass.SUBSCRIBER,),
    "control_client": (WiringClass.CLIENT,),
    "publisher": (WiringClass.PUBLISHER,),
    "control_server": (WiringClass.SERVER,),
    "pubsubcache": (WiringClass.CACHE,),
    "router": (WiringClass.ROUTER,),
}


def wire_of(table: object) -> WiringClass | None:
    """Return the kind of an intermediary table; None for any other value."""
    name = table.get("class") if isinstance(table, Mapping) else None
    return WIRE_CLASSES.get(name) if isinstance(name, str) else None


@dataclass(frozen=True)
class BoundSocket:
    """A socket that a process binds; `address` is the file's value of `key`, None if the address is open."""

    owner: str
    use: str
    address: str | None
    key: str
    place: SourceLocation
    keyed: bool = True
    """Whether peers need a key, if the experiment has keys."""


@dataclass
class WiringKeys:
    """Wiring keys of one component, as plain addresses."""

    publish: str | None = None
    subscribe: list[str] | None = None
    envelopes: list[str] | None = None
    control: str | None = None
    serve: str | None = None
    cache_in: str | None = None
    cache_out: str | None = None
    request_timeout_s: float | None = None
    request_retries: int | None = None


@dataclass(frozen=True)
class ProcessSockets:
    """Sockets of one process; an open address is the key "owner/use" of a `BoundSocket` until an address is chosen."""

    publish: str | None = None
    subscribe: tuple[str, ...] = ()
    serve: str | None = None
    control: str | None = None


@dataclass
class Wiring:
    """All bound sockets and connections of an experiment."""

    slots: dict[str, BoundSocket] = field(default_factory=dict)
    links: dict[str, ProcessSockets] = field(default_factory=dict)

    def addresses(self, take: Callable[[], str]) -> dict[str, str]:
        """Return the address of every bound socket by its key; `take()` supplies the addresses left open."""
        return {key: slot.address or take() for key, slot in self.slots.items()}
