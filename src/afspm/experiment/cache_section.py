"""[cache]: under which envelopes packets are kept, and how many.

[cache]
history = { Scan2d = 10 }

[[cache.rules]]
message = "Scan2d"
above = "5 um"
envelope = "Scan2d_wide_{channel}"
history = 3
"""

from __future__ import annotations

from afspm import wire
from afspm.basics.errors import AfspmError
from afspm.experiment import class_loader
from afspm.experiment.document import Document
from afspm.experiment.sections import parse
from afspm.experiment.toml_lines import Table
from afspm.model import PacketHeader, Role
from afspm.scheduler.publishing.envelopes import CacheSettings, Envelopes

STATE = wire.MessageKind.STATE
_EXAMPLES = (
    PacketHeader("Scan2d", "Height", (1e-6, 1e-6)),
    PacketHeader("Spec1d", kind="IV"),
    *(PacketHeader(one.name) for one in wire.declared() if one.kind is STATE and one.source is Role.TRANSLATOR),
)
"""Headers with which a mapping is tried."""


def read(table: Table, document: Document) -> CacheSettings:
    """Return the section."""
    section = parse(CacheSettings, "cache", dict(table), document)
    if section.mapping is not None:
        _check_mapping(section.mapping, document)
    return section


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
