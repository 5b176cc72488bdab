"""Traces of a Gxsm4 with its simulated card, written from its interface's description: one channel, frames at will.

Each answer is there when it changes, as a recording of `afspm trace` has it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from tests.plugins.gxsm.recorded_gxsm import BEGAN_S

from afspm.driver import TCP
from afspm.plugins.gxsm.bridge_client import message, value_line
from afspm.plugins.gxsm.emulator.files import CHANNELS, GxsmScanFile, netcdf3, netcdf4
from afspm.plugins.gxsm.hardware import AUTOSAVE, REPEAT_OFF
from afspm.plugins.gxsm.settings import REFNAMES
from afspm.translator.trace import TracedExchange, TracedFile, TraceHeader, TraceLine

SHAPE: Final = (16, 24)
"""Rows and columns."""
FRAME: Final = {"RangeX": 400.0, "RangeY": 300.0, "OffsetX": 100.0, "OffsetY": 50.0, "Rotation": -20.0}
SAVED_S: Final = 0.25
"""From the end of a scan to its file."""
_IDLE, _SCANNING = 1.0, 3.0


class WrittenTrace:
    """The exchanges and files of a session with GXSM.

    Args:
        version: 3 or 4.
        channels: number of channels of this version that are recorded.
    """

    def __init__(self, version: int = 4, channels: int = 1) -> None:
        self.lines: list[TraceLine] = [TraceHeader("Gxsm", "0.1.0", "2026-01-01T00:00:00+00:00")]
        self._version, self._channels = version, CHANNELS[version][:channels]
        self._number, self._begun_s = 7, 0.0
        self._images = [np.zeros(SHAPE)] * channels
        self._answer(0.0, (*REFNAMES, *FRAME, "PointsX", "PointsY", "ScanX", "ScanY"), "list_refnames")
        self._answer(0.0, (*AUTOSAVE.values(), REPEAT_OFF), "list_actions")
        self._answer(0.0, f"{FRAME['RangeX']} Å    ", "gets", "RangeX")
        for name, value in {**FRAME, "PointsY": SHAPE[0], "PointsX": SHAPE[1], "ScanX": 0.0, "ScanY": 0.0}.items():
            self._answer(0.0, float(value), "get", name)
        self._answer(0.0, SHAPE[0] - 1, "y_current")
        self._answer(0.0, "/home/spm", "getcwd")
        self._bits(0.0, _IDLE)
        self._names(0.0)
        self.draw(0.0, seed=0)

    def begin(self, at_s: float, *, by_driver: bool) -> None:
        """Begin a scan, whose files have a new number from now on."""
        if by_driver:
            self._answer(at_s, 0, "startscan")
        self._bits(at_s + 0.02, _SCANNING)
        self._answer(at_s + 0.02, 2, "y_current")
        self._begun_s = at_s
        self._number += 1
        self._names(at_s + 0.02)

    def end(self, at_s: float) -> None:
        """End a scan, whole or stopped."""
        self._bits(at_s, _IDLE)

    def draw(self, at_s: float, seed: int, rows: int = SHAPE[0]) -> None:
        """Replace this many rows, from the top, in GXSM's memory."""
        random = np.random.default_rng(seed)
        new = [random.uniform(100.0, 200.0, SHAPE).astype(np.float32) for _ in self._channels]
        self._images = [np.vstack([now[:rows], old[rows:]]) for now, old in zip(new, self._images, strict=True)]
        width, height = (FRAME[f"Range{axis}"] / (n - 1) for axis, n in zip("XY", SHAPE[::-1], strict=True))
        for number, (channel, image) in enumerate(zip(self._channels, self._images, strict=True)):
            self._answer(at_s, [*SHAPE[::-1], 1, 1], "get_dimensions", number)
            self._answer(at_s, [width, height, channel.dz, 10.0], "get_differentials", number)
            for row in (0, SHAPE[0] - 1):
                self._answer(at_s, image[row : row + 1] * channel.dz, "get_slice", number, 0, 0, row, 1)

    def save(self, at_s: float) -> None:
        """Save the memory to new files, as `autosave` does."""
        self._answer(at_s, SHAPE[0] - 1, "autosave")
        for number, (channel, image) in enumerate(zip(self._channels, self._images, strict=True)):
            frame = tuple(FRAME[name] for name in ("OffsetX", "OffsetY", "RangeX", "RangeY", "Rotation"))
            saved = GxsmScanFile(
                f"/home/spm/{self._name(number)}", channel.label, image.astype(np.float32), channel.dz, channel.unit,
                frame, BEGAN_S + self._begun_s, BEGAN_S + at_s, "SPM-SIM:SPM", 1.0,  # type: ignore[arg-type]
            )  # fmt: skip
            content = netcdf3(saved) if self._version == 3 else netcdf4(saved)
            self.lines.append(TracedFile(self._name(number), content, at_s))

    def _names(self, at_s: float) -> None:
        for number in range(len(self._channels)):
            self._answer(at_s, f"./{self._name(number)}", "chfname", number)
        self._answer(at_s, "EE: invalid channel", "chfname", len(self._channels))

    def _name(self, number: int) -> str:
        return f"scan{self._number:03}-{self._channels[number].ending(master=number == 0)}"

    def _bits(self, at_s: float, bits: float) -> None:
        self._answer(at_s, [bits, 0.0, 0.0], "rtquery", "s")

    def _answer(self, at_s: float, value: object, method: str, *arguments: str | int) -> None:
        asked = message(method, *arguments)
        self.lines.append(TracedExchange(0, TCP, method, asked, value_line(value), len(self.lines), at_s=at_s))


def two_scans(version: int, channels: int) -> list[TraceLine]:
    """Return a session in which a driver starts two scans."""
    session = WrittenTrace(version, channels)
    for number, at_s in enumerate((0.5, 2.5)):
        session.begin(at_s, by_driver=True)
        session.end(at_s + 0.6)
        session.draw(at_s + 0.6, seed=1 + number)
        session.save(at_s + 0.6 + SAVED_S)
    return session.lines


def repeated_and_stopped() -> list[TraceLine]:
    """Return a session with *Repeat* at the panel: a whole scan without Auto Save, and one stopped half way."""
    session = WrittenTrace()
    session.begin(4.01, by_driver=False)
    session.end(4.64)
    session.draw(4.64, seed=1)
    session.begin(4.68, by_driver=False)
    session.end(5.01)
    session.draw(5.01, seed=2, rows=SHAPE[0] // 2)
    session.save(5.01 + SAVED_S)
    return session.lines
