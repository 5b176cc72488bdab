"""State shared by all modules of the Nanonis software."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

from afspm.basics import Clock, Plain
from afspm.emulation import ControllerClock, Faults, SimulatedInstrument
from afspm.plugins.nanonis.emulator.dispatch import Answer, DeferredResult
from afspm.plugins.nanonis.emulator.registers import Registers
from afspm.plugins.nanonis.emulator.session import SessionFolder

_Z_CONTROLLERS: Final = {
    "current": ("log Current", "A"),
    "frequency-shift": ("OC M1 Freq. Shift", "Hz"),
    "amplitude": ("Amplitude", "V"),
}
"""Name and unit of the z controller, by the mode of the simulated feedback."""


GAIN_M: Final = 1e-10
"""Gain in m, or in m/s, for a simulated gain of 1: a decade of a tunnelling current is about 0.1 nm."""
OUTPUT_V: Final = 10.0
"""Amount of the largest voltage of an output."""


@dataclass
class NanonisCore:
    """The state shared by all modules.

    Attributes:
        file_clock: clock of the controller's computer.
        range_m: range of the scanner in x, y and z, from end to end.
        release: release of the software.
        log: of the experiment.
        client: values stored for the client whose request is being answered.
        opened: names of the modules that clients have opened.
        reported: what others report of real instruments, and the software does (`as_reported`).
    """

    rig: SimulatedInstrument
    faults: Faults
    clock: Clock
    file_clock: ControllerClock
    session: SessionFolder
    range_m: tuple[float, float, float]
    release: int
    log: logging.Logger
    registers: Registers = field(default_factory=Registers)
    client: Plain = field(default_factory=dict)
    opened: set[str] = field(default_factory=set)
    reported: Collection[str] = ()

    @property
    def now_s(self) -> float:
        """Experiment time."""
        return self.clock.now_s()

    @property
    def reach_m(self) -> tuple[float, float]:
        """Largest distance of the tip from the middle of the scanner in x and y, with the voltage limits in force."""
        on, *limits_v = self.registers.get("Piezo.XYZLimits")
        most_v = [min(map(abs, limits_v[2 * axis : 2 * axis + 2])) if on else OUTPUT_V for axis in (0, 1)]
        x, y = (range_m / (2 * OUTPUT_V) * volts for range_m, volts in zip(self.range_m[:2], most_v, strict=True))
        return x, y

    @property
    def takes_all(self) -> bool:
        """True while the software takes values as sent, which it would otherwise refuse, round or clip."""
        return self.faults.lasts("takes-all", self.now_s)

    @property
    def measures_frequency_shift(self) -> bool:
        return "Frequency Shift" in self.rig.channels

    @property
    def z_controller_name(self) -> tuple[str, str]:
        """Name of the z controller, and unit of its setpoint."""
        return _Z_CONTROLLERS[self.rig.world.settings.feedback.mode]

    def experiment_s(self, real_s: float) -> float:
        """Convert real seconds to experiment seconds."""
        return real_s / self.clock.real_s(1.0)

    def deadline_s(self, timeout_ms: int) -> float:
        """Convert a client's timeout in real time to a deadline in experiment time; negative: no deadline."""
        return math.inf if timeout_ms < 0 else self.now_s + self.experiment_s(timeout_ms / 1000)

    def until_free(self, wait: int, timeout_ms: int = -1) -> Answer:
        """Return a result that is ready at once or, if `wait` is set, when the instrument is free."""
        if not wait:
            return ()
        return DeferredResult(lambda now_s: None if self.rig.busy(now_s) else (), self.deadline_s(timeout_ms))
