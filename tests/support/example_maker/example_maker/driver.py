"""The driver: a line of JSON to the controller, and one back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from afspm import read
from afspm.basics import AfspmError
from afspm.driver import Driver, Receiver, TcpConnection, Value, action, host_and_port
from afspm.model import Scan, ScopeState, ScopeStatus, Spectrum, names


class Acme(Driver):
    """A microscope of the maker.

    Args:
        address: of the controller.
        settings: common to all drivers.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    maker: ClassVar[str] = "Acme"

    def __init__(self, *, address: str = "127.0.0.1:7654", **settings: Any) -> None:
        super().__init__(**settings)
        self.controller_at = address

    def connect(self) -> None:
        address, hints = host_and_port(self.controller_at), ("is it switched on?", "a dialog may wait")
        self._connection = TcpConnection(address, 5.0, self.clock.monotonic_s, hints)
        self.prove()
        self._folder = Path(self._ask("folder"))

    def status(self) -> ScopeStatus:
        return ScopeStatus(ScopeState.SCANNING if self._ask("scanning") else ScopeState.FREE)

    def get(self, vendor: str) -> Value:
        value: Value = self._ask("get", vendor)
        return value

    def set(self, values: Mapping[str, Value]) -> None:
        self._ask("set", values)

    def results(self) -> Sequence[str]:
        return sorted(map(str, self._folder.glob("*.acme")))

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return read(result).scans

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        self._ask("start")

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self._ask("stop")

    def close(self) -> None:
        self._connection.close()

    def _ask(self, what: str, value: object = None) -> Any:
        line = json.dumps([what, value]).encode() + b"\n"
        reply = json.loads(self._connection.ask(what, line, _line))
        if "error" in reply:
            raise AfspmError(reply["error"])
        return reply["value"]


def _line(receiver: Receiver) -> bytes:
    line = receiver.some()
    while not line.endswith(b"\n"):
        line += receiver.some()
    return line
