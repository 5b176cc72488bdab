"""`ScriptedEmulator`: a controller whose clients send it scripts, and get a value for each.

The maker's emulator gives the wire (`open_wire`), the interpreter (`answer`) and the words of an error (`failure`);
the queue of requests, replies that wait, and everything that goes wrong on the way are here.
"""

from __future__ import annotations

import math
import select
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Protocol

from afspm.basics.errors import AfspmError
from afspm.simulation.emulation.emulator import Crashed, Emulator
from afspm.simulation.emulation.program import MakerProgram
from afspm.simulation.faults import INSTRUMENT_FAULTS

SCRIPT_FAULTS: Final = {
    "no-reply": "a script is run but not answered",
    "late-reply": "a reply is delayed by the duration",
    "half-reply": "half a reply, and then nothing more",
    "garbage": "a reply that is no value",
    "error": "a script is not run but answered with an error",
    "nan": "a reply that says not-a-number",
    "dialog": "a dialog waits on the screen: nothing is answered for the duration",
    "restart": "the program closes its socket, and opens it again after the duration",
    "crash": "the program vanishes",
    **INSTRUMENT_FAULTS,
}

Client = Hashable
"""A client, as its wire tells it from others."""
OnRequest = Callable[[Client, bytes], None]


class ScriptWire(Protocol):
    """The socket of a controller, that takes scripts and sends values.

    Attributes:
        address: as a client is given it.
        port: that it listens at.
    """

    @property
    def address(self) -> str: ...

    @property
    def port(self) -> int: ...

    def poll(self, timeout_s: float) -> None:
        """Wait up to so many real seconds for requests or to be woken, and call `OnRequest` with each."""

    def send(self, client: Client, reply: bytes) -> None:
        """Send a reply to a client, if it is still there."""

    def send_half(self, client: Client, reply: bytes) -> None:
        """Send half a reply, as the wire can."""

    def close(self) -> None:
        """Listen no more."""


class ScriptFailed(AfspmError):
    """A script can't be run: what the interpreter says becomes the reply."""

    code = "script-failed"


@dataclass(frozen=True)
class Unfinished:
    """The reply to a script that waits for the instrument.

    Attributes:
        resume: return the reply, or what it goes on waiting for. Called whenever something may have changed.
    """

    resume: Callable[[], bytes | Unfinished]


@dataclass
class Waiting:
    """A client whose reply is not sent yet: it waits for a time, or for its script to end."""

    client: Client
    reply: bytes | Unfinished
    at_s: float = -math.inf


