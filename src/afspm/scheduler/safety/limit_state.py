"""The values in force and the latest uses: steps, rates and intervals are measured from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace, without
from afspm.model import Parameter
from afspm.model.positions import KnownPosition
from afspm.scheduler.safety.movers import MoverState


@dataclass(frozen=True)
class KnownValue:
    """A value in force.

    Attributes:
        since_ns: the experiment time at which the value was last set, or first known.
        origin: the value at that time. A value only read since then may differ: controllers round, and a person may
            turn a knob.
    """

    value: float
    since_ns: int
    origin: float


@dataclass(frozen=True)
class LastUse:
    """A use of a parameter or action by one request; `request_id` is empty for a request without an id."""

    at_ns: int
    who: str
    request_id: str

    def is_of(self, repeated: tuple[str, str] | None) -> bool:
        """Return whether a repeated request (client, id) made this use."""
        return repeated is not None and bool(self.request_id) and (self.who, self.request_id) == repeated


@dataclass(frozen=True)
class Usage:
    """Values and latest uses of parameters and actions, by name. Kept over a restart, so that no interval is shortened.

    Attributes:
        done: the last successful uses.
        sent: uses in progress or of unknown outcome, which count, too.
        before: the values that a rate is measured from, set aside during a request that has not settled.
    """

    known: Mapping[str, KnownValue] = field(default_factory=dict)
    before: Mapping[str, KnownValue] = field(default_factory=dict)
    done: Mapping[str, LastUse] = field(default_factory=dict)
    sent: Mapping[str, LastUse] = field(default_factory=dict)

    def learn(self, name: str, value: float, now_ns: int, *, was_read: bool = False) -> Usage:
        """Store a value in force; an equal value keeps its earlier time.

        Args:
            was_read: whether the value was read, and may have been in force for long. Then the time and the origin of
                a known value are kept.
        """
        known = self.known.get(name)
        if known is not None and known.value == value:
            return self
        new = replace(known, value=value) if known is not None and was_read else KnownValue(value, now_ns, value)
        return replace(self, known={**self.known, name: new}, before=without(self.before, name))

    def forget(self, name: str) -> Usage:
        """Remove a value that is no longer known."""
        if name not in self.known and name not in self.before:
            return self
        return replace(self, known=without(self.known, name), before=without(self.before, name))

    def changing(self, name: str) -> Usage:
        """Set a value aside until the outcome and the time of its change are known."""
        if name not in self.known:
            return self
        return replace(self, known=without(self.known, name), before={**self.before, name: self.known[name]})

    def unchanged(self, name: str) -> Usage:
        """Restore a value that was set aside: it was not changed."""
        if name not in self.before:
            return self
        return replace(self, known={**self.known, name: self.before[name]}, before=without(self.before, name))

    def last_ns(self, name: str, repeated: tuple[str, str] | None = None) -> int | None:
        """Return the experiment time of the last use; None without a use.

        Args:
            repeated: client and id of a repeated request, whose own use does not count.
        """
        uses = (uses.get(name) for uses in (self.done, self.sent))
        return max((use.at_ns for use in uses if use is not None and not use.is_of(repeated)), default=None)

    def use_sent(self, name: str, use: LastUse) -> Usage:
        return replace(self, sent={**self.sent, name: use})

    def use_done(self, name: str, use: LastUse) -> Usage:
        return replace(self, done={**self.done, name: use}, sent=without(self.sent, name))

    def use_undone(self, name: str, who: str, request_id: str) -> Usage:
        """Remove a use that was not carried out."""
        use = self.sent.get(name)
        is_it = use is not None and (use.who, use.request_id) == (who, request_id)
        return replace(self, sent=without(self.sent, name)) if is_it else self


@dataclass(frozen=True)
class LimitState:
    """The state that requests are checked against, beside the limits themselves.

    Attributes:
        last_seen: the last known values of quantities in forbidden states. Requests are not checked against them, since
            they may be old: they tell that a person has set a forbidden state.
    """

    usage: Usage = field(default_factory=Usage)
    position: KnownPosition = field(default_factory=KnownPosition)
    last_seen: Mapping[str, Parameter] = field(default_factory=dict)
    movers: MoverState = field(default_factory=MoverState)
