"""[cache], and its form in the paper (PBCScanLogic): under which envelopes packets are kept, and how many.

[cache]
history = { Scan2d = 10 }

[[cache.rules]]
message = "Scan2d"
above = "5 um"
envelope = "Scan2d_wide_{channel}"
history = 3
"""

from __future__ import annotations

from collections.abc import Mapping

from afspm import wire
from afspm.errors import AfspmError
from afspm.experiment import class_loader
from afspm.experiment.document import Document
from afspm.experiment.published import length_m, wire_of
from afspm.experiment.sections import parse
from afspm.experiment.toml_lines import Table
from afspm.experiment.wiring_classes import WiringClass
from afspm.logic.envelopes import CacheRule, CacheSettings, Envelopes
from afspm.model import PacketHeader, Role

STATE = wire.MessageKind.STATE
_EXAMPLES = (
    PacketHeader("Scan2d", "Height", (1e-6, 1e-6)),
    PacketHeader("Spec1d", kind="IV"),
    *(PacketHeader(one.name) for one in wire.declared() if one.kind is STATE and one.source is Role.TRANSLATOR),
)
"""Headers with which a mapping is tried."""


def read(table: Table, logic: Table | None, document: Document) -> CacheSettings:
    """Return the section, with what the paper's form says of the cache where the section says nothing.

    Args:
        logic: the table that the scheduler's cache refers to in the paper's form.
    """
    section = parse(CacheSettings, "cache", dict(table), document)
    if section.mapping is not None:
        _check_mapping(section.mapping, document)
    if logic is None or wire_of(logic) is not WiringClass.CACHE_LOGIC:
        return section
    history = {**_published_history(logic), **section.history}
    return CacheSettings(history, (*section.rules, *_published_rules(logic)), section.mapping)


def _check_mapping(name: str, document: Document) -> None:
    try:
        function = class_loader.load(name)
    except class_loader.Unloadable as error:
        document.error(f"[cache] mapping: {error.what}", "cache", "mapping", hint=error.hint)
        return
    if not callable(function):
        document.error(f"[cache] mapping: {name} is not a function", "cache", "mapping")
        return
    for header in _EXAMPLES:  # else its packets would be missing, in the middle of the night
        try:
            Envelopes(mapping=function).of(header)
        except AfspmError as error:
            document.error(f"[cache] mapping: {error.what}", "cache", "mapping", hint=error.hint)
            return


def _published_history(logic: Table) -> dict[str, int]:
    count = logic.get("default_scan_history")
    return {"Scan2d": count} if isinstance(count, int) and count > 0 else {}


def _published_rules(logic: Table) -> list[CacheRule]:
    """Histories by size, [[width, height], count]; a number is in nm, as in the envelopes' names."""
    histories = logic.get("proto_with_history_list")
    if wire_of(histories) is not WiringClass.HISTORIES or not isinstance(histories, Mapping):
        return []
    rules = []
    channels = histories.get("channels_list") or []
    for number, entry in enumerate(histories.get("sizes_with_hist_list", ())):
        match entry:
            case [[width, *_], int(count)] if count > 0:
                channel = channels[number] if number < len(channels) else None
                wide = length_m(width)
                rules.append(CacheRule("Scan2d", channel, None, wide * 0.999, wide * 1.001, None, count))
    return rules
