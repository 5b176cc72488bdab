"""The controller, emulated: its protocol and files, with the simulated instrument behind it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, ClassVar

from afspm.basics import AfspmError
from afspm.emulation import (
    LOOPBACK,
    ClientConnection,
    Emulator,
    MakerProgram,
    NamedFile,
    ScanActivity,
    SpectrumActivity,
    TcpServer,
)
from afspm.model import Region, Scan
from example_maker.files import packed


class AcmeProgram(MakerProgram):
    """The maker's program."""

    def __init__(self, *arguments: Any, **times: Any) -> None:
        super().__init__(*arguments, **times)
        self.panel: dict[str, Any] = {
            "x": -5e-7, "y": -5e-7, "width": 1e-6, "height": 1e-6, "angle": 0.0, "columns": 64, "rows": 64,
            "speed": 1e-5, "bias": 0.1, "version": "Acme 2, SIMULATED",
        }  # fmt: skip

    def prepare_scan(self) -> None:
        panel, setup = self.panel, self.rig.setup
        setup.region = Region.from_top_left((panel["x"], panel["y"]), (panel["width"], panel["height"]), panel["angle"])
        setup.shape, setup.bias_v = (panel["rows"], panel["columns"]), panel["bias"]
        setup.line_s = 2.0 * panel["width"] / panel["speed"]

    def prepare_curve(self) -> None: ...

    def scan_files(self, scan: ScanActivity, now_s: float) -> Sequence[NamedFile]:
        channels = scan.channels(None).items()
        scans = [Scan(scan.region, name, unit, data, int(now_s * 1e9)) for name, (unit, data) in channels]
        return [(f"scan{scan.number:04}.acme", packed(scans))]

    def curve_files(self, curve: SpectrumActivity, now_s: float) -> Sequence[NamedFile]:
        return []


class AcmeEmulator(Emulator):
    """The emulated controller."""

    vendor = "Acme"
    usual: ClassVar = {"port": 7654}
    fault_kinds: ClassVar = MakerProgram.fault_kinds

    def open(self) -> str:
        self._program = AcmeProgram(self.rig, self.faults, self.clock, self.folder, self.log, start_s=0.2, file_s=0.1)
        self._server = TcpServer(LOOPBACK, [self.port], one_each=False, wakes=self.woken, on_bytes=self._received)
        return f"{LOOPBACK}:{self._server.ports[0]}"

    def serve(self, timeout_s: float) -> None:
        self._server.poll(timeout_s)

    def tick(self, now_s: float) -> float | None:
        return self._program.advance(now_s)

    def close(self) -> None:
        if hasattr(self, "_server"):
            self._server.close()

    def _received(self, client: ClientConnection) -> None:
        while b"\n" in client.received:
            line, _, rest = bytes(client.received).partition(b"\n")
            client.received[:] = rest
            try:
                reply = {"value": self._answer(*json.loads(line))}
            except (AfspmError, KeyError, TypeError, ValueError) as error:
                reply = {"error": str(error)}
            self._server.send(client, json.dumps(reply).encode() + b"\n")

    def _answer(self, what: str, value: Any) -> object:
        program, now_s = self._program, self.clock.now_s()
        match what:
            case "folder":
                return str(self.folder)
            case "scanning":
                return program.scanning
            case "get":
                return program.panel[value]
            case "set":
                return program.panel.update(value)
            case "start":
                program.start_scan(now_s)
            case "stop":
                program.stop_scan(now_s)
            case _:
                raise ValueError(f"{what} is no request")
        return None
