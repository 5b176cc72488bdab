"""The place where a scheduler may speak of other coordinates than the microscope: what it must be told, and is asked.

A plain scheduler has no frame, and does nothing for it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol

from afspm.model import Packet, PacketHeader, Parameter, ProbePosition, Region, Request, Response


@dataclass(frozen=True)
class MappedRequest:
    """A request in the coordinates of the microscope.

    Attributes:
        request: what is sent in its place, with the same id.
        names: the parameters that the asker meant to set; the others change with them, by the mapping alone.
        said: the place, in both coordinates, for the reason of a refusal.
    """

    request: Request
    names: Collection[str]
    said: str


class CoordinateFrame(Protocol):
    """Maps between the coordinates that components speak of and those of the microscope."""

    def maps(self, now_ns: int) -> bool:
        """Return whether components are given other coordinates than those of the microscope."""
        ...

    def in_force(self, place: Region | ProbePosition, now_ns: int) -> None:
        """Take a place that was read from the microscope; the next part of a place is put onto it."""
        ...

    def outgoing(self, who: str, request: Request, now_ns: int) -> MappedRequest | Response | None:
        """A request as the microscope must be asked. The same id always gives the same bytes.

        Returns:
            None if it goes as it is; a response if it can't be mapped.
        """
        ...

    def move_before(self, action: str, now_ns: int) -> MappedRequest | None:
        """Return the request that must come right before an action, so that it happens where it was meant to.

        Returns:
            None if nothing has to come before it.
        """
        ...

    def carried_out(self, sent: Request, told: Parameter | None, now_ns: int) -> None:
        """The microscope did what it was sent, and told the value of a parameter."""
        ...

    def answer(self, asked: Request, told: Parameter | None, now_ns: int) -> Parameter | None:
        """The value of a parameter as the asker is to be told it; None: as the microscope told it."""
        ...

    def incoming(self, packet: Packet, header: PacketHeader, now_ns: int) -> Packet:
        """A packet of the microscope's as it is to be published, its time and envelope unchanged."""
        ...

    def snapshot(self) -> dict[str, object]:
        """Return the part that must survive a kill, as plain JSON."""
        ...

    def restore(self, state: dict[str, object]) -> None:
        """Take up what `snapshot` wrote."""
        ...
