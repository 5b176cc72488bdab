"""`SimulatedInstrument`: the simulated instrument that the Simulator's driver and all emulated controllers use.

**Theory of operation.** A driver or a maker's protocol changes the settings (`setup`), starts one activity after the
other, and polls its progress. The instrument has no clock and no threads: every call passes the time (experiment
seconds), and the computation of a scan is passed to `run`, which may use a thread.

| | |
| --- | --- |
| inputs | `setup`, commands with their time |
| state | the world (tip, sample, drift), one activity, the probe's position |
| outputs | activities with their values, a `note` of each event |

Invariants: one activity at a time; the world is used by the computation of a scan or by the caller, never by both
(`ScanDrawing.wait`); the same seed and the same commands at the same times give the same values; `state` at any moment
suffices to continue after a kill: a running scan is computed again from the world at its start.

Lengths in m in tip coordinates, angles in rad counter-clockwise, times in experiment seconds.

There is one instrument for driver and emulators, since with two of them a fault, or the correction of an error, was
missing in the other. A spectrum is computed at its start: if it is stopped, the random numbers that follow are the
same.

During a spectrum the controller holds the z feedback, and gives it back some time after the end (`feedback.hold_s`).
The switch in `setup.feedback` is a person's: it stays as set, and decides whether the feedback comes back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from afspm.basics.errors import AfspmError, InvalidValue
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.model import Feedback, Region
from afspm.model.snapshot import restored, snapshot
from afspm.simulation.activities import RETRACE, Move, Occupied, ScanActivity, SpectrumActivity, noise_in_air
from afspm.simulation.feedback import FeedbackSettings
from afspm.simulation.ledger import DamageCounter, DamageLedger, Note, ScannedPlace
from afspm.simulation.measuring import Adjustment
from afspm.simulation.scan_drawing import FARTHEST_M, RunWork, ScanDrawing, run_at_once
from afspm.simulation.spectra import AS_SET, SweptCurve
from afspm.simulation.world import World

Doing = ScanActivity | SpectrumActivity | Occupied
_MOST_AVERAGED = 32  # more sweeps reduce the noise no further
_PRESSED_M_PER_S = 10e-9  # by a ramp or a feedback, of a tip that meets the sample
_FASTEST_DRIFT_M_S = 1e-6
_APPROACH_M_PER_S = 1e-6
_STEP_SPREAD = 0.3  # of a step of the motor, relative: no two go equally far
_FALSELY_M = 5e-6
_REACH_M = 1e-6  # of the z piezo, beyond the height at which the motor has left the tip
_RUN_OUT_M = 2e-6  # how far a lateral step may lift the sample towards the tip; simulated, without a source
_STRUCK_M, _STRUCK_M_PER_S = 50e-9, 1e-6  # a tip that the motor drives into the sample
_FEW = (2, 2)  # pixels: enough to find the channels
_STATE_VERSION = 2


class InstrumentBusy(AfspmError):
    """The error that another activity is running: wait for its end, or stop that activity first."""

    code = "instrument-busy"


class InstrumentSetup:
    """The present settings of the instrument.

    Attributes:
        region, shape: frame of the next scan, and its (rows, columns).
        line_s: seconds of trace and retrace together.
        upwards: True if the next scan begins with the smallest y.
        bias_v: bias of the sample relative to the tip, everywhere in the simulation: at positive bias, electrons
            tunnel into empty states of the sample.
        slope: tilt compensation (dz/dx, dz/dy), without unit.
        move_speed_m_s: speed of the probe outside of scans.
        approach_s: duration of an approach or a withdrawal.
        reach_m: largest distance of the tip from the scanner's centre in a scan, in x and y; None: unlimited.
    """

    def __init__(self, feedback: FeedbackSettings) -> None:
        self.region = Region((0.0, 0.0), (1e-6, 1e-6))
        self.shape = (128, 128)
        self.line_s = 1.0
        self.upwards = True
        self.feedback = Feedback(
            feedback.on, feedback.proportional_gain, feedback.integral_gain, feedback.first_setpoint
        )
        self.bias_v = 0.1
        self.slope = (0.0, 0.0)
        self.move_speed_m_s = 5e-6
        self.approach_s = 1.0
        self.reach_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class InstrumentState:
    """The saved state of an instrument, except its world and its `setup`; at most one activity is set."""

    engaged: bool
    probe_m: tuple[float, float]
    spectra: int
    last_scan: int
    scan: ScanActivity | None
    spectrum: SpectrumActivity | None
    move: Move | None
    occupied: Occupied | None
    ledger: DamageLedger
    scanned: list[ScannedPlace]
    held_until_s: float | None = None
    coarse_m: float = 0.0
    lands_s: float | None = None
    lifts_s: float | None = None


class SimulatedInstrument:
    """A simulated instrument with one activity at a time. Not thread-safe.

    Args:
        world_settings: `surface`, `tip`, `drift` … of the simulated world, as in `World.from_settings`.
        seed: seed of all random numbers.
        start_s: the first time of any call.
        run: runs the computation of scans; by default at once.
        note: called with each event, for the ground truth.

    Attributes:
        setup: the present settings.
        drawing: the computation of scans.
        engaged: True while the tip is at the sample; otherwise all channels show noise.
        coarse_m: how far the coarse motor has moved the tip away since the last approach.
        scan, spectrum: the last started scan and spectrum, also after their end; None before the first, and for a
            stopped spectrum.
        world: the physics, with its ground truth (`world.truth`).
        damage: the count of the damage so far.
        coarse_step_s: duration of a step of the coarse motor.
    """

    coarse_step_s: ClassVar[float] = 1e-3

    def __init__(
        self,
        world_settings: PlainMapping,
        seed: int,
        start_s: float,
        *,
        run: RunWork = run_at_once,
        note: Note | None = None,
    ) -> None:
        self.seed = seed
        self._world_settings = world_settings
        self.world = World.from_settings(world_settings, seed, start_s)
        self.setup = InstrumentSetup(self.world.settings.feedback)
        self.drawing = ScanDrawing(self.world, lambda: self.channels, seed, run)
        self.engaged = True
        self.coarse_m = 0.0
        self._lands_s: float | None = None
        self._lifts_s: float | None = None
        self.scan: ScanActivity | None = None
        self.spectrum: SpectrumActivity | None = None
        self._doing: Doing | None = None
        self._probe_m = (0.0, 0.0)
        self._counts = {"scan": 0, "spectrum": 0}
        self._noise = np.random.default_rng((seed, 3))
        self._signals: Mapping[str, float] = {}
        self._held_until_s = -math.inf
        self._measured: ScanActivity | SpectrumActivity | None = None
        self._conditions: Plain = {}
        self._note = note
        self.damage = DamageCounter(self.world, start_s, note)

    # -- what goes on

    @cached_property
    def channels(self) -> Mapping[str, str]:
        """The channels of every scan with their units, determined by a scan of a few pixels in a new world."""
        few = World.from_settings(self._world_settings, self.seed, 0.0)
        scan = few.scan(Region((0.0, 0.0), (1e-9, 1e-9)), _FEW, 1.0, 0.0)
        return {name: unit for name, (unit, _) in scan.channels().items()}

    def doing(self, now_s: float) -> str:
        """Return the activity: "scan", "spectrum", "move", or the name given to `occupy`; empty if free."""
        if self._lands_s is not None and now_s >= self._lands_s:
            if not self.engaged:
                self.note(self._lands_s, "landed", {"seems": self._lifts_s is not None})
            self._lands_s, self.coarse_m, self.engaged = None, 0.0, True
        if self._lifts_s is not None and now_s >= self._lifts_s:
            self._lifts_s, self.coarse_m, self.engaged = None, _FALSELY_M, False
        return self._doing.what if self._doing is not None and self._doing.running(now_s) else ""

    def busy(self, now_s: float) -> bool:
        return bool(self.doing(now_s))

    @property
    def ends_s(self) -> float | None:
        """The end of the last activity until `ended` returns it; None if free, paused or being computed."""
        doing = self._doing
        if doing is None or (isinstance(doing, ScanActivity) and (doing.paused or doing.drawing)):
            return None
        return doing.end_s

    def next_change_s(self, now_s: float) -> float | None:
        """Return the time at which the instrument becomes free, or gives the feedback back; None if that is unknown."""
        times = (self.ends_s, self._held_until_s if self.is_held(now_s) else None)
        return min((at_s for at_s in times if at_s is not None and at_s > now_s), default=None)

    def ended(self, now_s: float) -> Doing | None:
        """Return the activity that has ended since the last call; None without one."""
        doing = self._doing
        if doing is None or doing.running(now_s):
            return None
        self.account(now_s)
        self._doing = None
        return doing

    def probe_at(self, now_s: float) -> tuple[float, float]:
        """Return the position of the tip, also during a move or a scan."""
        doing = self._doing
        if isinstance(doing, ScanActivity) and doing.running(now_s):
            return doing.tip_m(now_s)
        if isinstance(doing, Move) and doing.running(now_s):
            return doing.probe_at(now_s)
        return self._probe_m

    def signals(self, now_s: float) -> Mapping[str, float]:
        """Return the present value of each forward channel with its noise; noise alone while the tip is withdrawn.

        During a retrace, a forward channel has the value of its recorded backward channel, if any. While a scan is
        being computed, the previous values are returned, if any. An invalid feedback gives noise alone at rest.
        """
        scan, place = self.scan, self.probe_at(now_s)
        if not self.engaged:
            return self._noise_alone()
        if scan is not None and scan.drawing and self._signals:
            return self._signals  # the world belongs to one thread at a time
        self.drawing.wait()
        if scan is not None and scan is self._doing and scan.running(now_s):
            self._signals = scan.signals(now_s)
        else:
            try:
                self._signals = self.world.at_rest(
                    place, now_s, self.setup.feedback, self.setup.bias_v, slope=self.setup.slope, random=self._noise
                )
            except InvalidValue:  # with an invalid feedback the tip meets no surface
                self._signals = self._noise_alone()
        spike_a = self.world.settings.scanner.coarse_spike_a
        if any(spike_a) and self.doing(now_s) in ("approach", "stage"):
            # of the motor's steps: how long each lasts is not known, so every reading has one
            self._signals = {**self._signals, "Current": self._signals["Current"] + self._noise.uniform(*spike_a)}
        return self._signals

    def _noise_alone(self) -> dict[str, float]:
        kinds = {name: unit for name, unit in self.channels.items() if not name.endswith(RETRACE)}
        return {name: float(noise_in_air(self._noise, (), unit)) for name, unit in kinds.items()}

    @property
    def probe_m(self) -> tuple[float, float]:
        """The target (x, y) of the last move: the position of spectra, pulses and crashes."""
        return self._probe_m

    # -- scans

    def start_scan(self, now_s: float) -> ScanActivity:
        """Start a scan of the frame.

        Raises:
            InstrumentBusy. InvalidValue: the setup allows no scan.
        """
        self._check_free(now_s)
        setup = self.setup
        number = self._counts["scan"] + 1
        in_force, *later = self._adjustments(now_s)
        if later:
            self._remember(now_s)
        scan = ScanActivity(
            number,
            setup.region,
            setup.shape,
            now_s,
            setup.line_s,
            setup.upwards,
            in_force.feedback,
            setup.bias_v,
            setup.slope,
            tuple(later),
            setup.reach_m,
        )
        draw = self.drawing.prepared(scan, engaged=self.engaged)
        changes = self._change_tip_in(scan)
        self.drawing.keep_world()
        self._counts["scan"] = number
        self.note(now_s, "scan starts", {"number": number, "setup": _setup_of(scan), "changes_in_scan": changes})
        self.scan = self._doing = self._measured = scan
        if self.engaged:
            self.damage.scan_starts(scan, now_s)
        self.drawing.start(scan, draw)
        return scan

    def stop_scan(self, now_s: float) -> None:
        """Interrupt a running scan; its lines remain available from `scan`."""
        if self.scan is not None and self.scan is self._doing and self.scan.running(now_s):
            self.scan.stop(now_s)
            self.note(now_s, "scan stopped", {})
            self.account(now_s)

    def adjust(self, now_s: float) -> None:
        """Apply the present feedback settings and bias to the running scan."""
        if self._scans and self.scan is not None and self.scan.running(now_s):
            self.drawing.wait()
            self.drawing.rewind()
            before = (one for one in self.scan.adjusted if one.t_s <= now_s)
            self._redraw((*before, *self._adjustments(now_s)))

    def change_tip(self, condition: str, now_s: float) -> None:
        """Change the tip, also during a scan: "sharp", "blunt", "double" or "contaminated"."""
        self.drawing.wait()
        self.world.change_tip(condition, now_s)
        self.note(now_s, "tip changed on demand", {"condition": condition})
        if self._scans and self.scan is not None and self.scan.running(now_s):
            self.drawing.rewind()
            self._redraw(self.scan.adjusted)

    def _change_tip_in(self, scan: ScanActivity) -> list[tuple[float, str]]:
        changes = [
            (scan.start_s + (at - scan.number) * (scan.end_s - scan.start_s), condition)
            for at, condition in self.world.settings.tip_changes.in_scans
            if int(at) == scan.number
        ]
        for t_s, condition in changes:
            self.world.change_tip(condition, t_s)
        return changes

    @property
    def _scans(self) -> bool:
        return self.scan is not None and self.scan is self._doing and self.scan.stopped_s is None

    def _redraw(self, adjusted: tuple[Adjustment, ...]) -> None:
        assert self.scan is not None
        self.drawing.keep_world()
        self.scan.redrawn(adjusted)
        self.drawing.start(self.scan, self.drawing.prepared(self.scan, engaged=self.engaged))

    # -- spectra

    def start_spectrum(self, kind: str, now_s: float, sweeps: int = 1, curve: SweptCurve = AS_SET) -> SpectrumActivity:
        """Start a curve of a kind ("IV", "force") at the probe's position, the mean of `sweeps` (at most 32 computed).

        Raises:
            InstrumentBusy. InvalidValue: an unknown kind.
        """
        self._check_free(now_s)
        taken = [
            self.world.spectrum(kind, self._probe_m, now_s, self.setup.feedback, self.setup.bias_v, curve)
            for _ in range(max(1, min(sweeps, _MOST_AVERAGED)))
        ]
        names, units, _ = taken[0]
        values = np.mean([values for _, _, values in taken], axis=0)
        self._counts["spectrum"] = number = self._counts["spectrum"] + 1
        if not self.engaged:
            random = np.random.default_rng((self.seed, 2, number))
            for column, unit in list(enumerate(units))[1:]:  # the first column is the sweep
                values[:, column] = noise_in_air(random, values.shape[:1], unit)
        end_s = now_s + sweeps * self.world.spectrum_s(kind, curve)
        self.spectrum = SpectrumActivity(number, kind, self._probe_m, now_s, end_s, names, units, values)
        self._doing = self._measured = self.spectrum
        if self.engaged:
            self._held_until_s = end_s + self._hold_s
        self.damage.spectrum_starts(self.spectrum if self.engaged else None)
        facts = {"number": number, "kind": kind, "position_m": self._probe_m, "bias_v": self.setup.bias_v}
        self.note(now_s, "spectrum starts", {**facts, **self.world.property_truth(self._probe_m, now_s)})
        self.note_changes(now_s)
        return self.spectrum

    def stop_spectrum(self, now_s: float) -> None:
        """Interrupt and discard a running spectrum."""
        if isinstance(self._doing, SpectrumActivity) and self._doing.running(now_s):
            self.note_changes(now_s)
            self._measured = replace(self._doing, end_s=now_s)
            self._doing = self.spectrum = None
            self._held_until_s = min(self._held_until_s, now_s + self._hold_s)
            self.damage.spectrum_starts(None)
            self.note(now_s, "spectrum stopped", {})
            self.note_changes(now_s)

    # -- moves

    def move_probe(
        self,
        xy_m: tuple[float, float],
        now_s: float,
        *,
        way_m: float = 0.0,
        frame_m: tuple[float, float] | None = None,
    ) -> None:
        """Move the tip at the move speed. A call during a move changes its target.

        Args:
            way_m: path length of a frame that moves at the same time.
            frame_m: centre of that frame, where the scanner goes.

        Raises:
            InstrumentBusy: during another activity. InvalidValue: the position is farther than any scanner reaches.
        """
        if not all(abs(along_m) <= FARTHEST_M for along_m in xy_m):
            raise InvalidValue(f"the position of the probe: {xy_m} m", hint=f"at most {FARTHEST_M:g} m")
        if self.doing(now_s) != "move":
            self._check_free(now_s)
        from_m, self._probe_m = self.probe_at(now_s), (float(xy_m[0]), float(xy_m[1]))
        end_s = now_s + max(math.dist(from_m, self._probe_m), way_m) / self.setup.move_speed_m_s
        self._doing = Move("move", now_s, end_s, from_m, self._probe_m)
        self.world.move_to(self._probe_m if frame_m is None else frame_m, end_s)

    def stop_move(self, now_s: float) -> None:
        """Stop the tip at its present position."""
        if self.doing(now_s) == "move":
            self._probe_m, self._doing = self.probe_at(now_s), None

    def shift_sample(self, by_m: tuple[float, float], lasts_s: float, now_s: float) -> None:
        """Move the sample with the coarse stage, which shifts the tip by `by_m` (x, y) on the sample.

        Raises:
            InstrumentBusy. InvalidValue: distance or duration is not finite.
        """
        _finite("the way of the stage", *by_m)
        self._check_free(now_s)
        if self.engaged:
            self._strike(now_s)
        self.occupy("stage", lasts_s, now_s)
        if lasts_s > 0.0:
            self.world.compensate((by_m[0] / lasts_s, by_m[1] / lasts_s), now_s)
            self.world.compensate((0.0, 0.0), now_s + lasts_s)

    def step(self, direction: tuple[int, int, int], steps: int, step_m: float, now_s: float) -> None:
        """Let the coarse motor go steps, along the sample or, with a positive z, away from it.

        A lateral step lifts the sample on its way, so that a tip that its piezo alone has withdrawn is struck.

        Raises:
            InstrumentBusy.
        """
        self._check_free(now_s)
        self.note(now_s, "coarse", {"direction": direction, "steps": steps, "away_m": self.coarse_m})
        way_m = step_m * steps * (1.0 + _STEP_SPREAD * float(self._noise.normal()) / math.sqrt(max(steps, 1)))
        x, y, z = direction
        if z:
            if self.coarse_m + z * way_m < 0.0:
                self._strike(now_s)
            self.coarse_m = max(0.0, self.coarse_m + z * way_m)
            self.engaged = self.engaged and self.coarse_m <= _REACH_M  # the feedback follows as far as it reaches
            self.occupy("stage", steps * self.coarse_step_s, now_s)
            return
        if not self.engaged and self.coarse_m < _RUN_OUT_M:
            self._strike(now_s)
        self.shift_sample((x * way_m, y * way_m), steps * self.coarse_step_s, now_s)

    def _strike(self, now_s: float) -> None:
        self._add_damage(now_s, "stage", replace(self.ledger, stage_moves=self.ledger.stage_moves + 1))
        self._crashed(_STRUCK_M, _STRUCK_M_PER_S, now_s, self._probe_m)

    def follow(self, velocity_m_per_s: tuple[float, float], now_s: float) -> None:
        """Set the velocity (x, y) at which the scanner follows the sample from now on, also during a scan.

        Raises:
            InvalidValue: the velocity is above 1e-6 m/s, faster than any drift.
        """
        if not max(map(abs, velocity_m_per_s)) <= _FASTEST_DRIFT_M_S:
            raise InvalidValue(f"a drift of {velocity_m_per_s} m/s", hint=f"at most {_FASTEST_DRIFT_M_S} m/s")
        self.drawing.wait()
        if self._scans and self.scan is not None and self.scan.running(now_s):
            self.drawing.rewind()
            self.world.compensate(velocity_m_per_s, now_s)
            self._redraw(self.scan.adjusted)
        else:
            self.world.compensate(velocity_m_per_s, now_s)

    def hold(self, z_m: float, now_s: float | None = None) -> None:
        """Set z while the feedback is off; with a time, a tip that this drives into the sample crashes.

        Raises:
            InvalidValue: z is not finite.
        """
        self.drawing.wait()
        self.world.hold(z_m)
        if now_s is not None:
            self.press(now_s)

    def z_m(self, now_s: float) -> float:
        """Return z of the resting tip, as the controller sets it: without noise."""
        self.drawing.wait()
        setup = self.setup
        return self.world.z_m(self.probe_at(now_s), now_s, setup.feedback, setup.bias_v, slope=setup.slope)

    def press(self, now_s: float) -> None:
        """Let a resting tip crash that the present settings drive into the sample."""
        if not self.engaged or self.doing(now_s):
            return
        self.drawing.wait()
        setup, position_m = self.setup, self.probe_at(now_s)
        try:
            depth_m = self.world.pressed_m(position_m, now_s, setup.feedback, setup.bias_v, slope=setup.slope)
        except InvalidValue:  # with an invalid feedback the tip meets no surface
            return
        if depth_m > 0.0:
            self._crashed(depth_m, _PRESSED_M_PER_S, now_s, position_m)

    def switch_feedback(self, now_s: float, *, on: bool) -> None:
        """Switch the feedback on or off, and count the time up to now in the ledger.

        Off, the tip stays at its z, and setpoint and bias of this moment stay those of this z.
        """
        self.account(now_s)
        if not on and self.setup.feedback.on is not False and self.engaged and self.doing(now_s) != "scan":
            self.drawing.wait()
            self._remember(now_s)
        self.setup.feedback = replace(self.setup.feedback, on=on)
        self.note_changes(now_s)
        self.press(now_s)

    def is_held(self, now_s: float) -> bool:
        """Return whether the controller holds the feedback, in a spectrum or after it, and will give it back."""
        return self.engaged and bool(self.setup.feedback.on) and now_s < self._held_until_s

    def feedback_reads(self, now_s: float) -> bool:
        """Return what the controller's switch of the feedback reads."""
        is_hidden = self.is_held(now_s) and self.world.settings.feedback.hold_reads == "off"
        return bool(self.setup.feedback.on) and not is_hidden

    @property
    def _hold_s(self) -> float:
        return self.world.settings.feedback.hold_s

    def _adjustments(self, now_s: float) -> list[Adjustment]:
        # the settings in force now, and from the moment at which a held feedback is given back
        setup = self.setup
        if not self.is_held(now_s):
            return [Adjustment(now_s, setup.feedback, setup.bias_v)]
        held = replace(setup.feedback, on=False)
        return [
            Adjustment(now_s, held, setup.bias_v),
            Adjustment(self._held_until_s, setup.feedback, setup.bias_v),
        ]

    def _remember(self, now_s: float) -> None:
        setup = self.setup
        with suppress(InvalidValue):  # an invalid feedback has met no surface
            self.world.remember(self.probe_at(now_s), now_s, setup.feedback, setup.bias_v, slope=setup.slope)

    # -- the tip

    def pulse(self, voltage_v: float, duration_s: float, now_s: float) -> str:
        """Pulse the bias at the probe's position; return "cured", "worsened" or "unchanged"."""
        self._check_free(now_s)
        outcome = self.pulsed(voltage_v, duration_s, now_s)
        self.occupy("pulse", duration_s, now_s)
        return outcome

    def pulsed(self, voltage_v: float, duration_s: float, now_s: float) -> str:
        """Apply the effect of a pulse for which the caller set and restored the bias; return the outcome as `pulse`."""
        self.drawing.wait()
        if not self.engaged or duration_s <= 0.0:
            return "unchanged"
        position_m, marks = self._probe_m, len(self.world.sample.marks)
        outcome = self.world.pulse(voltage_v, duration_s, now_s, position_m)
        facts = {"voltage_v": voltage_v, "duration_s": duration_s, "position_m": position_m, "outcome": outcome}
        clearance_m = self.damage.clearance_m(position_m, now_s)
        self.note(now_s, "pulse", {**facts, "clearance_m": clearance_m})
        near, radius_m = self.damage.is_near(clearance_m), self._mark_radius_m(marks)
        ledger = self.ledger.pulsed(voltage_v, duration_s, outcome, radius_m, near=near)
        self._add_damage(now_s, "pulse", ledger)
        return outcome

    def crash(self, depth_m: float, speed_m_s: float, now_s: float) -> str:
        """Drive the tip into the sample and back at the probe's position; return the outcome as `pulse`.

        Raises:
            InstrumentBusy. InvalidValue: depth or speed is not above 0.
        """
        if not min(depth_m, speed_m_s) > 0.0:
            raise InvalidValue(f"a crash {depth_m} m deep with {speed_m_s} m/s", hint="depth and speed must be above 0")
        self._check_free(now_s)
        outcome = self._crashed(depth_m, speed_m_s, now_s, self._probe_m) if self.engaged else "unchanged"
        self.occupy("crash", 2.0 * depth_m / speed_m_s, now_s)
        return outcome

    def _crashed(self, depth_m: float, speed_m_s: float, now_s: float, position_m: tuple[float, float]) -> str:
        marks = len(self.world.sample.marks)
        outcome = self.world.crash(position_m, depth_m, speed_m_s, now_s)
        facts = {"position_m": position_m, "speed_m_per_s": speed_m_s, "depth_m": depth_m, "outcome": outcome}
        clearance_m = self.damage.clearance_m(position_m, now_s)
        self.note(now_s, "crash", {**facts, "clearance_m": clearance_m})
        near, radius_m = self.damage.is_near(clearance_m), self._mark_radius_m(marks)
        ledger = self.ledger.crashed(depth_m, outcome, radius_m, near=near)
        self._add_damage(now_s, "crash", ledger)
        return outcome

    def engage(self, now_s: float) -> None:
        """Bring the tip to the sample by its piezo; `engaged` is True from the start, if the sample is in reach."""
        self._check_free(now_s)
        self.reach()
        self.note_changes(now_s)
        self.occupy("approach", self.setup.approach_s, now_s)

    def reach(self) -> None:
        """Let the piezo bring the tip to the sample, unless the motor has moved it out of reach."""
        self.engaged = self.coarse_m <= _REACH_M

    def approach(self, now_s: float, seems_s: float | None = None) -> None:
        """Bring the tip to the sample with the coarse motor; `engaged` is True from the end.

        Args:
            seems_s: how long the tip seems to be at the sample, though it is not; None: it is.
        """
        lasts_s = self.setup.approach_s + self.coarse_m / _APPROACH_M_PER_S
        self.occupy("approach", lasts_s, now_s)
        self.engaged = self.engaged and self._lifts_s is None  # a false landing ends with the next approach
        self._lands_s = now_s + lasts_s
        self._lifts_s = None if seems_s is None else self._lands_s + seems_s

    def approaches(self, now_s: float) -> bool:
        """Return whether the coarse motor brings the tip to the sample."""
        return self.doing(now_s) == "approach" and self._lands_s is not None

    def withdraw(self, now_s: float) -> None:
        """Stop the activity and withdraw the tip."""
        self.stop_scan(now_s)
        self.stop_spectrum(now_s)
        self.account(now_s)
        if self.approaches(now_s) and self._lands_s is not None:
            self.coarse_m = min(self.coarse_m, max(0.0, self._lands_s - now_s) * _APPROACH_M_PER_S)
        self._lands_s = self._lifts_s = None
        self._doing, self.engaged, self._held_until_s = None, False, min(self._held_until_s, now_s)
        self.note_changes(now_s)
        self.occupy("approach", self.setup.approach_s, now_s)

    # -- anything else

    def occupy(self, what: str, lasts_s: float, now_s: float) -> None:
        """Start another activity of this duration. Raises InstrumentBusy, InvalidValue."""
        _finite("the duration", lasts_s)
        self._check_free(now_s)
        self._doing = Occupied(what, now_s, now_s + lasts_s)

    def stop(self, what: str, now_s: float) -> None:
        """End an activity started by `occupy`."""
        if self.doing(now_s) == what:
            self._doing = None

    def abandon(self, now_s: float) -> None:
        """Drop the activity; complete lines of a scan remain."""
        self.stop_scan(now_s)
        self.stop_spectrum(now_s)
        self._doing = None

    # -- the damage

    def account(self, now_s: float) -> None:
        """Add to the ledger the time since the last call, and the measurement if it has ended.

        Call this method before a change of `setup.feedback` or `engaged`: the elapsed time counts with the old values.
        Also note the changes since the last call.
        """
        self.damage.account(now_s, feedback_off=self._is_feedback_off)
        self.note_changes(now_s)

    @property
    def ledger(self) -> DamageLedger:
        """The damage so far, counted up to the last call."""
        return self.damage.ledger

    @property
    def _is_feedback_off(self) -> bool:
        # a feedback that the controller itself holds is no danger
        return self.engaged and self.setup.feedback.on is False

    def _add_damage(self, now_s: float, cause: str, ledger: DamageLedger) -> None:
        self.damage.add(now_s, cause, ledger, feedback_off=self._is_feedback_off)

    def _mark_radius_m(self, marks_before: int) -> float:
        marks = self.world.sample.marks
        return marks[-1].radius_m if len(marks) > marks_before else 0.0

    # -- after a kill

    def state(self) -> Plain:
        """Return the state for `restore`, JSON-able; during a scan with the state of the world at its start."""
        doing = self._doing
        world = self.drawing.world_before if self._scans or self.drawing.goes_on else self.world.state()
        state = InstrumentState(
            engaged=self.engaged,
            probe_m=self._probe_m,
            spectra=self._counts["spectrum"],
            last_scan=self._counts["scan"],
            scan=self.scan if self._scans else None,
            spectrum=doing if isinstance(doing, SpectrumActivity) else None,
            move=doing if isinstance(doing, Move) else None,
            occupied=doing if isinstance(doing, Occupied) and not isinstance(doing, Move) else None,
            ledger=self.ledger,
            scanned=self.damage.scanned,
            held_until_s=self._held_until_s if math.isfinite(self._held_until_s) else None,
            coarse_m=self.coarse_m,
            lands_s=self._lands_s,
            lifts_s=self._lifts_s,
        )
        return {"world": world, "instrument": snapshot(state, "instrument", _STATE_VERSION, lists=True)}

    def restore(self, kept: PlainMapping) -> None:
        """Restore the instrument from `state`; the caller restores the settings in `setup`.

        Raises:
            InvalidValue: a state of another world or version, or a damaged state.
        """
        found = restored(InstrumentState, kept["instrument"], "instrument", _STATE_VERSION)
        self.world.restore(kept["world"])
        self.engaged, self._probe_m = found.engaged, found.probe_m
        self.coarse_m, self._lands_s, self._lifts_s = found.coarse_m, found.lands_s, found.lifts_s
        self._counts = {"scan": found.last_scan, "spectrum": found.spectra}
        self.scan, self.spectrum = found.scan, found.spectrum
        self._held_until_s = -math.inf if found.held_until_s is None else found.held_until_s
        self._doing = found.scan or found.spectrum or found.move or found.occupied
        self._measured = found.scan or found.spectrum
        self.damage.restore(found.ledger, found.scanned, (found.scan or found.spectrum) if found.engaged else None)
        # the values are not saved: the world at the start of the scan gives the same values again
        if self.scan is not None:
            self._change_tip_in(self.scan)
            self._redraw(self.scan.adjusted)

    def count_on(self, *, scans: int, spectra: int) -> None:
        """Let the numbers of coming scans and spectra be higher than these."""
        self._counts = {"scan": max(scans, self._counts["scan"]), "spectrum": max(spectra, self._counts["spectrum"])}

    # -- inside

    def note(self, time_s: float, event: str, facts: Mapping[str, object]) -> None:
        """Record an event; add the ground truth unless the computation of a scan is using the world."""
        if self._note is not None:
            truth = {} if self.drawing.goes_on else {"truth": self.world.truth(time_s)}
            self._note(time_s, event, {**facts, **truth})

    def note_changes(self, now_s: float) -> None:
        """Record the end of the measurement, and conditions that have changed since the last call.

        The conditions of a measurement are in the last line before its start, and in all lines until its end. These
        lines are many, and so without the ground truth.
        """
        if self._note is None:
            return
        lines: list[tuple[float, str, Plain]] = []
        measured, before = self._measured, self._conditions
        if measured is not None and not measured.running(now_s):
            self._measured = None
            lines.append((measured.end_s, f"{measured.what} ends", self._end_of(measured)))
        if before.get("held") and self._held_until_s <= now_s:
            before = {**before, "held": False}
            lines.append((self._held_until_s, "conditions", before))
        self._conditions = {
            "engaged": self.engaged,
            "held": self.is_held(now_s),
            "feedback": asdict(self.setup.feedback),
            "bias_v": self.setup.bias_v,
        }
        if self._conditions != before:
            lines.append((now_s, "conditions", self._conditions))
        for line in sorted(lines, key=lambda line: line[0]):
            self._note(*line)

    def _end_of(self, measured: ScanActivity | SpectrumActivity) -> Plain:
        if isinstance(measured, SpectrumActivity):
            return {"number": measured.number, "stopped": self.spectrum is None}
        lines = measured.lines_done(measured.end_s)
        return {"number": measured.number, "stopped": measured.stopped_s is not None, "lines": lines}

    def _check_free(self, now_s: float) -> None:
        doing = self.doing(now_s)
        if doing:
            raise busy_with(doing)
        # a stopped scan may still be computed, and only one thread at a time may use the world
        self.drawing.wait()
        self.account(now_s)


def busy_with(doing: str) -> InstrumentBusy:
    """Return the error for a request during an activity, such as a scan or an approach."""
    return InstrumentBusy(f"the instrument is busy with {'an' if doing[0] in 'aeiou' else 'a'} {doing}")


def _setup_of(scan: ScanActivity) -> Plain:
    # everything that the true values of a scan depend on, beside the world
    return {
        "center_m": scan.region.center_m,
        "size_m": scan.region.size_m,
        "angle_rad": scan.region.angle_rad,
        "shape": scan.shape,
        "line_s": scan.line_s,
        "upwards": scan.upwards,
        "feedback": asdict(scan.feedback),
        "bias_v": scan.bias_v,
        "slope": scan.slope,
        "reach_m": scan.reach_m,
    }


def _finite(what: str, *values: float) -> None:
    if not all(map(math.isfinite, values)):
        raise InvalidValue(f"{what}: {', '.join(map(str, values))}", hint="must be finite")
