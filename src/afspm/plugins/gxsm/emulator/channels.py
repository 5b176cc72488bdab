"""The channels that GXSM records, with its names for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np


@dataclass(frozen=True)
class GxsmChannel:
    """One channel.

    Attributes:
        source: what the instrument calls it.
        label: what GXSM does.
        direction: "Xp" forward, "Xm" backward.
        unit: as stored ("AA" of lengths), and as shown.
        scale: of the instrument's values to this unit.
        dz: stored values times this are in this unit.
    """

    source: str
    label: str
    direction: str
    unit: tuple[str, str]
    scale: float
    dz: float

    def ending(self, *, master: bool) -> str:
        """Ending of the file's name, after the number."""
        return f"{'M-' if master else ''}{self.direction}-{self.label.replace('-', 'm')}.nc"

    def raw(self, values: np.ndarray) -> np.ndarray:
        """Return what is stored of an image [y, x] with y ascending: rows from the top, NaN where not scanned."""
        return (values[::-1] * (self.scale / self.dz)).astype(np.float32)


_ANGSTROM: Final = (("AA", "Å"), 1e10)
SIMULATED_3: Final = (
    GxsmChannel("Height", "Topo", "Xp", *_ANGSTROM, 0.117506942891),
    GxsmChannel("Amplitude", "MIX1", "Xp", ("V", "V"), 1.0, 0.000305185),
)
"""Of the simulator that Gxsm3 has."""
CHANNELS: Final = {
    3: (
        GxsmChannel("Height", "Topo", "Xp", *_ANGSTROM, 0.117506942891),
        GxsmChannel("Height Retrace", "Topo", "Xm", *_ANGSTROM, 0.117506942891),
        GxsmChannel("Amplitude", "ADC1", "Xp", ("V", "V"), 1.0, 0.000305185),
    ),
    4: (
        GxsmChannel("Height", "ZS-Topo", "Xp", *_ANGSTROM, 1.0),
        GxsmChannel("Height Retrace", "ZS-Topo", "Xm", *_ANGSTROM, 1.0),
        GxsmChannel("Current", "I-Tunnel", "Xp", ("nA", "nA"), 1e9, 1.0),
        GxsmChannel("Frequency Shift", "dFreq", "Xp", ("Hz", "Hz"), 1.0, 1.0),
        GxsmChannel("Phase", "Phase", "Xp", ("deg", "°"), 1.0, 1.0),
    ),
}
"""By the version of GXSM."""