class ScriptedEmulator(Emulator):
    """A controller that answers scripts. Write the abstract methods; all are called from one thread.

    Attributes:
        program: the maker's program behind the interpreter, made by `make_program`.
    """

    fault_kinds: ClassVar[dict[str, str]] = SCRIPT_FAULTS
    program: MakerProgram

    # -- what a maker's emulator adds

    @abstractmethod
    def make_program(self) -> MakerProgram:
        """Make the program, with its interpreter. `rig`, `faults`, `folder`, `clock` and `log` are there."""

    @abstractmethod
    def open_wire(self, port: int, on_request: OnRequest) -> ScriptWire:
        """Listen at a port; 0: any free one."""

    @abstractmethod
    def answer(self, client: Client, request: bytes) -> bytes | Unfinished:
        """Run the script of a request, and return the reply.

        Raises:
            ScriptFailed, or another AfspmError: the reply is its `failure`.
        """

    @abstractmethod
    def failure(self, request: bytes, reason: str) -> bytes:
        """Return the reply to a request whose script failed."""

    @abstractmethod
    def not_a_number(self, request: bytes) -> bytes:
        """Return the reply that says NaN."""

    # -- what is done with it

    def open(self) -> str:
        """Make the program, and listen."""
        self._queue: deque[tuple[Client, bytes]] = deque()
        self._waiting: list[Waiting] = []
        self._open_again_at_s = math.inf
        self.program = self.make_program()
        self._wire: ScriptWire | None = self.open_wire(self.port, self._requested)
        self._bound_port = self._wire.port
        return self._wire.address

    def serve(self, timeout_s: float) -> None:
        """Take what was asked, and answer it."""
        if self._wire is None:
            select.select([self.woken], [], [], timeout_s)
            return
        self._wire.poll(timeout_s)
        while self._queue and not self._has_dialog():
            self._carry_out(*self._queue.popleft())
            self.program.advance(self.clock.now_s())

    def tick(self, now_s: float) -> float | None:
        """Advance the program, and send what was waited for."""
        self._restart(now_s)
        again_s = self.program.advance(now_s)
        if not self._has_dialog():
            waiting, self._waiting = self._waiting, []
            for one in waiting:
                self._send_if_due(one, now_s)
        if self._queue and not self._has_dialog():
            return now_s
        times = [again_s, self._open_again_at_s, *(one.at_s for one in self._waiting)]
        return min((at_s for at_s in times if at_s is not None and at_s > now_s), default=None)

    def abandon(self) -> None:
        """Give up what the program does, too."""
        super().abandon()
        self.program.abandon()

    def close(self) -> None:
        """Listen no more."""
        wire: ScriptWire | None = getattr(self, "_wire", None)
        if wire is not None:
            wire.close()

    # -- inside

    def _requested(self, client: Client, request: bytes) -> None:
        self._queue.append((client, request))

    def _has_dialog(self) -> bool:
        return self.faults.lasts("dialog", self.clock.now_s())

    def _restart(self, now_s: float) -> None:
        fault = self.faults.strikes("restart", now_s)
        if fault is not None and self._wire is not None:
            self.listening("")
            self._wire.close()
            self._wire, self._open_again_at_s = None, now_s + fault.duration_s
            self._queue.clear()
            self._waiting.clear()
        if self._wire is None and now_s >= self._open_again_at_s:
            self._open_again_at_s = math.inf
            self._wire = self.open_wire(self._bound_port, self._requested)
            self.listening(self._wire.address)

    def _carry_out(self, client: Client, request: bytes) -> None:
        now_s = self.clock.now_s()
        if self.faults.strikes("crash", now_s):
            raise Crashed("the program vanished")
        if self.faults.strikes("error", now_s):
            reply: bytes | Unfinished = self.failure(request, "an emulated error")
        else:
            reply = self._answered(request, lambda: self.answer(client, request))
        if not isinstance(reply, Unfinished) and self.faults.strikes("nan", now_s):
            reply = self.not_a_number(request)
        self._send_if_due(Waiting(client, self._guarded(request, reply)), now_s)

    def _answered(self, request: bytes, answer: Callable[[], Any]) -> Any:
        try:
            return answer()
        except Crashed:
            raise
        except Exception as error:  # whatever a client asks for, the program stays
            if not isinstance(error, AfspmError):
                self.log.exception("a script failed")
            return self.failure(request, str(error))

    def _guarded(self, request: bytes, reply: bytes | Unfinished) -> bytes | Unfinished:
        if not isinstance(reply, Unfinished):
            return reply
        resume = reply.resume
        return Unfinished(lambda: self._guarded(request, self._answered(request, resume)))

    def _send_if_due(self, one: Waiting, now_s: float) -> None:
        if isinstance(one.reply, Unfinished):
            one.reply = one.reply.resume()
        if isinstance(one.reply, Unfinished) or one.at_s > now_s:
            self._waiting.append(one)
            return
        late = None if math.isfinite(one.at_s) else self.faults.strikes("late-reply", now_s)
        if late is not None:
            self._waiting.append(Waiting(one.client, one.reply, now_s + late.duration_s))
            return
        self._send(one.client, one.reply, now_s)

    def _send(self, client: Client, reply: bytes, now_s: float) -> None:
        if self._wire is None or self.faults.strikes("no-reply", now_s):
            return
        if self.faults.strikes("half-reply", now_s):
            self._wire.send_half(client, reply)
            return
        self._wire.send(client, bytes(range(255, 155, -1)) if self.faults.strikes("garbage", now_s) else reply)
