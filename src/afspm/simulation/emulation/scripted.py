"""`ScriptedEmulator`: a controller that runs scripts of its clients and replies with their values.

The maker's emulator provides the wire (`open_wire`), the interpreter (`answer`) and the text of an error (`failure`);
this module provides the queue of requests, waiting replies, and all faults of communication.
"""

from __future__ import annotations

import math
import select
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

from afspm.basics.errors import AfspmError
from afspm.simulation.emulation.emulator import Crashed, Emulator
from afspm.simulation.emulation.program import MakerProgram

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
    "takes-all": "for the duration, values beyond the program's own bounds are taken as sent",
    **MakerProgram.fault_kinds,
}

Client = Hashable
"""The wire's identification of a client."""
OnRequest = Callable[[Client, bytes], None]


class ScriptWire(Protocol):
    """The socket of a controller, which receives scripts and sends values.

    Attributes:
        address: address for clients.
        port: port of the listening socket.
    """

    @property
    def address(self) -> str: ...

    @property
    def port(self) -> int: ...

    def poll(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` real seconds for requests or a wake-up; call `OnRequest` with each request."""

    def send(self, client: Client, reply: bytes) -> None:
        """Send a reply to a client, unless it is gone."""

    def send_half(self, client: Client, reply: bytes) -> None:
        """Send a truncated reply, as this transport would truncate it."""

    def close(self) -> None: ...


class ScriptFailed(AfspmError):
    """The error of a script that cannot be run; its message becomes the reply."""

    code = "script-failed"


@dataclass(frozen=True)
class Unfinished:
    """The reply to a script that waits for the instrument.

    Attributes:
        resume: returns the reply, or the next `Unfinished`. Called after every possible change.
    """

    resume: Callable[[], bytes | Unfinished]


@dataclass
class Waiting:
    """A client with a pending reply, due at a time or at the end of its script."""

    client: Client
    reply: bytes | Unfinished
    at_s: float = -math.inf


class ScriptedEmulator(Emulator):
    """A controller that runs scripts. Subclasses write the abstract methods; all are called from one thread.

    Attributes:
        program: the maker's program behind the interpreter, created by `make_program`.
    """

    fault_kinds: ClassVar[dict[str, str]] = SCRIPT_FAULTS
    program: MakerProgram

    # -- what a maker's emulator adds

    @abstractmethod
    def make_program(self) -> MakerProgram:
        """Create the program with its interpreter. `rig`, `faults`, `folder`, `clock` and `log` are already set."""

    @abstractmethod
    def open_wire(self, port: int, on_request: OnRequest) -> ScriptWire:
        """Listen at a port; 0 selects a free port."""

    @abstractmethod
    def answer(self, client: Client, request: bytes) -> bytes | Unfinished:
        """Run the script of a request and return the reply.

        Raises:
            ScriptFailed, or another AfspmError: `failure` makes the reply from the error.
        """

    @abstractmethod
    def failure(self, request: bytes, reason: str) -> bytes:
        """Return the reply to a request whose script failed."""

    @abstractmethod
    def not_a_number(self, request: bytes) -> bytes:
        """Return a reply with the value NaN."""

    # -- steps of the script

    def open(self) -> str:
        """Create the program and start listening."""
        self._queue: deque[tuple[Client, bytes]] = deque()
        self._waiting: list[Waiting] = []
        self._open_again_at_s = math.inf
        self.program = self.make_program()
        self._wire: ScriptWire | None = self.open_wire(self.port, self._requested)
        self._bound_port = self._wire.port
        return self._wire.address

    def serve(self, timeout_s: float) -> None:
        if self._wire is None:
            select.select([self.woken], [], [], timeout_s)
            return
        self._wire.poll(timeout_s)
        while self._queue and not self._has_dialog():
            self._carry_out(*self._queue.popleft())
            self.program.advance(self.clock.now_s())

    def tick(self, now_s: float) -> float | None:
        """Advance the program, and send replies that have become ready."""
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
        """Drop the present activity of the instrument and of the program."""
        super().abandon()
        self.program.abandon()

    def close(self) -> None:
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

    def _answered(self, request: bytes, answer: Callable[[], bytes | Unfinished]) -> bytes | Unfinished:
        try:
            return answer()
        except Crashed:
            raise
        except Exception as error:  # no request of a client may end the program
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
