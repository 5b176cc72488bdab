"""The map between the coordinates of components and the coordinates of the microscope's tip.

A coordinate frame is one more part of the scheduler's state: frozen, and replaced by its own methods. The scheduler
knows this protocol, and no frame by name; by default it has `TipFrame`, which changes nothing.

| step of the scheduler | methods of the frame |
| --- | --- |
| takes any input | `step`: keep it, pass it on, add others, hand a job to the frame's worker |
| sends a request | `outgoing`, and `move_before` an action |
| has an answer | `carried_out`, `answer` |
| publishes a packet | `incoming` |
| saves, and restarts | `saved`; `restored`, then `recalled` |

Invariants: the same request id always gives the same bytes; a packet published twice has the same place twice;
each kept input comes back (`Reconsider`) after a bounded time, since all later inputs wait for it.

A frame is a part of the state, and no subclass of the core: with a subclass that changed its inputs in place, a step
was no function of state and input, and the saved state had a text that only the subclass could read.
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
        request: the request sent in place of the original, with the same id.
        names: the parameters that the client sets; the others change by the mapping alone.
        places_text: the place in both coordinate systems, for the text of a refusal.
    """

    request: Request
    names: Collection[str]
    places_text: str


# --- outputs of a frame's step, beside inputs that are passed on ------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Reconsider:
    """The output that returns a kept input to the scheduler; the frame processes the input first."""

    event: Input


@dataclass(frozen=True, slots=True)
class AskMicroscope:
    """The output that sends a request in the scheduler's own name; the answer is the input `FrameAnswered`.

    A request beyond a limit is not sent, and answered with the reason.
    """

    request: Request
    purpose: object


@dataclass(frozen=True, slots=True)
class SaveNow:
    """The output that saves the state before the effects of this step are carried out."""


@dataclass(frozen=True, slots=True)
class HoldControl:
    """The output that extends the wait before the first control state to `until_s` (real): packets are missing.

    The wait still ends at once with the input `TranslatorCaughtUp`, unless the frame keeps this input.
    """

    until_s: float


FrameOutput = Input | Reconsider | AskMicroscope | SaveNow | HoldControl | Delegate | Log
"""Outputs of `CoordinateFrame.step`; an `Input` goes to the scheduler without passing the frame again."""


class CoordinateFrame(Protocol):
    """An immutable map between the coordinates of components and the coordinates of the microscope.

    Attributes:
        is_moving: whether the microscope may have to be moved before an action. The scheduler then remembers a sent
            action, so that the action is repeated after a restart without another move.
        reports: classes of the worker's reports: dataclasses for `model.snapshot`. `[record] requests = true` keeps
            the reports, and a replay gets them again.
    """

    is_moving: ClassVar[bool]
    reports: ClassVar[tuple[type, ...]]

    def step(
        self, event: Input, control: ArbitrationState, now_s: float, now_ns: int
    ) -> tuple[CoordinateFrame, Sequence[FrameOutput]]:
        """Process an input before the scheduler does.

        Args:
            control: the state of control when the frame gets the input.

        Returns:
            The frame after the input, and its outputs in order, including the input if it is passed on.
        """
        ...

    def deadline_s(self) -> float | None:
        """Return when, in real monotonic time, `step` needs a Tick at the latest; None: no deadline."""
        ...

    def maps(self, now_ns: int) -> bool:
        """Return whether components have other coordinates than the microscope."""
        ...

    def in_force(self, place: Region | ProbePosition, now_ns: int) -> CoordinateFrame:
        """Store a place read from the microscope; a later change of one coordinate is applied to this place."""
        ...

    def outgoing(
        self, who: str, request: Request, now_ns: int
    ) -> tuple[CoordinateFrame, MappedRequest | Response | None]:
        """Map a request to the coordinates of the microscope.

        Returns:
            The frame, and: the mapped request; None to send the request unchanged; or a refusal if it can't be mapped.
        """
        ...

    def move_before(self, action: str, now_ns: int) -> tuple[CoordinateFrame, MappedRequest | None]:
        """Return the move to the action's place that must precede the action; None: no move."""
        ...

    def carried_out(self, sent: Request, reported: Parameter | None, now_ns: int) -> CoordinateFrame:
        """Update the frame after a successful request, with the parameter value in the microscope's answer."""
        ...

    def answer(self, asked: Request, reported: Parameter | None, now_ns: int) -> Parameter | None:
        """Return the parameter value for the client; None: the value in the microscope's answer."""
        ...

    def incoming(self, packet: Packet, header: PacketHeader, now_ns: int) -> tuple[CoordinateFrame, Packet]:
        """Map a packet of the microscope, its time and envelope unchanged."""
        ...

    def saved(self) -> object:
        """Return the part of the frame that must survive a kill: a dataclass for `model.snapshot`, or None."""
        ...

    def restored(self, plain: object) -> CoordinateFrame:
        """Return the frame after a restart.

        Args:
            plain: `saved()` as a snapshot returns it: plain data.

        Raises:
            TypeError, ValueError, KeyError: `plain` belongs to another frame, or is damaged.
        """
        ...

    def recalled(self, packets: Iterable[LoggedPacket]) -> CoordinateFrame:
        """Store the packets that were published before a restart, oldest first."""
        ...


class TipFrame:
    """The coordinates of the microscope itself: every input passes, and nothing is mapped."""

    is_moving: ClassVar[bool] = False
    reports: ClassVar[tuple[type, ...]] = ()

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

    def carried_out(self, sent: Request, reported: Parameter | None, now_ns: int) -> CoordinateFrame:
        return self

    def answer(self, asked: Request, reported: Parameter | None, now_ns: int) -> Parameter | None:
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
