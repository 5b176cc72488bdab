"""The simulated world: a sample, a tip and an instrument, in experiment time.

`World` keeps the state between measurements: the tip and its history, marks on the sample, the position of the tip. A
measurement is called with its time, and revokes predictions beyond that time (tip changes and wear in the rest of a
stopped scan). The same seed and the same calls give the same world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from afspm.basics.errors import ConfigError, ErrorCollector, InvalidValue
from afspm.model import Feedback, Region
from afspm.model.arrays import Array
from afspm.model.snapshot import restored, snapshot
from afspm.simulation import chance, spectra
from afspm.simulation.drift import DriftSettings, ScannerCompensation
from afspm.simulation.feedback import FeedbackSettings, Loop
from afspm.simulation.measuring import (
    Adjustment,
    Felt,
    Held,
    Setup,
    SignalSettings,
    TipTimes,
    at_rest,
    attraction_hz,
    current_a,
    feel,
    measure,
    rest_z_m,
)
from afspm.simulation.noise import NoiseSettings
from afspm.simulation.property_map import PropertyMap, PropertyMapSettings
from afspm.simulation.sample import Sample, SurfaceMark
from afspm.simulation.scanning import Course, ScannerPlace, ScannerSettings, SimulatedScan
from afspm.simulation.settings import build, nearest, one_of
from afspm.simulation.surfaces import surface_from
from afspm.simulation.tip import (
    CONDITIONS,
    SimulatedTip,
    TipChange,
    TipChangeSettings,
    TipSettings,
    TipShape,
    indented_m,
)

# Defaults for a kind of sample; the user's settings override them.
_FITTING: dict[str, dict[str, dict[str, object]]] = {
    # Atoms are imaged by the foremost atom of the tip, not by its whole apex.
    "lattice": {
        "tip": {"radius_m": 0.12e-9, "half_angle_deg": 35.0},
        "noise": {"white_m": 3e-12, "one_over_f_m": 3e-12, "line_offset_m": 3e-12, "scar_m": 0.05e-9},
        "feedback": {"mode": "current"},
    },
    "steps": {"tip": {"second_below_radii": 0.015, "debris_radii": 1.0, "length_jump_radii": 0.1}},
    "stamper": {
        # Only a large flaw of the tip is visible on bumps of this size.
        "tip": {"blunt_radii": 18.0, "second_distance_radii": 30.0, "second_below_radii": 2.0, "debris_radii": 4.0},
        "noise": {"white_m": 0.3e-9, "one_over_f_m": 0.5e-9, "line_offset_m": 0.5e-9, "scar_m": 8e-9},
    },
    "particles": {"noise": {"white_m": 0.2e-9, "one_over_f_m": 0.2e-9, "line_offset_m": 0.2e-9, "scar_m": 4e-9}},
}


# Scanners by name: statistics of real instruments, as their owners publish them. Not measured by afspm.
# "stm-4k": HamsterPark/STM-Bench, profile reference-stm (an STM at 4 K): drift and creep from 983 pairs of scans,
# the current from 168 pokes of the tip, the edge from 72 frames, the retrace from 39. Our readings: an edge of 1.2 px
# is the distance of 10 and 90 % of a step; z falls from 94 to 26 pm in 13 s after a typical move, of 220 nm.
SCANNERS: Mapping[str, Mapping[str, Mapping[str, object]]] = {
    "stm-4k": {
        "scanner": {
            "band_limit_px": 0.47,
            "creep_share": 0.05,
            "creep_time_s": 500.0,
            "settling_share": 94e-12 / 220e-9,
            "settling_s": 10.1,
            "retrace_offset": (0.0098, 0.0137, 0.0117),
            "miscalibration": ((0.07, 0.09), (0.07, 0.09), (0.12, 0.125)),
            "coarse_spike_a": (82e-12, 375e-12),
        },
        "drift": {"speed_m_per_s": 15e-12, "velocity_m_per_s": (0.0, 0.0, 1e-12)},
        "signals": {"preamplifier_a": 10.004e-9},
        "iv": {"preamplifier_a": 10.004e-9, "temperature_k": 4.2},
    }
}


@dataclass(frozen=True)
class WorldSettings:
    """All settings of the world except its surface."""

    tip: TipSettings = field(default_factory=TipSettings)
    tip_changes: TipChangeSettings = field(default_factory=TipChangeSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    feedback: FeedbackSettings = field(default_factory=FeedbackSettings)
    scanner: ScannerSettings = field(default_factory=ScannerSettings)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    signals: SignalSettings = field(default_factory=SignalSettings)
    iv: spectra.IVSettings = field(default_factory=spectra.IVSettings)
    force: spectra.ForceSettings = field(default_factory=spectra.ForceSettings)
    z: spectra.ZSettings = field(default_factory=spectra.ZSettings)
    property_map: PropertyMapSettings = field(default_factory=PropertyMapSettings)

    def of_curves(self, kind: str) -> spectra.IVSettings | spectra.ZSettings | spectra.ForceSettings:
        """Return the settings of a kind of curve."""
        return self.iv if kind == "IV" else self.z if kind == "z" else self.force


def read_settings(settings: Mapping[str, object]) -> tuple[object, WorldSettings]:
    """Split a table into the surface's table and the other settings, and check the other settings.

    The surface is checked here only together with other errors; otherwise `World` checks it.

    Raises:
        ConfigError: unknown names or invalid values, of all tables at once.
    """
    tables = dict(settings)
    names = ["surface", *WorldSettings.__dataclass_fields__]
    errors = ErrorCollector()
    for name in [name for name in tables if name not in names]:
        errors.add(ConfigError(f"no setting named {name!r}", where=f"simulation.{name}", hint=nearest(name, names)))
        del tables[name]
    surface = tables.pop("surface", "steps")
    kind = surface.get("kind", "steps") if isinstance(surface, Mapping) else surface
    for fitting in (_FITTING.get(str(kind), {}), _named_scanner(tables, errors)):
        for name, settings_of_it in fitting.items():
            own = tables.get(name, {})
            tables[name] = {**settings_of_it, **own} if isinstance(own, Mapping) else own
    with errors:
        built = build(WorldSettings, tables, "simulation")
    if errors.errors:
        with errors:  # built here only to report its errors together with the others
            surface_from(surface)
    errors.raise_all()
    return surface, built


def _named_scanner(tables: dict[str, object], errors: ErrorCollector) -> Mapping[str, Mapping[str, object]]:
    # the tables of a scanner's name, which is taken out of the tables
    scanner = tables.get("scanner", {})
    table = {"like": scanner} if isinstance(scanner, str) else dict(scanner) if isinstance(scanner, Mapping) else {}
    name = table.pop("like", None)
    if name is None:
        return {}
    tables["scanner"] = table
    with errors:
        one_of(str(name), SCANNERS, "simulation.scanner.like")
    return SCANNERS.get(str(name), {})


STATE_VERSION = 4
_POINT_M = 1e-12
_DRIVEN_IN_M = 1e-9
_SAME_PLACE_M = 20e-12
_FIRST_BIAS_V = 0.1


@dataclass(frozen=True)
class WorldState:
    """The saved state of a world; a restored world continues with the same values."""

    seed: int
    start_s: float
    calls: int
    scheduled_until_s: float
    at_m: tuple[float, float]
    came_from_m: tuple[float, float]
    came_s: float
    moves: list[tuple[float, float, float]]
    held: Held
    tips: list[TipChange]
    marks: list[SurfaceMark]
    compensation: list[tuple[float, float, float, float, float]]


class World:
    """The simulated world. Times are experiment seconds; positions are tip coordinates unless named "sample"."""

    def __init__(
        self, surface: object = "steps", settings: WorldSettings | None = None, *, seed: int = 0, start_s: float = 0.0
    ) -> None:
        self.settings = settings or WorldSettings()
        self.seed, self.start_s = seed, start_s
        self.sample = Sample(surface, self.settings.drift, seed, start_s)
        self.property_map = PropertyMap(self.settings.property_map, seed)
        self._tip = SimulatedTip(self.settings.tip, self.settings.tip_changes, seed, start_s)
        self._calls = 0
        self._place = ScannerPlace(self.settings.scanner, start_s)
        self._scales = self.settings.scanner.scales(seed)
        self._held = Held(None, self.settings.feedback.first_setpoint, _FIRST_BIAS_V)
        self._felt_at_rest: tuple[object, Felt] | None = None

    @classmethod
    def from_settings(cls, settings: Mapping[str, object], seed: int, start_s: float) -> World:
        """Create a world from a table: `surface`, and the fields of `WorldSettings`.

        Raises:
            ConfigError: unknown names or invalid values. FileError: the surface's file.
        """
        surface, built = read_settings(settings)
        return cls(surface, built, seed=seed, start_s=start_s)

    def scan(
        self,
        region: Region,
        shape: tuple[int, int],
        line_s: float,
        start_s: float,
        feedback: Feedback | None = None,
        bias_v: float = 0.1,
        *,
        direction: str = "up",
        slope: tuple[float, float] = (0.0, 0.0),
        adjusted: Sequence[Adjustment] = (),
        reach_m: tuple[float, float] | None = None,
    ) -> SimulatedScan:
        """Scan a region, from `start_s` on.

        Args:
            region: in tip coordinates.
            shape: (ny, nx).
            line_s: duration of trace and retrace together.
            feedback: its fields override the settings.
            direction: direction of the slow axis, "up" (small y first) or "down".
            slope: compensation of the sample's tilt, (x, y) in m/m.
            adjusted: changes during the scan, each in force from the next line on.
            reach_m: largest distance of the tip from the scanner's centre, in x and y; None: unlimited.

        Raises:
            InvalidValue: an impossible scan, or invalid feedback.
        """
        course = Course(region, shape, line_s, start_s, direction, reach_m)
        loop = Loop.of(self.settings.feedback, feedback)
        if not all(map(math.isfinite, (bias_v, *slope))):
            raise InvalidValue(f"bias {bias_v} V and slope {slope} must be finite")
        call = self._begin(start_s, region.center_m)
        self._tip.foresee(course, loop, call)
        tips = [(start_s, self._tip.at(start_s))]
        tips += [(change.t_s, change.tip) for change in self._tip.between(start_s, course.end_s)]
        setup = self._setup(loop, bias_v, slope, start_s)
        measured = measure(course, tips, setup, chance.generator(self.seed, 2, call))
        # the whole scan is computed with each adjustment and the same noise; then its lines are taken over
        self._hold_conditions(loop, bias_v)
        for one in adjusted:
            rows = course.row_times_s(0.0) >= one.t_s
            if lines := len(rows) - int(np.count_nonzero(rows)):
                self._held = replace(self._held, z_m=float(measured.ends_z_m[lines - 1]))
            loop = Loop.of(self.settings.feedback, one.feedback)
            setup = self._setup(loop, one.bias_v, slope, start_s)
            anew = measure(course, tips, setup, chance.generator(self.seed, 2, call))
            measured = measured.continued(anew, rows, lines)
            self._hold_conditions(loop, one.bias_v)
        self._held = replace(self._held, z_m=float(measured.ends_z_m[-1]))
        self._tip.wear(course, loop)
        drift = self.sample.drift.at(course.row_times_s(0.25))
        truth = {
            **_truth_of_scan(self.sample, course, tips),
            "under_start_m": self.under(region.center_m, start_s),
            "under_end_m": self.under(region.center_m, course.end_s),
            "pressed_m": measured.pressed_m,
            "saturated": self.saturated(measured.channels["Current"][1]),
        }
        return SimulatedScan(course, drift, truth, measured.channels)

    def at_rest(
        self,
        position_m: tuple[float, float],
        t_s: float,
        feedback: Feedback | None = None,
        bias_v: float = 0.1,
        *,
        slope: tuple[float, float] = (0.0, 0.0),
        random: np.random.Generator,
    ) -> dict[str, float]:
        """Return the value of each channel while the tip stands still, without changing the world.

        With the feedback off, z is the value set by `hold`, or z when it was switched off (`remember`), or at the end
        of the last scan; before all of these and after a crash, z is the height of the surface. Setpoint and bias that
        the feedback held then define the distance of the tip from the sample.

        Args:
            random: generator for the noise, so that other measurements stay the same.

        Raises:
            InvalidValue: invalid feedback, or a value that is not finite.
        """
        if not all(map(math.isfinite, (bias_v, *slope, *position_m))):
            raise InvalidValue(f"bias {bias_v} V, slope {slope} and position {position_m} must be finite")
        loop = Loop.of(self.settings.feedback, feedback)
        setup = self._setup(loop, bias_v, slope, t_s)
        course, tip, felt = self._felt(position_m, t_s, setup)
        return at_rest(course, felt, tip, setup, random)

    def _felt(self, position_m: tuple[float, float], t_s: float, setup: Setup) -> tuple[Course, TipShape, Felt]:
        course = Course(Region(position_m, (_POINT_M, _POINT_M)), (1, 1), 1e-3, t_s)
        tip = self._tip.at(t_s)
        settling_m = float(self._place.settling_m(np.array([t_s]))[0])
        where_m = (*self.under(position_m, t_s), self.sample.seen_drift_m(t_s)[2] + settling_m)
        where = [round(at_m / _SAME_PLACE_M) for at_m in where_m]
        key = (where, tip, len(self.sample.marks))
        if self._felt_at_rest is None or self._felt_at_rest[0] != key:
            self._felt_at_rest = key, feel(course, [(t_s, tip)], setup)
        return course, tip, self._felt_at_rest[1]

    def remember(
        self,
        position_m: tuple[float, float],
        t_s: float,
        feedback: Feedback,
        bias_v: float,
        *,
        slope: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Remember z, setpoint and bias of a feedback that is switched off at a position now.

        Raises:
            InvalidValue: invalid feedback.
        """
        loop = Loop.of(self.settings.feedback, replace(feedback, on=True))
        setup = self._setup(loop, bias_v, slope, t_s)
        course, _, felt = self._felt(position_m, t_s, setup)
        self._held = Held(rest_z_m(course, felt, setup), loop.setpoint, bias_v)

    def _hold_conditions(self, loop: Loop, bias_v: float) -> None:
        if loop.on:
            self._held = replace(self._held, setpoint=loop.setpoint, bias_v=bias_v)

    def z_m(
        self,
        position_m: tuple[float, float],
        t_s: float,
        feedback: Feedback,
        bias_v: float,
        *,
        slope: tuple[float, float] = (0.0, 0.0),
    ) -> float:
        """Return z of a resting tip, as the controller sets it: without noise. Raises as `at_rest`."""
        setup = self._setup(Loop.of(self.settings.feedback, feedback), bias_v, slope, t_s)
        course, _, felt = self._felt(position_m, t_s, setup)
        return self._scales[2] * rest_z_m(course, felt, setup)

    def pressed_m(
        self,
        position_m: tuple[float, float],
        t_s: float,
        feedback: Feedback,
        bias_v: float,
        *,
        slope: tuple[float, float] = (0.0, 0.0),
    ) -> float:
        """Return how deep these settings drive a resting tip into the sample, in m; 0 or below: it does not touch.

        A feedback that needs more than the conductance of a one-atom contact for its setpoint never stops: it is
        taken to drive the tip in by 1 nm. Raises InvalidValue for an invalid feedback.
        """
        setup = self._setup(Loop.of(self.settings.feedback, feedback), bias_v, slope, t_s)
        loop, settings = setup.loop, self.settings.feedback
        if settings.mode == "current":
            away_m = loop.tunnelling_distance_m(bias_v if setup.set_bias_v is None else setup.set_bias_v)
        elif settings.mode == "frequency-shift":
            away_m = settings.sensor.distance_m(loop.setpoint) - settings.sensor.contact_m
        else:
            away_m = loop.setpoint * settings.sensitivity_m_per_v
        if loop.on:
            return 0.0 if away_m > 0.0 else _DRIVEN_IN_M
        return -(self._gap_m(position_m, t_s, setup) + away_m)

    def hold(self, z_m: float) -> None:
        """Set z while the feedback is off.

        Raises:
            InvalidValue: z is not finite.
        """
        if not math.isfinite(z_m):
            raise InvalidValue(f"z can't be held at {z_m} m")
        self._held = replace(self._held, z_m=z_m / self._scales[2])

    def move_to(self, position_m: tuple[float, float], t_s: float) -> None:
        """Move the scanner to a position that it reaches at `t_s`; its creep begins then."""
        self._place.move_to(position_m, t_s)

    def under(self, position_m: tuple[float, float], t_s: float) -> tuple[float, float]:
        """Return the sample coordinates under a position, with the scanner's creep and error of calibration."""
        return self.sample.under(self._true_m(position_m, t_s), t_s)

    def _true_m(self, position_m: tuple[float, float], t_s: float) -> tuple[float, float]:
        x, y = np.multiply(position_m, self._scales[:2]) - self._place.creep_m(np.array([t_s]))[0]
        return float(x), float(y)

    def spectrum(
        self,
        kind: str,
        position_m: tuple[float, float],
        t_s: float,
        feedback: Feedback | None = None,
        bias_v: float = 0.1,
        curve: spectra.SweptCurve = spectra.AS_SET,
    ) -> spectra.Curves:
        """Return a curve at a position: (names, units, values [n_points, n_variables]).

        Kinds are "IV", "force" and "z" (current against z). An oscillating sensor adds its frequency shift to "IV" (a
        Kelvin parabola) and "z". With the feedback off, a curve begins at the held z.

        Raises:
            InvalidValue: an unknown kind, or invalid feedback.
        """
        if kind not in spectra.KINDS:
            raise InvalidValue(f"no spectrum of kind {kind!r}", hint=nearest(kind, spectra.KINDS))
        if not all(map(math.isfinite, (bias_v, *position_m))):
            raise InvalidValue(f"bias {bias_v} V and position {position_m} must be finite")
        loop = Loop.of(self.settings.feedback, feedback)
        call = self._begin(t_s, position_m)
        tip = self._tip.at(t_s)
        x, y = self.under(position_m, t_s)
        relief = self.sample.relief(np.array([[x]]), np.array([[y]]), 0.0, t_s)
        material = float(relief.material[0, 0])
        random = chance.generator(self.seed, 3, call)
        points: dict[str, Any] = {} if curve.points is None else {"points": curve.points}
        if kind == "force":
            force = replace(self.property_map.on_force(self.settings.force, x, y), **points)
            if curve.ends is None:
                return spectra.force_distance(force, tip, material, random)
            force = replace(force, range_m=max(curve.ends))
            return spectra.force_distance(force, tip, material, random, min(curve.ends))
        setup = self._setup(loop, bias_v, (0.0, 0.0), t_s)
        loop, set_bias_v = setup.loop, bias_v if setup.set_bias_v is None else setup.set_bias_v
        gap_m = self._gap_m(position_m, t_s, setup)
        signals, noise, s = self.settings.signals, self.settings.noise, self.settings
        if kind == "IV":
            gap_m += curve.z_offset_m
            iv, material = self.property_map.on_iv(s.iv, material, x, y)
            modulation_v = iv.modulation_v if curve.modulation_v is None else curve.modulation_v
            duration_s = curve.duration_s(iv.points, iv.duration_s)
            iv = replace(iv, modulation_v=modulation_v, duration_s=duration_s, **points)
            curves = spectra.current_voltage(iv, tip, material, set_bias_v, loop, random, gap_m, curve.ends)
            from_set_m, swept_v = np.asarray(gap_m), curves[2][:, 0]
        else:
            of_material = np.asarray(material)
            curves = spectra.over_z(
                replace(s.z, **points),
                lambda z: current_a(signals, loop, gap_m + z, of_material, bias_v, setup.set_bias_v),
                noise.current_a,
                random,
                curve.ends,
            )
            from_set_m, swept_v = gap_m + curves[2][:, 0], np.asarray(bias_v)
        if not loop.settings.senses_shift:
            return curves
        contact_v = float(self._contact_v(np.asarray(material), np.asarray(x), np.asarray(y)))
        shift_hz = attraction_hz(loop, tip, setup.sharp_m, from_set_m, swept_v, set_bias_v, contact_v)
        return spectra.with_shift(curves, shift_hz, noise.frequency_hz, random)

    def _gap_m(self, position_m: tuple[float, float], t_s: float, setup: Setup) -> float:
        # of a tip that rests at a position
        if setup.loop.on or setup.held.z_m is None:
            return 0.0
        course, _, felt = self._felt(position_m, t_s, setup)
        return setup.held.z_m - rest_z_m(course, felt, replace(setup, held=replace(setup.held, z_m=None)))

    def property_truth(self, position_m: tuple[float, float], t_s: float) -> dict[str, object]:
        """Return the true value of the property map under a position, JSON-able; empty without a map."""
        if not self.property_map.is_on:
            return {}
        x, y = self.under(position_m, t_s)
        value, quantity = float(self.property_map.at(x, y)), self.property_map.quantity
        return {"property": {"quantity": quantity, "value": value, "unit": self.property_map.unit, "sample_m": [x, y]}}

    def saturated(self, current_a: Array, kind: str = "") -> float:
        """Return the fraction of values at which the preamplifier saturates, in a scan or in a kind of spectrum."""
        s = self.settings
        # the preamplifier's noise is added behind the clipping in a scan, and before it in a spectrum
        limit_a = s.iv.preamplifier_a if kind == "IV" else s.signals.preamplifier_a - 4.0 * s.noise.current_a
        return float((np.abs(current_a) >= limit_a).mean())

    def spectrum_s(self, kind: str, curve: spectra.SweptCurve = spectra.AS_SET) -> float:
        of_kind = self.settings.of_curves(kind)
        return curve.duration_s(of_kind.points, of_kind.duration_s)

    def compensate(self, velocity_m_per_s: tuple[float, float], t_s: float) -> None:
        """Set the velocity (x, y) of the scanner's own drift compensation from `t_s` on.

        Raises:
            InvalidValue: `t_s` is before the last change of velocity, or a value is not finite.
        """
        if not all(map(math.isfinite, (*velocity_m_per_s, t_s))):
            raise InvalidValue(f"a velocity of {velocity_m_per_s} m/s from {t_s} s on")
        self.sample.compensation.set(velocity_m_per_s, t_s)

    # -- treating the tip

    def change_tip(self, condition: str, t_s: float) -> None:
        """Schedule a tip change to "sharp", "blunt", "double" or "contaminated" at a time not yet passed."""
        if condition not in CONDITIONS:
            raise InvalidValue(f"a tip is not {condition!r}", hint=f"one of {', '.join(CONDITIONS)}")
        self._tip.schedule(condition, t_s)

    def pulse(
        self, voltage_v: float, duration_s: float, t_s: float, position_m: tuple[float, float] | None = None
    ) -> str:
        """Pulse the bias: a pulse may cure or worsen the tip (`tip.pulse_times`), and then leaves a small mound.

        Args:
            position_m: the position of the tip; None: the position of the last measurement.

        Returns:
            "cured", "worsened" or "unchanged".
        """
        if not (math.isfinite(voltage_v) and math.isfinite(duration_s) and duration_s > 0):
            raise InvalidValue(f"a pulse of {voltage_v} V for {duration_s} s", hint="finite, and longer than nothing")
        call = self._begin(t_s, self._place.at_m if position_m is None else position_m)
        random = chance.generator(self.seed, 4, call)
        outcome = self._tip.pulse(voltage_v, duration_s, t_s, random)
        if outcome != "unchanged":
            radius = self._tip.at(t_s).imaging_radius_m * random.uniform(0.5, 1.0)
            self.sample.mark("pulse", self._true_m(self._place.at_m, t_s), t_s, -0.3 * radius, radius)
        return outcome

    def crash(self, position_m: tuple[float, float], depth_m: float, speed_m_s: float, t_s: float) -> str:
        """Drive the tip into the sample. The crash leaves a crater, and may cure or worsen the tip.

        With even answers (`tip.TipRepairSettings`) both chances grow with the depth (`tip.crash_times`). The crater is
        shallower than the indentation (`tip.indented_m`), since a part springs back. Simulated: material is pushed
        aside within about three contact radii, as far as plastic flow reaches around an indenter.

        Args:
            depth_m: depth beyond the surface.

        Returns:
            "cured", "worsened" or "unchanged".

        Raises:
            InvalidValue: a value is not finite, depth or speed is not above zero, or the time is before the start.
        """
        if not (all(map(math.isfinite, (*position_m, depth_m, speed_m_s))) and min(depth_m, speed_m_s) > 0):
            what = f"a crash at {position_m}, {depth_m} m deep with {speed_m_s} m/s"
            raise InvalidValue(what, hint="finite, deeper and faster than nothing")
        call = self._begin(t_s, position_m)
        random = chance.generator(self.seed, 5, call)
        tip = self._tip.at(t_s)
        into_m = indented_m(tip, depth_m)
        radius = 3.0 * math.sqrt(2.0 * tip.imaging_radius_m * into_m) * random.uniform(0.8, 1.4)
        outcome = self._tip.crash(depth_m, speed_m_s, t_s, random)
        self.sample.mark("crash", self._true_m(position_m, t_s), t_s, into_m * random.uniform(0.6, 0.9), radius)
        self._held = replace(self._held, z_m=None)
        return outcome

    def drift_m(self, t_s: ArrayLike) -> Array:
        """Return the displacement (x, y, z) of the sample: x_tip = x_sample + drift. Shape t.shape + (3,).

        For a sample that rotates or expands this holds only at the fixed point; use `sample.to_sample` and
        `sample.to_tip`.
        """
        return self.sample.drift.at(t_s)

    @property
    def tip(self) -> TipShape:
        """The tip after all calls so far."""
        return self._tip.history[-1].tip

    def truth(self, t_s: float) -> dict[str, object]:
        """Return the ground truth, JSON-able: drift, tip, tip changes, marks. The ground truth is never published."""
        answers = self._tip.answers(t_s)
        return {
            **({} if answers is None else {"tip_answers": answers.truth()}),
            "t_s": t_s,
            "seed": self.seed,
            "surface": dict(self.sample.table),
            "drift_m": self.drift_m(t_s).tolist(),
            "turn": self.sample.turn(t_s),
            "compensated_m": self.sample.compensation.at(t_s).tolist(),
            **({"scales": self._scales} if self.settings.scanner.miscalibration else {}),
            **({"crept_m": (-self._place.creep_m(np.array([t_s]))[0]).tolist()} if self._place.moves else {}),
            "tip": asdict(self._tip.at(t_s)),
            "tip_changes": [asdict(change) for change in self._tip.history if change.t_s <= t_s],
            "marks": [asdict(mark) for mark in self.sample.marks if mark.t_s <= t_s],
        }

    # -- being killed and coming back

    def state(self) -> dict[str, object]:
        """Return the state for `restore`, JSON-able."""
        state = WorldState(
            seed=self.seed,
            start_s=self.start_s,
            calls=self._calls,
            scheduled_until_s=self._tip.scheduled_until_s,
            at_m=self._place.at_m,
            came_from_m=self._place.came_from_m,
            came_s=self._place.came_s,
            moves=self._place.moves,
            held=self._held,
            tips=self._tip.history,
            marks=self.sample.marks,
            compensation=self.sample.compensation.turns,
        )
        return snapshot(state, "world", STATE_VERSION)

    def restore(self, state: Mapping[str, object]) -> None:
        """Restore the world from `state`; its settings must be the same.

        Raises:
            InvalidValue: a state of another world or version, or a damaged state; then nothing has changed.
        """
        found = restored(WorldState, state, "world", STATE_VERSION)
        for name in ("seed", "start_s"):
            theirs, mine = getattr(found, name), getattr(self, name)
            if theirs != mine:
                raise InvalidValue(f"a saved state with {name} {theirs!r} instead of {mine!r}")
        self._calls, self._held = found.calls, found.held
        self._place.at_m, self._place.came_from_m, self._place.came_s = found.at_m, found.came_from_m, found.came_s
        self._place.moves = found.moves
        self._tip.history, self._tip.scheduled_until_s = found.tips, found.scheduled_until_s
        self.sample.marks, self.sample.compensation = found.marks, ScannerCompensation(found.compensation)

    # -- inside

    def _begin(self, t_s: float, position_m: tuple[float, float]) -> int:
        if not (math.isfinite(t_s) and t_s >= self.start_s - 1e-6):
            raise InvalidValue(f"the world starts at {self.start_s:g} s, nothing can be done at {t_s:g} s")
        self.sample.marks = [mark for mark in self.sample.marks if mark.t_s <= t_s]
        self._tip.begin(t_s)
        self._place.move_to(position_m, t_s)
        self._calls += 1
        return self._calls

    def _setup(self, loop: Loop, bias_v: float, slope: tuple[float, float], start_s: float) -> Setup:
        return Setup(
            sample=lambda x, y, resolution_m: self.sample.relief(x, y, resolution_m, start_s),
            drift_m=self.sample.seen_drift_m,
            turn=self.sample.drift.turn,
            unturned=self.sample.drift.unturned,
            offset_m=self._place.creep_m,
            settling_m=self._place.settling_m,
            scales=self._scales,
            scanner=self.settings.scanner,
            noise=self.settings.noise,
            signals=self.settings.signals,
            loop=loop,
            bias_v=bias_v,
            held=self._held,
            contact_v=self._contact_v,
            slope=slope,
            sharp_m=self.settings.tip.radius_m,
        )

    def _contact_v(self, material: Array, x_m: Array, y_m: Array) -> Array:
        if self.property_map.quantity == "contact_potential" and self.property_map.is_on:
            return self.property_map.at(x_m, y_m)
        low, high = self.settings.signals.contact_potential_v
        return low + (high - low) * material


def _truth_of_scan(sample: Sample, course: Course, tips: TipTimes) -> dict[str, object]:
    start_s, end_s = course.start_s, course.end_s
    return {
        "start_s": start_s,
        "end_s": end_s,
        "tips": [{"t_s": t, **asdict(tip)} for t, tip in tips],
        "drift_start_m": sample.drift.at(start_s).tolist(),
        "drift_end_m": sample.drift.at(end_s).tolist(),
        "turn_start": sample.turn(start_s),
        "turn_end": sample.turn(end_s),
        "compensated_start_m": sample.compensation.at(start_s).tolist(),
        "compensated_end_m": sample.compensation.at(end_s).tolist(),
    }
