"""The sweep of a spectrum, resampled from the simulated curve, which has its own range."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from afspm.emulators.activities import SimulatedSpectrum


@dataclass
class SweepSettings:
    """The sweep settings of a spectroscopy module.

    Attributes:
        points: how many; None: as many as the simulated curve has.
        limits: first and last value of what is swept; None: those of the simulated curve. Beyond it nothing changes
            any more.
        sweeps: how many are averaged.
        channels: indexes of the signals that are recorded; None: all that the simulated curve has.
        backward: whether it is swept back, too.
        saves: whether a file is written; saves_all: of every sweep, which is only told; dialog: so is this.
    """

    points: int | None = None
    limits: tuple[float, float] | None = None
    sweeps: int = 1
    channels: list[int] | None = None
    backward: bool = True
    saves: bool = True
    saves_all: bool = False
    dialog: bool = False

    def of(self, curve: SimulatedSpectrum) -> SimulatedSpectrum:
        """Return the curve resampled to this sweep."""
        values = curve.values
        if self.points is not None or self.limits is not None:
            swept = values[:, 0]
            first, last = self.limits or (swept[0], swept[-1])
            asked = np.linspace(first, last, self.points or len(swept))
            ascending = values[np.argsort(swept)]
            columns = (np.interp(asked, ascending[:, 0], column) for column in ascending.T[1:])
            values = np.stack([asked, *columns], axis=1)
        kept = [k for k, name in enumerate(curve.names) if self.backward or not name.endswith(" Retrace")]
        return replace(
            curve,
            values=values[:, kept],
            names=tuple(curve.names[k] for k in kept),
            units=tuple(curve.units[k] for k in kept),
        )
