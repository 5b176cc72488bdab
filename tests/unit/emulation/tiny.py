"""The smallest controller: lines over TCP, one client at a time."""

from __future__ import annotations

import select
import socket
from typing import Any, ClassVar

from deadlines import DEADLINE_S

from afspm.simulation.emulation.emulator import LOOPBACK, Crashed, Emulator


class Tiny(Emulator):
    vendor = "Tiny"
    usual: ClassVar = {"port": 45997}
    fault_kinds: ClassVar = {"crash": "it vanishes", "no-reply": "a line is not answered"}

    def __init__(self, *, release: int = 1, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]
        self.release = release
        self._client: socket.socket | None = None
        self.ended: list[float] = []

    def open(self) -> str:
        self._listener = socket.create_server((LOOPBACK, self.port))
        return f"{LOOPBACK}:{self._listener.getsockname()[1]}"

    def serve(self, timeout_s: float) -> None:
        sources: list[Any] = [self.woken, self._listener, *([self._client] if self._client else [])]
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._listener in ready:
            self._client = self._listener.accept()[0]
        elif self._client is not None and self._client in ready:
            asked = self._client.recv(1000).decode().strip()
            if asked:
                self._answer(asked)
            else:
                self._client.close()
                self._client = None

    def _answer(self, asked: str) -> None:
        now_s = self.clock.now_s()
        if self.faults.strikes("crash", now_s):
            raise Crashed("on request")
        if self.faults.strikes("no-reply", now_s):
            return
        if asked == "scan":
            self.rig.setup.shape, self.rig.setup.line_s = (2, 2), 10.0
            self.rig.start_scan(now_s)
        assert self._client is not None
        self._client.sendall(f"{self.release} {self.rig.doing(now_s)}\n".encode())

    def tick(self, now_s: float) -> float | None:
        if self.rig.scan is not None and not self.rig.busy(now_s) and not self.ended:
            self.ended.append(now_s)
            (self.folder / "scan.txt").write_text("done")
        return None

    def close(self) -> None:
        for one in (self._client, getattr(self, "_listener", None)):
            if one is not None:
                one.close()
        self._client = None  # it may be opened again


def ask(address: str, *lines: str) -> list[str]:
    """Send lines, each after the answer to the previous one; a missing answer is empty."""
    host, port = address.rsplit(":", 1)
    answers = []
    with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as client:
        for line in lines:
            client.sendall(line.encode() + b"\n")
            answers.append(client.recv(1000).decode().strip())
    return answers
