"""A controller that echoes lines, for one client at a time."""

from __future__ import annotations

import select
import socket
import threading
from typing import Any, ClassVar

from afspm.simulation.emulation.emulator import LOOPBACK, Crashed, Emulator


class Echo(Emulator):
    vendor = "Echo"
    fault_kinds: ClassVar = {"crash": "it vanishes without an answer"}

    def __init__(self, *, greeting: str = "", **settings: Any) -> None:
        super().__init__(**settings)
        self.greeting = greeting

    def open(self) -> str:
        self._listener = socket.create_server((LOOPBACK, self.port))
        return f"{LOOPBACK}:{self._listener.getsockname()[1]}"

    def serve(self, timeout_s: float) -> None:
        sources: list[Any] = [self.woken, self._listener]
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._listener not in ready:
            return
        with self._listener.accept()[0] as client:
            asked = client.recv(1000).decode()
            if self.faults.strikes("crash", self.clock.now_s()):
                raise Crashed("on request")
            told = str(self.clock.now_s()) if asked == "time" else f"{self.greeting} {asked}, seed {self.seed}"
            client.sendall(told.encode())

    def close(self) -> None:
        self._listener.close()


class Late(Echo):
    """Starts only after the end of the experiment."""

    def run(self, *arguments: Any) -> None:
        for thread in threading.enumerate():
            if thread.name == "experiment":
                thread.join()
        super().run(*arguments)
