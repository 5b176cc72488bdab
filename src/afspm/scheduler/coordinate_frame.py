"""The coordinates in which components think, where they differ from those of the microscope's tip.

A coordinate frame is one more part of the scheduler's state: frozen, and replaced by its own methods. The scheduler
knows this protocol, and no frame by name; without another it has `TipFrame`, which changes nothing.

| the scheduler | asks the frame |
| --- | --- |
| takes any input | `step`: keep it, pass it on, add others, hand a job to the frame's worker |
| sends a request | `outgoing`, and `move_before` an action |
| has an answer | `carried_out`, `answer` |
| publishes a packet | `incoming` |
| saves, and restarts | `saved`; `restored`, then `recalled` |

What must hold: the same request id always gives the same bytes, a packet published twice has the same place twice, and
each input that is kept comes back (`Reconsider`) after a bounded time, since everything behind it waits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from afspm.model import LoggedPacket, Packet, PacketHeader, Parameter, ProbePosition, Region, Request, Response
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.events import Delegate, Input, Log


@dataclass(frozen=True)
class MappedRequest:
    """A request in the coordinates of the microscope.

    Attributes:
        request: is sent in place of the original, with the same id.
        names: the parameters that the client means to set; the others change with them, by the mapping alone.
        said: the place, in both coordinates, for the reason of a refusal.
    """

    request: Request
    names: Collection[str]
    said: str


# --- outputs of a frame's step, beside inputs that are passed on ------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Reconsider:
    """Take an input that was kept, as if it came now: through the frame first."""

    event: Input


@dataclass(frozen=True, slots=True)
class AskMicroscope:
    """Send a request in the scheduler's own name; the answer comes as `FrameAnswered` with the same purpose."""

    request: Request
    purpose: object


@dataclass(frozen=True, slots=True)
class SaveNow:
    """Save the state before the effects of this step are carried out."""


@dataclass(frozen=True, slots=True)
class HoldControl:
    """Publish the control state after a restart no earlier than `until_s` (real): old packets are still to come."""

    until_s: float


FrameOutput = Input | Reconsider | AskMicroscope | SaveNow | HoldControl | Delegate | Log
"""An input among them is taken by the scheduler without the frame."""


class CoordinateFrame(Protocol):
    """Maps between the coordinates of components and those of the microscope. Immutable.

    Attributes:
        is_moving: whether the microscope may have to be moved before an action. The action is then remembered as sent,
            so that it is repeated after a restart without another move.
    """

    is_moving: ClassVar[bool]

    def step(
        self, event: Input, control: ArbitrationState, now_s: float, now_ns: int
    ) -> tuple[CoordinateFrame, Sequence[FrameOutput]]:
        """Look at an input before the scheduler does.

        Args:
            control: as it is before the input.

        Returns:
            The frame after the input, and everything to be done in order; an input that passes is among it.
        """
        ...

    def deadline_s(self) -> float | None:
        """Return when, in real monotonic time, `step` needs a Tick at the latest; None: no deadline."""
        ...

    def maps(self, now_ns: int) -> bool:
        """Return whether components are given other coordinates than those of the microscope."""
        ...

    def in_force(self, place: Region | ProbePosition, now_ns: int) -> CoordinateFrame:
        """Take a place that was read from the microscope; the next part of a place is put onto it."""
        ...

    def outgoing(
        self, who: str, request: Request, now_ns: int
    ) -> tuple[CoordinateFrame, MappedRequest | Response | None]:
        """Map a request.

        Returns:
            Also None if it is sent unchanged; a response if it can't be mapped.
        """
        ...

    def move_before(self, action: str, now_ns: int) -> tuple[CoordinateFrame, MappedRequest | None]:
        """Return the request that must come right before an action, so that the action happens at its place.

        Returns:
            Also None if no move has to come before it.
        """
        ...

    def carried_out(self, sent: Request, told: Parameter | None, now_ns: int) -> CoordinateFrame:
        """Take a success of the microscope, and the value of a parameter in its answer."""
        ...

    def answer(self, asked: Request, told: Parameter | None, now_ns: int) -> Parameter | None:
        """Return the value of a parameter for its client; None: the value of the microscope's answer."""
        ...

    def incoming(self, packet: Packet, header: PacketHeader, now_ns: int) -> tuple[CoordinateFrame, Packet]:
        """Map a packet of the microscope, its time and envelope unchanged."""
        ...

    def saved(self) -> object:
        """Return the part that must survive a kill: a dataclass for `model.snapshot`, or None."""
        ...

    def restored(self, plain: object) -> CoordinateFrame:
        """Return the frame after a restart.

        Args:
            plain: `saved()` as it comes out of a snapshot: plain data.

        Raises:
            TypeError, ValueError, KeyError: it is of another frame, or damaged.
        """
        ...

    def recalled(self, packets: Iterable[LoggedPacket]) -> CoordinateFrame:
        """Take the packets that were published before a restart, oldest first."""
        ...


class TipFrame:
    """The coordinates of the microscope itself: all inputs pass, and nothing is mapped."""

    is_moving: ClassVar[bool] = False

    def step(
        self, event: Input, control: ArbitrationState, now_s: float, now_ns: int
    ) -> tuple[CoordinateFrame, Sequence[FrameOutput]]:
        return self, (event,)

    def deadline_s(self) -> float | None:
        return None

    def maps(self, now_ns: int) -> bool:
        return False

    def in_force(self, place: Region | ProbePosition, now_ns: int) -> CoordinateFrame:
        return self

    def outgoing(
        self, who: str, request: Request, now_ns: int
    ) -> tuple[CoordinateFrame, MappedRequest | Response | None]:
        return self, None

    def move_before(self, action: str, now_ns: int) -> tuple[CoordinateFrame, MappedRequest | None]:
        return self, None

    def carried_out(self, sent: Request, told: Parameter | None, now_ns: int) -> CoordinateFrame:
        return self

    def answer(self, asked: Request, told: Parameter | None, now_ns: int) -> Parameter | None:
        return None

    def incoming(self, packet: Packet, header: PacketHeader, now_ns: int) -> tuple[CoordinateFrame, Packet]:
        return self, packet

    def saved(self) -> object:
        return None

    def restored(self, plain: object) -> CoordinateFrame:
        return self

    def recalled(self, packets: Iterable[LoggedPacket]) -> CoordinateFrame:
        return self


TIP_FRAME = TipFrame()
