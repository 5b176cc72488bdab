"""What is published, in the order in which it is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from afspm import wire
from afspm.errors import WireError
from afspm.model import Packet, Scan, ScopeState, ScopeStatus, Spectrum

T = TypeVar("T")

_OF_A_MICROSCOPE: Final = frozenset(
    {"Scan2d", "Spec1d", "ScanParameters2d", "ZCtrlParameters", "ProbePosition", "ScopeStateMsg"}
)
"""The rest is others' doing: who is in control, what the scheduler notes down, lines that only those want who asked."""


@dataclass(frozen=True)
class Heard:
    """One packet.

    Attributes:
        message: its name.
        thing: what is in it; an error that says why it can't be read.
        time_ns: when it was published.
    """

    message: str
    thing: Any
    time_ns: int | None

    @property
    def state(self) -> ScopeState | None:
        """The state, where it tells one."""
        return self.thing.state if isinstance(self.thing, ScopeStatus) else None

    def __str__(self) -> str:
        if self.state is not None:
            return f"SS_{self.state.name}"
        if isinstance(self.thing, Scan):
            return f"Scan2d {self.thing.channel!r}"
        if isinstance(self.thing, WireError):
            return f"{self.message} that can't be read: {self.thing}"
        return self.message


class Story:
    """All that is heard of the microscope, oldest first."""

    def __init__(self) -> None:
        self.all: list[Heard] = []

    def take(self, packet: Packet, ours: bool) -> None:
        """A listener of a `Link`."""
        message = packet.envelope
        try:
            message = wire.message_of(packet.envelope)
            thing = wire.decode(message, bytes(packet.payload))
        except WireError as error:
            thing = error
        if message in _OF_A_MICROSCOPE or isinstance(thing, WireError):
            self.all.append(Heard(message, thing, packet.time_ns))

    def mark(self) -> int:
        """Here: what comes later is news."""
        return len(self.all)

    def since(self, mark: int) -> list[Heard]:
        """What came after `mark`."""
        return self.all[mark:]

    def newest(self, kind: type[T]) -> T | None:
        """The last that was published of a kind."""
        return next((one.thing for one in reversed(self.all) if isinstance(one.thing, kind)), None)

    def has_state(self, state: ScopeState, mark: int) -> bool:
        """Whether it was said after `mark`."""
        return any(one.state is state for one in self.all[mark:])

    def at_s(self, state: ScopeState, mark: int) -> float | None:
        """When it was first said after `mark`, experiment time; None: not yet."""
        times = (one.time_ns for one in self.all[mark:] if one.state is state and one.time_ns is not None)
        return next((time_ns / 1e9 for time_ns in times), None)


def told(heard: Iterable[Heard]) -> str:
    """What was heard, for a person."""
    return ", ".join(map(str, heard)) or "nothing"


def scans(heard: Iterable[Heard]) -> list[Scan]:
    """The scans among it."""
    return [one.thing for one in heard if isinstance(one.thing, Scan)]


def spectra(heard: Iterable[Heard]) -> list[Spectrum]:
    """The spectra among it."""
    return [one.thing for one in heard if isinstance(one.thing, Spectrum)]
