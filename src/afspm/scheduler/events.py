"""The inputs and effects of `SchedulerCore`.

Times are given beside the input: `now_s`, real and monotonic, for timeouts; `now_ns`, the experiment's, for whatever
means something in the experiment.
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
    """A peer connected to the control socket. `connection` numbers grow and are never used again."""

    connection: int


@dataclass(frozen=True, slots=True)
class Disconnected:
    """A connection to the control socket is gone."""

    connection: int


@dataclass(frozen=True, slots=True)
class Greeted:
    """The peer of a connection said its name and nothing else (the empty first message of ZMQ_PROBE_ROUTER)."""

    connection: int
    name: str
    user: str | None = None


@dataclass(frozen=True, slots=True)
class RequestIn:
    """A request came by `connection` from the peer that calls itself `name`.

    Attributes:
        user: whose key it was, where connections are authenticated; None where they are not.
        heard_s: when it came first, real; negative: in this step.
    """

    connection: int
    name: str
    request: Request
    user: str | None = None
    heard_s: float = -1.0


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A message from the peer `name` was no request, and was refused with `response`."""

    name: str
    response: Response


@dataclass(frozen=True, slots=True)
class PacketIn:
    """The translator published a packet."""

    packet: Packet
    header: PacketHeader


@dataclass(frozen=True, slots=True)
class ReplayRequested:
    """A subscriber asks for what is cached under `prefixes` and newer than `since_ns`.

    Attributes:
        subscriber: whatever the caller needs to find it again; comes back in `Replay`.
    """

    subscriber: Hashable
    prefixes: tuple[str, ...]
    since_ns: int = -1


@dataclass(frozen=True, slots=True)
class TranslatorUp:
    """The translator can be asked."""


@dataclass(frozen=True, slots=True)
class TranslatorDown:
    """The connection to the translator is gone."""


@dataclass(frozen=True, slots=True)
class TranslatorCaughtUp:
    """All that the translator published while we were not there has been taken in."""


@dataclass(frozen=True, slots=True)
class TranslatorReply:
    """The translator answered the request that was forwarded under `number`."""

    number: int
    response: Response


@dataclass(frozen=True, slots=True)
class ProblemSeen:
    """The scheduler itself sees that a problem has come, or gone.

    Attributes:
        name: in whose name it is flagged.
    """

    problem: int
    flagged: bool
    name: str


@dataclass(frozen=True, slots=True)
class Announced:
    """The scheduler itself has something to publish.

    Attributes:
        before_ns: the translator's time of a packet that it goes before; None: it is of now.
    """

    envelope: str
    payload: bytes
    before_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Stopped:
    """The run is stopped though the experiment is not over: this is the last that the scheduler hears."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Nothing happened, but a deadline (`SchedulerCore.deadline_s`) has come."""


@dataclass(frozen=True, slots=True)
class FrameReported:
    """The worker of the coordinate frame has a result, or has ended; only that frame knows what is in it."""

    report: object


# --- inputs that a step itself raises, for the coordinate frame ------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Started:
    """The scheduler starts, for the first time or after a restart."""


@dataclass(frozen=True, slots=True)
class FrameAnswered:
    """A request that the coordinate frame made has its answer."""

    purpose: object
    response: Response


@dataclass(frozen=True, slots=True)
class ControlChanged:
    """This step changed the holder, the mode or the problems."""

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
    """Answer the peer `name`, over `connection` (which is open, and the newest of that name).

    Attributes:
        asked: the number of the request that is answered.
    """

    connection: int
    name: str
    response: Response
    asked: int = 0


@dataclass(slots=True)
class Forward:
    """Send a request to the translator, marked with `number`.

    A client's `request.payload` is sent as it came. A request of the scheduler's own has none: its subject is encoded.
    """

    number: int
    request: Request


@dataclass(slots=True)
class Publish:
    """Publish a packet to whoever subscribes to its envelope.

    Attributes:
        source_ns: the translator's own time of it; None for what comes from the scheduler.
        history: how many of its envelope the cache keeps over a restart; 0: this one is not in it.
    """

    packet: Packet
    source_ns: int | None = None
    history: int = 1


@dataclass(slots=True)
class Replay:
    """Send these packets to one subscriber, in this order, and then that it has caught up."""

    subscriber: Hashable
    packets: tuple[Packet, ...]


@dataclass(slots=True)
class SaveState:
    """Keep `state` so that it survives a kill, before the effects that follow are carried out."""

    state: SavedState


@dataclass(slots=True)
class Log:
    """Tell people. `level` is a name of the logging module: "INFO", "WARNING", "ERROR"."""

    level: str
    text: str


@dataclass(slots=True)
class Kill:
    """The experiment ends: publish the signal KILL, and close.

    Attributes:
        tip_is_safe: the translator may leave; if not, it sees to the tip when it is asked to.
    """

    tip_is_safe: bool = True


@dataclass(slots=True)
class Delegate:
    """Hand a job to the worker of the coordinate frame; what comes of it is an input, `FrameReported`."""

    job: object


Effect = Reply | Forward | Publish | Replay | SaveState | Log | Kill | Delegate


class Codec(Protocol):
    """Objects to and from bytes, as decisions need them; in simulated nights a table takes the place of the wire."""

    def encode(self, thing: object) -> bytes:
        """Return a model object as the payload of a packet or an answer."""

    def decode_parameter(self, payload: bytes) -> Parameter | None:
        """Return the ParameterMsg of a response; None if it is not one."""

    def decode_packet(self, message: str, payload: bytes | memoryview) -> object:
        """Return the object of a small packet (ScopeStatus, Feedback, ProcessStates …); None if malformed."""
