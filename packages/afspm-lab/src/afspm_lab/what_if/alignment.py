"""Comparison of recorded and replayed outputs. Pure.

Outputs are aligned by message, key, life and the packet that they answer, the n-th with the n-th; the remaining outputs
by message and key only. An added or missing output therefore shifts no later output.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple


class PacketName(NamedTuple):
    """Time and envelope of a published packet, which identify it."""

    time_ns: int
    envelope: str


@dataclass(frozen=True, slots=True)
class Output:
    """An output of a process: a request or a published message.

    Attributes:
        message: name of the request or message.
        key: subject of the message, such as a parameter, an action or a problem.
        value: content, which is compared.
        text: description, for people.
        packet: the packet being handled, or else the newest packet; None if no packet has arrived.
        time_ns: experiment time: of the packet being handled, or else of the wake-up before the output.
        life: number of the process's life (from a start to its end), from 1.
        reaches: whether the output changes the microscope, or its control.
    """

    message: str
    key: str
    value: str | bytes
    text: str
    packet: PacketName | None
    time_ns: int
    life: int
    reaches: bool = False

    @property
    def name(self) -> tuple[str, str]:
        return (self.message, self.key)

    @property
    def is_as(self) -> tuple[object, ...]:
        """All fields that are compared; the time is left out."""
        return (self.message, self.key, self.value, self.packet, self.life)


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference between the recorded and the replayed outputs.

    Attributes:
        component: name of the sender.
        recorded, now: the output on each side; None if missing.
        counterfactual: whether an earlier difference reaches the microscope.
    """

    component: str
    recorded: Output | None
    now: Output | None
    counterfactual: bool = False

    @property
    def at_ns(self) -> int:
        """The earlier time of the two sides."""
        return min(one.time_ns for one in self._sides)

    @property
    def packet(self) -> PacketName | None:
        """The earlier of the packets that the two outputs belong to."""
        return min((one.packet for one in self._sides if one.packet), default=None)

    @property
    def reaches(self) -> bool:
        return any(one.reaches for one in self._sides)

    @property
    def kind(self) -> str:
        """ "added", "removed" or "changed"."""
        return "changed" if self.recorded and self.now else "removed" if self.recorded else "added"

    @property
    def _sides(self) -> list[Output]:
        return [one for one in (self.recorded, self.now) if one is not None]


def first_difference(component: str, recorded: Sequence[Output], now: Sequence[Output]) -> Difference | None:
    """Return the first difference between two sequences of outputs; None if they are equal."""
    for before, after in zip(recorded, now, strict=False):
        if before.is_as != after.is_as:
            # one side may just lack an output: then the other is about a later packet
            if before.name == after.name and before.packet == after.packet:
                return Difference(component, before, after)
            if _order(before) <= _order(after):
                return Difference(component, before, None)
            return Difference(component, None, after)
    if len(recorded) > len(now):
        return Difference(component, recorded[len(now)], None)
    return Difference(component, None, now[len(recorded)]) if len(now) > len(recorded) else None


def aligned(component: str, recorded: Sequence[Output], now: Sequence[Output]) -> tuple[int, list[Difference]]:
    """Return the number of equal outputs, and all differences in order of time."""
    here, there = _by_place(recorded), _by_place(now)
    same, differences = 0, list[Difference]()
    left: dict[tuple[str, str], tuple[list[Output], list[Output]]] = {}
    for place in {**here, **there}:
        before, after = here.get(place, []), there.get(place, [])
        pairs = min(len(before), len(after))
        for one, other in zip(before[:pairs], after[:pairs], strict=True):
            if one.value == other.value:
                same += 1
            else:
                differences.append(Difference(component, one, other))
        alone = left.setdefault(place[0], ([], []))
        alone[0].extend(before[pairs:])
        alone[1].extend(after[pairs:])
    # an output that comes at another packet is one difference, not two
    for before, after in left.values():
        differences += [Difference(component, *sides) for sides in zip_longest(before, after)]
    return same, sorted(differences, key=lambda one: one.at_ns)


def _by_place(outputs: Iterable[Output]) -> dict[tuple[tuple[str, str], int, PacketName | None], list[Output]]:
    found: dict[tuple[tuple[str, str], int, PacketName | None], list[Output]] = {}
    for one in outputs:
        found.setdefault((one.name, one.life, one.packet), []).append(one)
    return found


def _order(one: Output) -> tuple[int, int]:
    return (one.life, one.packet.time_ns if one.packet else 0)
