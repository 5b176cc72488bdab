"""`Rig`: a simulated instrument with no vendor's controller around it yet.

An emulator sets what is in force, starts things and asks how far they are; the protocol, the files and the quirks are
its own. Lengths in m in tip coordinates, angles in rad counter-clockwise, times in experiment seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from afspm.clock import Clock
from afspm.emulators.activities import RETRACE, Move, Occupied, ScanActivity, SpectrumActivity, noise_in_air
from afspm.emulators.scan_drawing import ScanDrawing
from afspm.errors import AfspmError, InvalidValue
from afspm.model import Feedback, Region
from afspm.plain_data import PlainMapping
from afspm.simulation import World
from afspm.simulation.feedback import FeedbackSettings

Doing = ScanActivity | SpectrumActivity | Occupied
_MOST_AVERAGED = 32  # of more sweeps the noise is no less
_FASTEST_DRIFT_M_S = 1e-6
_FEW = (2, 2)  # pixels: enough to see which channels there are


class RigBusy(AfspmError):
    """The instrument does something else, which is to be stopped or waited for first."""

    code = "rig-busy"


class InstrumentSetup:
    """The settings in force.

    Attributes:
        region, shape, line_s, upwards: of the next scan: the frame, (rows, columns), seconds of a line there and back,
            and whether it begins with the smallest y.
        slope: compensation of tilt, (x, y).
        move_speed_m_s: of the probe outside of scans.
        approach_s: duration of an approach or a withdrawal.
    """

    def __init__(self, feedback: FeedbackSettings) -> None:
        self.region = Region((0.0, 0.0), (1e-6, 1e-6))
        self.shape = (128, 128)
        self.line_s = 1.0
        self.upwards = True
        self.feedback = Feedback(feedback.on, feedback.proportional_gain, feedback.integral_gain, feedback.setpoint)
        self.bias_v = 0.1
        self.slope = (0.0, 0.0)
        self.move_speed_m_s = 5e-6
        self.approach_s = 1.0


class Rig:
    """A simulated instrument, which does one thing at a time. For one thread at a time.

    Args:
        world_settings: `surface`, `tip`, `drift` … of the simulated world, as of the Simulator.
        seed: everything that is left to chance follows from it.
        background: compute the values of a scan while it lasts; False: at its start.

    Attributes:
        setup: the settings in force.
        drawing: of scans.
        engaged: whether the tip is at the sample; if not, all that is measured is noise.
        scan, spectrum: the last one that was started, also when it is over; None before the first.
        world: the physics, with its ground truth (`world.truth`).
    """

    def __init__(self, world_settings: PlainMapping, seed: int, clock: Clock, *, background: bool = True) -> None:
        self.clock = clock
        self.seed = seed
        self.world = World.from_settings(world_settings, seed, clock.now_s())
        # its channels are known from a few pixels of a world that nothing happens to
        few = World.from_settings(world_settings, seed, 0.0).scan(Region((0.0, 0.0), (1e-9, 1e-9)), _FEW, 1.0, 0.0)
        self._units = {name: unit for name, (unit, _) in few.channels().items()}
        self.setup = InstrumentSetup(self.world.settings.feedback)
        self.drawing = ScanDrawing(self.world, self._units, seed, background=background)
        self.engaged = True
        self.scan: ScanActivity | None = None
        self.spectrum: SpectrumActivity | None = None
        self._doing: Doing | None = None
        self._probe_m = (0.0, 0.0)
        self._spectra = 0
        self._noise = np.random.default_rng((seed, 3))
        self._signals: Mapping[str, float] = {}

    # -- what goes on

    @property
    def channels(self) -> Mapping[str, str]:
        """The channels of every scan, with their units."""
        return dict(self._units)

    def doing(self, now_s: float) -> str:
        """Return "scan", "spectrum", "move", "pulse", "crash", "approach", the activity of `occupy`, or "" if free."""
        return self._doing.what if self._doing is not None and self._doing.running(now_s) else ""

    def busy(self, now_s: float) -> bool:
        """True while something is going on."""
        return bool(self.doing(now_s))

    def next_change_s(self, now_s: float) -> float | None:
        """Return when it will be free; None if it is free or paused, or if `wake` will be called."""
        if self._doing is None or not self._doing.running(now_s) or self._doing.end_s <= now_s:
            return None
        return None if isinstance(self._doing, ScanActivity) and self._doing.paused else self._doing.end_s

    def probe_at(self, now_s: float) -> tuple[float, float]:
        """Return the position of the tip, also during a move or a scan."""
        doing = self._doing
        if isinstance(doing, ScanActivity) and doing.running(now_s):
            return doing.tip_m(now_s)
        if isinstance(doing, Move) and doing.running(now_s):
            return doing.probe_at(now_s)
        return self._probe_m

    def signals(self, now_s: float) -> Mapping[str, float]:
        """Return the present value of each channel with its noise: along the line during a scan, else at rest."""
        scan, place = self.scan, self.probe_at(now_s)
        if not self.engaged:
            return self._noise_alone()
        if scan is not None and scan.drawing and self._signals:
            return self._signals  # the world is one thread's at a time
        self.drawing.wait()
        if scan is not None and scan is self._doing and scan.running(now_s):
            self._signals = scan.signals(now_s)
        else:
            try:
                self._signals = self.world.at_rest(
                    place, now_s, self.setup.feedback, self.setup.bias_v, slope=self.setup.slope, random=self._noise
                )
            except InvalidValue:  # nothing is met with such a feedback
                self._signals = self._noise_alone()
        return self._signals

    def _noise_alone(self) -> dict[str, float]:
        kinds = {name: unit for name, unit in self._units.items() if not name.endswith(RETRACE)}
        return {name: float(noise_in_air(self._noise, (), unit)) for name, unit in kinds.items()}

    def hold(self, z_m: float) -> None:
        """Leave z there while the feedback is off. Raises InvalidValue."""
        self.drawing.wait()
        self.world.hold(z_m)

    @property
    def probe_m(self) -> tuple[float, float]:
        """The target of the last move, (x, y), at which spectra, pulses and crashes happen."""
        return self._probe_m

    # -- what it can be told to do

    def start_scan(self) -> ScanActivity:
        """Scan the frame.

        Raises:
            RigBusy. InvalidValue: what is in force can't be scanned.
        """
        now_s = self._free_now_s()
        setup = self.setup
        number = 1 if self.scan is None else self.scan.number + 1
        scan = ScanActivity(
            number, setup.region, setup.shape, now_s, setup.line_s, setup.upwards, setup.feedback, setup.bias_v
        )
        self.drawing.start(scan, setup.slope, engaged=self.engaged)
        self.scan = self._doing = scan
        return scan

    def stop_scan(self) -> None:
        """Break the scan off, if one is running. What it has of lines stays to be had from `scan`."""
        if self.scan is not None:
            self.scan.stop(self.clock.now_s())

    def start_spectrum(self, kind: str, sweeps: int = 1) -> SpectrumActivity:
        """Take a curve of a kind ("IV", "force") where the probe is, the mean of so many.

        Raises:
            RigBusy. InvalidValue: there is no such kind.
        """
        now_s = self._free_now_s()
        taken = [
            self.world.spectrum(kind, self._probe_m, now_s, self.setup.feedback, self.setup.bias_v)
            for _ in range(max(1, min(sweeps, _MOST_AVERAGED)))
        ]
        names, units, _ = taken[0]
        values = np.mean([values for _, _, values in taken], axis=0)
        self._spectra += 1
        if not self.engaged:
            random = np.random.default_rng((self.seed, 2, self._spectra))
            for column, unit in list(enumerate(units))[1:]:  # the first is what is swept
                values[:, column] = noise_in_air(random, values.shape[:1], unit)
        end_s = now_s + sweeps * self.world.spectrum_s(kind)
        self.spectrum = SpectrumActivity(self._spectra, kind, self._probe_m, now_s, end_s, names, units, values)
        self._doing = self.spectrum
        return self.spectrum

    def abandon(self) -> None:
        """Give up whatever goes on; what it has of a scan's lines stays."""
        self.stop_scan()
        self._doing = None

    def stop_spectrum(self) -> None:
        """Break the spectrum off, if one is running: it is gone."""
        if isinstance(self._doing, SpectrumActivity) and self._doing.running(self.clock.now_s()):
            self._doing = self.spectrum = None

    def move_probe(self, xy_m: tuple[float, float]) -> None:
        """Move the tip; the way takes its time. A move under way is turned to the new place.

        Raises:
            RigBusy: with something else than a move. InvalidValue: no place.
        """
        _finite("the position of the probe", *xy_m)
        now_s = self.clock.now_s()
        if self.doing(now_s) != "move":
            self._free_now_s()
        from_m, self._probe_m = self.probe_at(now_s), (float(xy_m[0]), float(xy_m[1]))
        end_s = now_s + math.dist(from_m, self._probe_m) / self.setup.move_speed_m_s
        self._doing = Move("move", now_s, end_s, from_m, self._probe_m)

    def stop_move(self) -> None:
        """Stay where the tip is on its way."""
        now_s = self.clock.now_s()
        if self.doing(now_s) == "move":
            self._probe_m, self._doing = self.probe_at(now_s), None

    def stop(self, what: str) -> None:
        """Be free, if it is busy with what `occupy` was told."""
        if self.doing(self.clock.now_s()) == what:
            self._doing = None

    def pulse(self, voltage_v: float, duration_s: float) -> str:
        """A bias pulse where the probe is: "cured", "worsened" or "unchanged"."""
        self._free_now_s()
        outcome = self.pulsed(voltage_v, duration_s)
        self.occupy("pulse", duration_s)
        return outcome

    def pulsed(self, voltage_v: float, duration_s: float) -> str:
        """As `pulse`, of one that is over: somebody has set the bias, and put it back."""
        self.drawing.wait()
        if not self.engaged or duration_s <= 0.0:
            return "unchanged"
        return self.world.pulse(voltage_v, duration_s, self.clock.now_s(), self._probe_m)

    def crash(self, depth_m: float, speed_m_s: float) -> str:
        """Drive the tip into the sample where the probe is, and out again: as `pulse`."""
        if not min(depth_m, speed_m_s) > 0.0:
            raise InvalidValue(f"a crash {depth_m} m deep with {speed_m_s} m/s", hint="depth and speed must be above 0")
        now_s = self._free_now_s()
        outcome = self.world.crash(self._probe_m, depth_m, speed_m_s, now_s) if self.engaged else "unchanged"
        self.occupy("crash", 2.0 * depth_m / speed_m_s)
        return outcome

    def follow(self, velocity_m_per_s: tuple[float, float]) -> None:
        """Move the scanner with this velocity (x, y) from now on, to follow the sample.

        Raises:
            InvalidValue: faster than any drift.
        """
        if not max(map(abs, velocity_m_per_s)) <= _FASTEST_DRIFT_M_S:
            raise InvalidValue(f"a drift of {velocity_m_per_s} m/s", hint=f"at most {_FASTEST_DRIFT_M_S} m/s")
        self.drawing.wait()
        self.world.compensate(velocity_m_per_s, self.clock.now_s())

    def shift_sample(self, by_m: tuple[float, float], lasts_s: float) -> None:
        """Move the sample with a coarse stage, so that the tip is over another place of it, (x, y) further.

        Raises:
            RigBusy. InvalidValue: no distance or duration.
        """
        _finite("the way of the stage", *by_m)
        self.occupy("stage", lasts_s)
        if lasts_s > 0.0:
            now_s = self.clock.now_s()
            self.world.compensate((by_m[0] / lasts_s, by_m[1] / lasts_s), now_s)
            self.world.compensate((0.0, 0.0), now_s + lasts_s)

    def engage(self) -> None:
        """Bring the tip to the sample."""
        self._free_now_s()
        self.engaged = True
        self.occupy("approach", self.setup.approach_s)

    def withdraw(self) -> None:
        """Take the tip away from the sample, whatever is going on."""
        self.stop_scan()
        self.stop_spectrum()
        self.engaged = False
        self._doing = None
        self.occupy("approach", self.setup.approach_s)

    def occupy(self, what: str, lasts_s: float) -> None:
        """Be busy with anything else for so long. Raises RigBusy, InvalidValue."""
        _finite("the duration", lasts_s)
        now_s = self._free_now_s()
        self._doing = Occupied(what, now_s, now_s + lasts_s)

    # -- inside

    def _free_now_s(self) -> float:
        """Return the time. Raises RigBusy."""
        now_s = self.clock.now_s()
        doing = self.doing(now_s)
        if doing:
            raise RigBusy(f"the instrument is busy with a {doing}")
        self.drawing.wait()
        return now_s


def _finite(what: str, *values: float) -> None:
    """Raises InvalidValue unless all are."""
    if not all(map(math.isfinite, values)):
        raise InvalidValue(f"{what}: {', '.join(map(str, values))}", hint="must be finite")
