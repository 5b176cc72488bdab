"""Names that the experiment file may use for what is in afspm already: the paper's form, and short ones of ours."""

from __future__ import annotations

from enum import Enum
from typing import Final


class Wire(Enum):
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

WIRE_CLASSES: Final[dict[str, Wire]] = {
    "Publisher": Wire.PUBLISHER,
    "PubSubCache": Wire.CACHE,
    "Subscriber": Wire.SUBSCRIBER,
    "ComboSubscriber": Wire.COMBINED,
    "ControlServer": Wire.SERVER,
    "ControlRouter": Wire.ROUTER,
    "ControlClient": Wire.CLIENT,
    "AdminControlClient": Wire.CLIENT,
    "PBCScanLogic": Wire.CACHE_LOGIC,
    "ProtoBasedCacheLogic": Wire.CACHE_LOGIC,
    "CacheLogic": Wire.CACHE_LOGIC,
    "create_roi_scan_envelope": Wire.ENVELOPE,
    "create_spec_envelope": Wire.SPECTRA,
    "create_roi_proto_hist_list": Wire.HISTORIES,
}
SHORT_WIRE_CLASSES: Final[dict[str, Wire]] = {
    "Publisher": Wire.PUBLISHER,
    "Subscriber": Wire.SUBSCRIBER,
    "Cache": Wire.CACHE,
    "Server": Wire.SERVER,
    "Router": Wire.ROUTER,
    "Client": Wire.CLIENT,
}

# What each kind understands. Settings of the published classes that only say how Python is to decode or to name
# packets are accepted and have no meaning here: decoding is the wire's, naming is the [cache] section's.
WIRE_SETTINGS: Final[dict[Wire, frozenset[str]]] = {
    Wire.PUBLISHER: frozenset({"url", "get_envelope_for_proto"}),
    Wire.SUBSCRIBER: frozenset(
        {
            "sub_url",
            "topics_to_sub",
            "sub_extract_proto",
            "update_cache",
            "extract_proto_kwargs",
            "update_cache_kwargs",
        }
    ),
    Wire.COMBINED: frozenset({"subs"}),
    Wire.CACHE: frozenset(
        {
            "url",
            "sub_url",
            "sub_extract_proto",
            "pub_get_envelope_for_proto",
            "update_cache",
            "extract_proto_kwargs",
            "update_cache_kwargs",
            "topics_to_sub",
        }
    ),
    Wire.SERVER: frozenset({"url"}),
    Wire.ROUTER: frozenset({"server_url", "router_url", "request_timeout_ms", "request_retries"}),
    Wire.CLIENT: frozenset({"url", "request_timeout_ms", "request_retries", "uuid"}),
    Wire.CACHE_LOGIC: frozenset({"default_scan_history", "proto_with_history_list"}),
    Wire.ENVELOPE: frozenset({"size", "channel"}),
    Wire.SPECTRA: frozenset({"type"}),
    Wire.HISTORIES: frozenset({"sizes_with_hist_list", "channels_list"}),
}

# The keys by which a component names its intermediaries, and the kinds that fit.
WIRE_KEYS: Final[dict[str, tuple[Wire, ...]]] = {
    "subscriber": (Wire.SUBSCRIBER, Wire.COMBINED),
    "control_client": (Wire.CLIENT,),
    "publisher": (Wire.PUBLISHER,),
    "control_server": (Wire.SERVER,),
    "pubsubcache": (Wire.CACHE,),
    "router": (Wire.ROUTER,),
}

DASHBOARD: Final = "dashboard"
"""The name under which `afspm dashboard` joins a run."""
DASHBOARD_PASSWORD: Final = "AFSPM_DASHBOARD_PASSWORD"
"""The environment variable that only dashboards get."""

# Where a class named without a module is looked for, in this order.
SHORT_NAME_PACKAGES: Final[tuple[str, ...]] = (
    "afspm.components",
    "afspm.scheduler",
    "afspm.microscopes.simulator",
    "afspm.microscopes.image",
    "afspm.microscopes.nanonis",
    "afspm.microscopes.asylum",
    "afspm.microscopes.gxsm",
    "afspm.emulators.nanonis",
    "afspm.emulators.asylum",
    "afspm.emulators.gxsm",
    "afspm.dashboard",
)
