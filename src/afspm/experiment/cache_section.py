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

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from afspm.errors import AfspmError
from afspm.experiment import class_loader
from afspm.experiment.document import Document
from afspm.experiment.sections import Section, parse
from afspm.experiment.toml_lines import Settings, Table
from afspm.logic.envelopes import CacheRule, Envelopes
from afspm.model import PacketHeader
from afspm.units import Length

Count = Annotated[int, Field(ge=1)]

_EXAMPLES = (
    PacketHeader("Scan2d", "Height", (1e-6, 1e-6)),
    PacketHeader("Spec1d", kind="IV"),
    *map(PacketHeader, ("ScopeStateMsg", "ScanParameters2d", "ZCtrlParameters", "ProbePosition")),
)


class CacheRuleSection(Section):
    """[[cache.rules]]: the first that fits a packet says under which envelope it is kept, and how many are."""

    message: str | None = None
    channel: str | None = None
    kind: str | None = None
    above: Length | None = None
    up_to: Length | None = None
    envelope: str | None = None
    history: Count | None = None


class CacheSection(Section):
    """[cache]. `mapping` names a function of the user's, from a packet's header to its envelope."""

    history: dict[str, Count] = Field(default_factory=dict)
    mapping: str | None = None
    rules: tuple[CacheRuleSection, ...] = ()


@dataclass(frozen=True)
class CacheSettings:
    """The settings of the scheduler's cache."""

    rules: tuple[CacheRule, ...] = ()
    mapping: str | None = None
    history: Mapping[str, int] = field(default_factory=dict)

    @property
    def envelopes(self) -> tuple[str, ...]:
        """The beginnings of the rules' envelopes, as far as they are fixed."""
        return tuple(re.split(r"[{}]", rule.envelope)[0] for rule in self.rules if rule.envelope)

    def to_settings(self) -> Settings:
        """Return it in JSON's types; `CacheRule` by its fields."""
        rules = [{k: v for k, v in vars(rule).items() if v is not None} for rule in self.rules]
        return {"rules": rules, "mapping": self.mapping, "history": dict(self.history)}


def read(table: Table, document: Document) -> CacheSettings:
    """Return the section."""
    section = parse(CacheSection, "cache", dict(table), document)
    rules = []
    for i, rule in enumerate(section.rules):
        try:
            rules.append(
                CacheRule(rule.message, rule.channel, rule.kind, rule.above, rule.up_to, rule.envelope, rule.history)
            )
        except AfspmError as error:
            document.error(f"[cache] rules[{i}]: {error.what}", "cache", "rules", i, hint=error.hint)
    if section.mapping is not None:
        _check_mapping(section.mapping, document)
    return CacheSettings(tuple(rules), section.mapping, dict(section.history))


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
