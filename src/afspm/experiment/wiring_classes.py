"""The classes of the paper's form that say where sockets are, and the keys by which components name them."""

from __future__ import annotations

from enum import Enum
from typing import Final


class WiringClass(Enum):
    """The kinds of intermediary classes: they say where sockets are, and are not imported."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    COMBINED = "several subscribers"
    CACHE = "cache"
    SERVER = "control server"
    ROUTER = "router"
    CLIENT = "control client"
    CACHE_LOGIC = "cache logic"
    ENVELOPE = "envelope of scans by size"
    SPECTRA = "envelope of spectra by kind"
    HISTORIES = "histories of scans by size"


PUBLISHED_WIRES: Final = "afspm.io."
"""Where the published implementation has its intermediary classes. Their modules moved between its versions."""

WIRE_CLASSES: Final[dict[str, WiringClass]] = {
    "Publisher": WiringClass.PUBLISHER,
    "PubSubCache": WiringClass.CACHE,
    "Subscriber": WiringClass.SUBSCRIBER,
    "ComboSubscriber": WiringClass.COMBINED,
    "ControlServer": WiringClass.SERVER,
    "ControlRouter": WiringClass.ROUTER,
    "ControlClient": WiringClass.CLIENT,
    "AdminControlClient": WiringClass.CLIENT,
    "PBCScanLogic": WiringClass.CACHE_LOGIC,
    "ProtoBasedCacheLogic": WiringClass.CACHE_LOGIC,
    "CacheLogic": WiringClass.CACHE_LOGIC,
    "create_roi_scan_envelope": WiringClass.ENVELOPE,
    "create_spec_envelope": WiringClass.SPECTRA,
    "create_roi_proto_hist_list": WiringClass.HISTORIES,
}
SHORT_WIRE_CLASSES: Final[dict[str, WiringClass]] = {
    "Publisher": WiringClass.PUBLISHER,
    "Subscriber": WiringClass.SUBSCRIBER,
    "Cache": WiringClass.CACHE,
    "Server": WiringClass.SERVER,
    "Router": WiringClass.ROUTER,
    "Client": WiringClass.CLIENT,
}

_REQUESTS = {"request_timeout_ms", "request_retries"}
_CACHED = {
    "sub_url",
    "topics_to_sub",
    "sub_extract_proto",
    "update_cache",
    "extract_proto_kwargs",
    "update_cache_kwargs",
}
# What each kind understands. Settings of the published classes that only say how Python is to decode or to name
# packets are accepted and have no meaning here: decoding is the wire's, naming is the [cache] section's.
WIRE_SETTINGS: Final[dict[WiringClass, frozenset[str]]] = {
    WiringClass.PUBLISHER: frozenset({"url", "get_envelope_for_proto"}),
    WiringClass.SUBSCRIBER: frozenset(_CACHED),
    WiringClass.COMBINED: frozenset({"subs"}),
    WiringClass.CACHE: frozenset({"url", "pub_get_envelope_for_proto", *_CACHED}),
    WiringClass.SERVER: frozenset({"url"}),
    WiringClass.ROUTER: frozenset({"server_url", "router_url", *_REQUESTS}),
    WiringClass.CLIENT: frozenset({"url", "uuid", *_REQUESTS}),
    WiringClass.CACHE_LOGIC: frozenset({"default_scan_history", "proto_with_history_list"}),
    WiringClass.ENVELOPE: frozenset({"size", "channel"}),
    WiringClass.SPECTRA: frozenset({"type"}),
    WiringClass.HISTORIES: frozenset({"sizes_with_hist_list", "channels_list"}),
}

# The keys by which a component names its intermediaries, and the kinds that fit.
WIRE_KEYS: Final[dict[str, tuple[WiringClass, ...]]] = {
    "subscriber": (WiringClass.SUBSCRIBER, WiringClass.COMBINED),
    "control_client": (WiringClass.CLIENT,),
    "publisher": (WiringClass.PUBLISHER,),
    "control_server": (WiringClass.SERVER,),
    "pubsubcache": (WiringClass.CACHE,),
    "router": (WiringClass.ROUTER,),
}
