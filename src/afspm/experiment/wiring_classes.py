"""The intermediary classes, which say where sockets are, and the keys by which components name them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final


class WiringClass(Enum):
    """The kinds of intermediary classes: they say where sockets are, and are not imported."""

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
"""The settings that each kind understands."""

# The keys by which a component names its intermediaries, and the kinds that fit.
WIRE_KEYS: Final[dict[str, tuple[WiringClass, ...]]] = {
    "subscriber": (WiringClass.SUBSCRIBER,),
    "control_client": (WiringClass.CLIENT,),
    "publisher": (WiringClass.PUBLISHER,),
    "control_server": (WiringClass.SERVER,),
    "pubsubcache": (WiringClass.CACHE,),
    "router": (WiringClass.ROUTER,),
}


def wire_of(table: object) -> WiringClass | None:
    """Return the kind of intermediary that a value is, or None."""
    name = table.get("class") if isinstance(table, Mapping) else None
    return WIRE_CLASSES.get(name) if isinstance(name, str) else None
