"""The values in force and the latest uses, from which steps, rates and intervals are measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from afspm.logic.frozen import replace
from afspm.logic.positions import KnownPosition

T = TypeVar("T")


@dataclass(frozen=True)
class KnownValue:
    """A value in force.

    Attributes:
        since_ns: when it was set last, in experiment time, or first heard of.
        origin: the value then. What was only read since may differ: controllers round, and people are at the panel.
    """

    value: float
    since_ns: int
    origin: float


@dataclass(frozen=True)
class LastUse:
    """A use of a parameter or action, and the id of the request; empty: it had none."""

    at_ns: int
    who: str
    request_id: str

    def is_of(self, who: str, request_id: str) -> bool:
        """Return whether it is that very request, which may be asked again."""
        return bool(request_id) and (self.who, self.request_id) == (who, request_id)


@dataclass(frozen=True)
class Usage:
    """Values and uses, by name. Kept over a restart: a scheduler that was killed must not allow anything sooner.

    Attributes:
        sent: uses of unknown outcome, which count.
    """

    known: Mapping[str, KnownValue] = field(default_factory=dict)
    done: Mapping[str, LastUse] = field(default_factory=dict)
    sent: Mapping[str, LastUse] = field(default_factory=dict)

    def learn(self, name: str, value: float, now_ns: int, *, was_read: bool = False) -> Usage:
        """Take a value in force.

        Args:
            was_read: it was asked for, and may have been in force for long.
        """
        known = self.known.get(name)
        if known is not None and known.value == value:
            return self
        new = replace(known, value=value) if known is not None and was_read else KnownValue(value, now_ns, value)
        return replace(self, known={**self.known, name: new})

    def forget(self, name: str) -> Usage:
        """Drop a value that is not known any more."""
        return replace(self, known=_without(self.known, name)) if name in self.known else self

    def last_ns(self, name: str, who: str, request_id: str) -> int | None:
        """Return when it was used last, by another request than this one."""
        uses = (uses.get(name) for uses in (self.done, self.sent))
        return max((use.at_ns for use in uses if use is not None and not use.is_of(who, request_id)), default=None)

    def use_sent(self, name: str, use: LastUse) -> Usage:
        return replace(self, sent={**self.sent, name: use})

    def use_done(self, name: str, use: LastUse) -> Usage:
        return replace(self, done={**self.done, name: use}, sent=_without(self.sent, name))

    def use_undone(self, name: str, who: str, request_id: str) -> Usage:
        """Take back a use that was sent, or was to be, and was not carried out."""
        use = self.sent.get(name)
        is_it = use is not None and (use.who, use.request_id) == (who, request_id)
        return replace(self, sent=_without(self.sent, name)) if is_it else self


@dataclass(frozen=True)
class LimitState:
    """All that requests are checked against beside the limits themselves."""

    usage: Usage = field(default_factory=Usage)
    position: KnownPosition = field(default_factory=KnownPosition)


def _without(uses: Mapping[str, T], name: str) -> dict[str, T]:
    return {other: use for other, use in uses.items() if other != name}
