"""What intervals, steps and rates are measured from: when something was used last, and the values in force."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import Any


@dataclass(frozen=True, slots=True)
class KnownValue:
    """A value in force.

    Attributes:
        since_ns: when it was set last, in experiment time, or first heard of.
        origin: the value then. What was only read since may differ: controllers round, and people are at the panel.
    """

    value: float
    since_ns: int
    origin: float


@dataclass(frozen=True, slots=True)
class LastUse:
    """When something was used, by whom, and the id of the request; empty: it had none."""

    at_ns: int
    who: str
    request_id: str

    def is_of(self, who: str, request_id: str) -> bool:
        """Whether it is that very request, which may be asked again."""
        return bool(request_id) and (self.who, self.request_id) == (who, request_id)


class LimitState:
    """Kept over a restart: a scheduler that was killed must not allow sooner what was to be waited with."""

    def __init__(self) -> None:
        self._known: dict[str, KnownValue] = {}
        self._done: dict[str, LastUse] = {}
        self._sent: dict[str, LastUse] = {}  # what became of these is not known (yet), so they count

    def known(self, name: str) -> KnownValue | None:
        """The value in force, as far as it was learned."""
        return self._known.get(name)

    def learn(self, name: str, value: float, now_ns: int, *, was_read: bool = False) -> bool:
        """A value is in force. Returns whether that is new.

        Args:
            was_read: it was asked for, and may have been so for long.
        """
        known = self._known.get(name)
        if known is not None and known.value == value:
            return False
        if known is not None and was_read:
            self._known[name] = replace(known, value=value)
        else:
            self._known[name] = KnownValue(value, now_ns, value)
        return True

    def forget(self, name: str) -> None:
        """The value in force is not known any more."""
        self._known.pop(name, None)

    def last_ns(self, name: str, who: str, request_id: str) -> int | None:
        """When it was used last, by another request than this one."""
        uses = (uses.get(name) for uses in (self._done, self._sent))
        return max((use.at_ns for use in uses if use is not None and not use.is_of(who, request_id)), default=None)

    def sending(self, name: str, use: LastUse) -> None:
        """It is sent to the microscope."""
        self._sent[name] = use

    def done(self, name: str, use: LastUse) -> None:
        """It was carried out."""
        self._done[name] = use
        self._sent.pop(name, None)

    def not_done(self, name: str, who: str, request_id: str) -> None:
        """It was sent, or was to be, and was not carried out."""
        use = self._sent.get(name)
        if use is not None and (use.who, use.request_id) == (who, request_id):
            del self._sent[name]

    def snapshot(self) -> dict[str, Any]:
        """As plain JSON."""
        return {
            "known": {name: astuple(one) for name, one in self._known.items()},
            "done": {name: astuple(one) for name, one in self._done.items()},
            "sent": {name: astuple(one) for name, one in self._sent.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self._known = {
            name: KnownValue(float(value), int(ns), float(origin))
            for name, (value, ns, origin) in state["known"].items()
        }
        for kept, table in ((self._done, state["done"]), (self._sent, state["sent"])):
            kept.update((name, LastUse(int(ns), str(who), str(id_))) for name, (ns, who, id_) in table.items())
