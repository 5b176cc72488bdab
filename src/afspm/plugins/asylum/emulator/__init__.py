"""Emulated Asylum Research microscope: Igor Pro with ZeroMQ-XOP, Asylum's functions and simulated physics."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

from afspm.basics import AfspmError, ConfigError, Duration, Plain
from afspm.emulation import LOOPBACK, Crashed, Emulator
from afspm.plugins.asylum.emulator import wire
from afspm.plugins.asylum.emulator.controller import FAULT_KINDS, AsylumController, AsylumSettings
from afspm.plugins.asylum.emulator.functions import AsylumFunctions, DialogOpen
from afspm.plugins.asylum.emulator.server import QueuedCall, XopServer
from afspm.plugins.asylum.emulator.values import IgorValues

PROCEDURES: Final = ("afspm", "spots", "none")
_NOT_COMPILED, _ABORTED, _UNKNOWN = 100, 107, 1


@dataclass(frozen=True)
class DelayedMessage:
    """A reply with its time of sending, experiment time."""

    client: bytes
    payload: bytes
    at_s: float


class AsylumEmulator(Emulator):
    """The emulated microscope.

    Args:
        idle_s: real seconds between two idle moments of Igor; one call is executed at each moment; 0: calls are
            executed at once.
        start_s: duration of the ramp to the first line, experiment time.
        file_s: delay between the end of a measurement and the first half of its file, and between both halves,
            experiment time.
        save_path: Igor's name of the data folder, "C:Users:Me:Data:". Default: the folder's own path.
        base_name: base name of the files.
        procedures: included procedure files: "afspm" (afspm.ipf), "spots" (procedures of the published afspm) or
            "none".
        has_status: True if this release has the function ARGetStatus.
        image_open: True if a window shows an image with spots.
        saves_partial: True if stopped images are saved.
        seed, faults, and the simulated world: settings of every emulator.
    """

    vendor = "Asylum"
    usual: ClassVar[Plain] = {"port": 5555}
    fault_kinds: ClassVar[dict[str, str]] = {
        "no-reply": "a request is carried out but not answered",
        "late-reply": "a reply is delayed by the duration and may arrive after later ones",
        "wrong-id": "a reply with the messageID of another request",
        "garbage": "a reply that is not JSON",
        "frames": "a reply of one frame too many",
        "not-utf8": "a text that is not UTF-8: there is no reply",
        "busy": "Igor is busy for the duration, and then does what was requested meanwhile",
        "dialog": "a dialog blocks a function for the duration, until OK is pressed",
        "not-compiled": "for the duration, a procedure window is being edited (error 100)",
        "aborted": "a function is aborted (error 107)",
        "unknown": "an unknown error (1)",
        "nan": "GV gives nan",
        "restart": "ZeroMQ-XOP is stopped, and bound again after the duration",
        "crash": "Igor vanishes",
        **FAULT_KINDS,
    }

    modes: ClassVar[Sequence[str]] = ("amplitude", "current")

    def __init__(
        self,
        *,
        idle_s: Duration = 0.0,
        start_s: Duration = 0.2,
        file_s: Duration = 0.1,
        save_path: str = "",
        base_name: str = "Image",
        procedures: str = "afspm",
        has_status: bool = True,
        image_open: bool = True,
        saves_partial: bool = False,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        if procedures not in PROCEDURES:
            raise ConfigError(f"unknown procedures: {procedures!r}", where="procedures", hint=" or ".join(PROCEDURES))
        self._settings = AsylumSettings(
            idle_s, start_s, file_s, save_path, base_name, procedures, has_status, image_open, saves_partial
        )

    def open(self) -> str:
        self._server = XopServer(self.port, self.woken, self.log)
        # Igor's form "C:Users:Me:"; on a system without drive letters the path starts with a colon
        path = self._settings.save_path or f"{self.folder.drive.rstrip(':')}:{':'.join(self.folder.parts[1:])}:"
        texts = {"SaveImage": path, "SaveForce": path, "BaseName": self._settings.base_name}
        values = IgorValues(texts)
        self.controller = AsylumController(
            self.rig, self.faults, values, self.folder, self._settings, self.file_clock, self.log
        )
        self._functions = self.functions()
        self._delayed: deque[DelayedMessage] = deque()
        self._idle_at_s = -math.inf
        self._locked_until_s = self._bound_again_at_s = -math.inf
        self._last_id: str | None = None
        return self._address

    @property
    def _address(self) -> str:
        return f"tcp://{LOOPBACK}:{self._server.port}"

    def functions(self) -> dict[str, wire.IgorFunction]:
        """Return the callable functions by lower-case name, since Igor ignores case."""
        return AsylumFunctions(self.controller, self.clock.now_s, self._settings).table()

    def serve(self, timeout_s: float) -> None:
        """Receive requests, and execute one queued call at each idle moment of Igor (see `idle_s`)."""
        if self._server.queue and not self._busy():
            timeout_s = min(timeout_s, max(0.0, self._idle_at_s - self.clock.monotonic_s()))
        self._server.poll(timeout_s, locked=self._locked())
        while self._server.queue and not self._busy() and self.clock.monotonic_s() >= self._idle_at_s:
            self._idle_at_s = self.clock.monotonic_s() + self._settings.idle_s
            self._carry_out(self._server.queue.popleft())
            self.controller.advance(self.clock.now_s())

    def tick(self, now_s: float) -> float | None:
        if not self._locked():
            self.take_button_away()  # the dialog's time is over
        while self._delayed and self._delayed[0].at_s <= now_s:
            delayed = self._delayed.popleft()
            self._server.send(delayed.client, delayed.payload)
        restart = self.faults.strikes("restart", now_s)
        if restart is not None:
            self.listening("")
            self._server.unbind()
            self._bound_again_at_s = now_s + restart.duration_s
        if not self._server.listens and now_s >= self._bound_again_at_s:
            self._server.bind()
            self.listening(self._address)
        times = [self.controller.advance(now_s), self._locked_until_s, self._bound_again_at_s]
        times += [self._delayed[0].at_s] if self._delayed else []
        return min((at_s for at_s in times if at_s is not None and at_s > now_s), default=None)

    def abandon(self) -> None:
        """Drop the present activity, and stop the scan or curve that Asylum's panels show as running."""
        super().abandon()
        self.controller.abandon()

    def close(self) -> None:
        if hasattr(self, "_server"):
            self._server.close()

    # --- requests ---

    def _locked(self) -> bool:
        return self.clock.now_s() < self._locked_until_s

    def _busy(self) -> bool:
        return self._locked() or self.faults.lasts("busy", self.clock.now_s())

    def _carry_out(self, queued: QueuedCall) -> None:
        now_s = self.clock.now_s()
        if self.faults.strikes("crash", now_s):
            raise Crashed(f"at {queued.call.name}")
        try:
            payload = self._called(queued.call, now_s)
        except wire.CallFailed as failed:
            payload = wire.failure(failed, queued.call.message_id)
        except UnicodeEncodeError:
            self.log.warning("the reply to %s is not UTF-8 and was not sent", queued.call.name)
            return
        dialog = self.faults.strikes("dialog", now_s)
        if dialog is not None:
            self._open_dialog("an emulated dialog", dialog.duration_s)
        if self._locked():
            self._delayed.append(DelayedMessage(queued.client, payload, self._locked_until_s))
        else:
            self._reply(queued, payload, now_s)

    def _called(self, call: wire.FunctionCall, now_s: float) -> bytes:
        if self.faults.lasts("not-compiled", now_s):
            raise wire.CallFailed(_NOT_COMPILED)
        function = self._functions.get(call.name.lower())
        arguments = wire.arguments(function, call.parameters)
        assert function is not None
        if self.faults.strikes("aborted", now_s):
            raise wire.CallFailed(_ABORTED, "While executing a user function, the following error occurred: emulated")
        if self.faults.strikes("unknown", now_s):
            raise wire.CallFailed(_UNKNOWN)
        try:
            given = function.do(*arguments)
        except wire.CallFailed:
            raise
        except DialogOpen as dialog:
            self._open_dialog(str(dialog), math.inf)
            given = dialog.result
        except Exception as error:  # any error of a function aborts the call only: Igor goes on
            if not isinstance(error, AfspmError):
                self.log.exception("%s was aborted", call.name)
            raise wire.CallFailed(_ABORTED, f"While executing {call.name} an error occurred: {error}") from error
        if isinstance(given, str) and self.faults.strikes("not-utf8", now_s):
            given += "\udcb0"
        return wire.success(function, given, call.message_id)

    def _open_dialog(self, text: str, lasts_s: float) -> None:
        # A modal dialog stops Igor's main thread: queued calls wait until OK is pressed, or for `lasts_s`.
        self._locked_until_s = self.clock.now_s() + lasts_s
        self.show_button("press-OK", f"a dialog waits for OK: {text}", self._close_dialog)

    def _close_dialog(self) -> None:
        opened, now_s = self._locked_until_s, self.clock.now_s()
        self._locked_until_s = now_s
        self._delayed = deque(replace(one, at_s=now_s) if one.at_s == opened else one for one in self._delayed)

    def _reply(self, queued: QueuedCall, payload: bytes, now_s: float) -> None:
        before, self._last_id = self._last_id, queued.call.message_id
        if self.faults.strikes("no-reply", now_s):
            return
        if self.faults.strikes("wrong-id", now_s):
            payload = wire.failure(wire.CallFailed(_UNKNOWN), before or "another")
        if self.faults.strikes("garbage", now_s):
            payload = payload[: len(payload) // 2]
        late = self.faults.strikes("late-reply", now_s)
        if late is not None:
            self._delayed.append(DelayedMessage(queued.client, payload, now_s + late.duration_s))
            return
        if self.faults.strikes("frames", now_s):
            self._server.send(queued.client, payload, b"")
            return
        self._server.send(queued.client, payload)
