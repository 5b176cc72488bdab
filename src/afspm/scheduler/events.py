"""The inputs and effects of `SchedulerCore`.

Two times come with each input: `now_s`, real and monotonic, for timeouts; `now_ns`, experiment time, for everything
that has a meaning in the experiment.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Protocol

from afspm.model import Packet, PacketHeader, Parameter, Request, Response
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.saved_state import SavedState

# --- inputs ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Connected:
    """The event that a peer connected to the control socket. `connection` numbers grow and are never reused."""

    connection: int


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The event that a connection to the control socket is lost."""

    connection: int


@dataclass(frozen=True, slots=True)
class Greeted:
    """The event that a peer sent only its name (the empty first message of ZMQ_PROBE_ROUTER)."""

    connection: int
    name: str
    user: str | None = None


@dataclass(frozen=True, slots=True)
class RequestIn:
    """A request from the peer `name`, received over `connection`.

    Attributes:
        user: the owner of the peer's key; None where connections are not authenticated.
        heard_s: real time of the first arrival; negative: the time of the step that processes the request.
    """

    connection: int
    name: str
    request: Request
    user: str | None = None
    heard_s: float = -1.0


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A message from the peer `name` that could not be decoded as a request, and was refused with `response`."""

    name: str
    response: Response


@dataclass(frozen=True, slots=True)
class PacketIn:
    """The event that the translator published a packet."""

    packet: Packet
    header: PacketHeader


@dataclass(frozen=True, slots=True)
class ReplayRequested:
    """A subscriber's request for the cached packets that are newer than `since_ns`.

    Attributes:
        prefixes: beginnings of the wanted envelopes.
        subscriber: the caller's own handle; returned in `Replay`.
    """

    subscriber: Hashable
    prefixes: tuple[str, ...]
    since_ns: int = -1


@dataclass(frozen=True, slots=True)
class TranslatorUp:
    """The event that the translator is connected: requests can be sent."""


@dataclass(frozen=True, slots=True)
class TranslatorDown:
    """The event that the connection to the translator is lost."""


@dataclass(frozen=True, slots=True)
class TranslatorCaughtUp:
    """The event that all packets published by the translator during the scheduler's absence have been received."""


@dataclass(frozen=True, slots=True)
class TranslatorReply:
    """The translator's answer to the request that was forwarded under `number`."""

    number: int
    response: Response


@dataclass(frozen=True, slots=True)
class ProblemSeen:
    """The appearance or disappearance of a problem, found in the scheduler's process by the coordinate frame.

    Attributes:
        name: the component in whose name the problem is flagged.
    """

    problem: int
    flagged: bool
    name: str


@dataclass(frozen=True, slots=True)
class Announced:
    """A packet that the coordinate frame publishes itself.

    Attributes:
        before_ns: the translator's time of a packet that must follow this packet; None: current time.
    """

    envelope: str
    payload: bytes
    before_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Stopped:
    """The event that the run is stopped before the end of the experiment: the last input of this scheduler."""


@dataclass(frozen=True, slots=True)
class Tick:
    """The event that a deadline (`SchedulerCore.deadline_s` or `SchedulerCore.deadline_ns`) has passed."""


@dataclass(frozen=True, slots=True)
class FrameReported:
    """A report of the coordinate frame's worker, such as a result or its own end; only the frame reads `report`."""

    report: object


# --- inputs that a step itself raises, for the coordinate frame ------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Started:
    """The event that the scheduler starts, for the first time or after a restart."""


@dataclass(frozen=True, slots=True)
class FrameAnswered:
    """The answer to a request of the coordinate frame."""

    purpose: object
    response: Response


@dataclass(frozen=True, slots=True)
class ControlChanged:
    """The event that this step replaced the state of control; the two states may be equal."""

    before: ArbitrationState
    after: ArbitrationState


Input = (
    Connected
    | Disconnected
    | Greeted
    | RequestIn
    | Unreadable
    | PacketIn
    | ReplayRequested
    | TranslatorUp
    | TranslatorDown
    | TranslatorCaughtUp
    | TranslatorReply
    | ProblemSeen
    | Announced
    | Stopped
    | Tick
    | FrameReported
    | Started
    | FrameAnswered
    | ControlChanged
)


# --- effects, to be carried out in the order given --------------------------------------------------------------------


@dataclass(slots=True)
class Reply:
    """The effect that sends an answer to the peer `name` over `connection`.

    Attributes:
        asked: the kind of the answered request.
    """

    connection: int
    name: str
    response: Response
    asked: int = 0


@dataclass(slots=True)
class Forward:
    """The effect that sends a request to the translator, marked with `number`.

    A request is sent with its payload. A request without a payload, such as a request of the scheduler itself, is
    encoded from its subject.
    """

    number: int
    request: Request


@dataclass(slots=True)
class Publish:
    """The effect that publishes a packet to the subscribers of its envelope.

    Attributes:
        source_ns: the translator's time of the packet; None for a packet of the scheduler, or without a time.
        history: number of packets of this envelope in the cache, also over a restart; 0: this packet is not cached.
    """

    packet: Packet
    source_ns: int | None = None
    history: int = 1


@dataclass(slots=True)
class Replay:
    """The effect that sends packets in order to one subscriber, then the message that it has caught up."""

    subscriber: Hashable
    packets: tuple[Packet, ...]


@dataclass(slots=True)
class SaveState:
    """The effect that saves `state`, so that it survives a kill, before the following effects are carried out."""

    state: SavedState


@dataclass(slots=True)
class Log:
    """The effect that logs a line; `level` is the name of a level of `logging`, such as "INFO"."""

    level: str
    text: str


@dataclass(slots=True)
class Kill:
    """The effect that ends the experiment: the signal KILL is published, and no further request is decided.

    Attributes:
        tip_is_safe: whether the translator may exit; if False, the translator retracts the tip when it is stopped.
    """

    tip_is_safe: bool = True


@dataclass(slots=True)
class Delegate:
    """The effect that gives a job to the coordinate frame's worker; the result is the input `FrameReported`."""

    job: object


Effect = Reply | Forward | Publish | Replay | SaveState | Log | Kill | Delegate


class Codec(Protocol):
    """The conversion of objects to and from bytes; simulated nights use a table in place of the wire format."""

    def encode(self, thing: object) -> bytes:
        """Return a model object as the payload of a packet or an answer."""

    def decode_parameter(self, payload: bytes) -> Parameter | None:
        """Return the ParameterMsg of a response; None if it can't be decoded."""

    def decode_packet(self, message: str, payload: bytes | memoryview) -> object:
        """Return the object of a small packet (ScopeStatus, Feedback, ProcessStates …); None if malformed."""
