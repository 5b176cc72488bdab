"""The z feedback: a controller with gains, an actuator with a lag, a detector that saturates.

Linearised, with error e = h - z (h the height at which the setpoint is met), a PI controller followed by a lag tau and
a delay T of the loop obeys  (tau - Kp T) z'' + (1 + Kp - Ki T) z' + Ki z = Ki h + (Kp - Ki T) h'.
Low gains follow late, high gains ring, and gains above Ki T = 1 + Kp oscillate. The detector saturates: an amplitude is
never below zero nor above the free amplitude, so z can follow a downward slope only at a limited speed: the tip
parachutes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import Feedback
from afspm.model.arrays import Array
from afspm.simulation.settings import check, one_of


@dataclass(frozen=True)
class SensorSettings:
    """The sensor of the mode "frequency-shift": the attraction of the sample shifts its resonance.

    For a sphere with van der Waals attraction, any amplitude A, and the distance d from the sample at the lower turning
    point: shift = -f H R / (6 k (d (d + 2 A))^(3/2)) (Giessibl 1997). A voltage U between tip and sample, beyond their
    contact potential, adds the attraction pi e0 R U^2 / d of a near sphere (Hudlet et al. 1998); averaged over the
    oscillation: -f pi e0 R U^2 / (k A^2) ((d + A) / sqrt(d (d + 2 A)) - 1).

    Attributes:
        resonance_hz: resonance frequency far from the sample.
        oscillation_m: amplitude, kept constant.
        radius_m: radius of the attracted apex.
        hamaker_j: Hamaker constant of the attraction.
        contact_m: distance below which the shift stays constant.
    """

    resonance_hz: float = 300e3
    spring_n_per_m: float = 40.0
    oscillation_m: float = 5e-9
    radius_m: float = 8e-9
    hamaker_j: float = 1e-19
    contact_m: float = 0.3e-9

    def __post_init__(self) -> None:
        check(self, above_zero="resonance_hz spring_n_per_m oscillation_m radius_m hamaker_j contact_m")

    def shift_hz(self, distance_m: Array | float, voltage_v: Array | float = 0.0) -> Array:
        """Return the frequency shift at distances from the sample: negative.

        Args:
            voltage_v: voltage between tip and sample, minus their contact potential.
        """
        nearest = np.maximum(distance_m, self.contact_m)
        product = nearest * (nearest + 2.0 * self.oscillation_m)
        electric = np.square(voltage_v) * self._electric_hz * ((nearest + self.oscillation_m) / np.sqrt(product) - 1.0)
        return np.asarray(-self._strength / product**1.5 - electric)

    def distance_m(self, shift_hz: float) -> float:
        """Return the distance at which the resonance shifts by `shift_hz`, a negative value, without a voltage."""
        squared = (self._strength / -shift_hz) ** (2.0 / 3.0)
        return math.sqrt(self.oscillation_m**2 + squared) - self.oscillation_m

    def charged_distance_m(self, shift_hz: float, voltage_v: Array | float) -> Array:
        """Return the distances at which the resonance shifts by `shift_hz`, a negative value, at these voltages."""
        electric = np.maximum(np.square(voltage_v) * self._electric_hz, 1e-30)
        # Between these bounds by bisection: beyond the first the attraction of van der Waals is too small alone, and
        # beyond the second each of both attractions makes less than half of the shift.
        near = np.broadcast_to(self.distance_m(shift_hz), np.shape(electric))
        ratio = 1.0 + -shift_hz / (2.0 * electric)
        far = self.oscillation_m * (ratio / np.sqrt(ratio**2 - 1.0) - 1.0)
        far = np.maximum(far, self.distance_m(shift_hz / 2.0))
        for _ in range(_BISECTIONS):
            middle = (near + far) / 2.0
            is_near = self.shift_hz(middle, voltage_v) < shift_hz
            near, far = np.where(is_near, middle, near), np.where(is_near, far, middle)
        return np.asarray((near + far) / 2.0)

    def slope_hz_per_m(self, distance_m: float) -> float:
        """Return the derivative of the frequency shift with respect to distance: positive."""
        both = distance_m + 2.0 * self.oscillation_m
        return float(1.5 * self._strength * (distance_m + both) / (distance_m * both) ** 2.5)

    @property
    def largest_hz(self) -> float:
        """The frequency shift in contact, the most negative shift."""
        return float(self.shift_hz(np.zeros(())))

    @property
    def _strength(self) -> float:
        return self.resonance_hz * self.hamaker_j * self.radius_m / (6.0 * self.spring_n_per_m)

    @property
    def _electric_hz(self) -> float:
        # for a voltage of 1 V
        force_m = math.pi * _VACUUM_F_PER_M * self.radius_m  # F d / U^2
        return self.resonance_hz * force_m / (self.spring_n_per_m * self.oscillation_m**2)


MODES = ("amplitude", "current", "frequency-shift")
_VACUUM_F_PER_M = 8.8541878128e-12
_BISECTIONS = 50
LEAST_BIAS_V = 1e-6
"""Where the feedback would need a smaller bias for the setpoint, the tip would be in contact."""
_ONE_ATOM_S = 77.48e-6  # conductance of a contact of one atom, 2 e^2 / h
_GENTLE = 0.3  # reduction of the free amplitude at a gentle setpoint
_GENTLE_M = 1e-9  # distance of a sensor at a gentle frequency shift
_GROWN = 10.0  # e-foldings in one step, after which the saturated oscillation dominates


@dataclass(frozen=True)
class FeedbackSettings:
    """The initial settings of the feedback, and the hardware of the loop.

    Attributes:
        mode: "amplitude" (tapping; the setpoint is an amplitude in V), "current" (tunnelling; in A) or
            "frequency-shift" (non-contact; in Hz, below zero).
        integral_gain: in 1/s: an error decays in about 1 / gain.
        setpoint: in the unit of the mode. Default: 0.7 V, 100 pA or half of the largest frequency shift.
        free_amplitude_v: amplitude far from the sample.
        sensitivity_m_per_v: sensitivity of the detector.
        lag_s, delay_s: lag of the actuator, delay of the loop; integral gains above about 1 / delay_s oscillate.
        range_m: range of the z actuator; the tip withdraws by half of it if the setpoint is never reached.
        decay_m: the gap over which a tunnelling current falls by a factor e.
        current_floor_a: the smallest current that the logarithmic amplifier resolves.
        qplus: True if the sensor oscillates in the mode "current" too, with a channel "Frequency Shift".
        sensor: settings of the oscillating sensor, for the mode "frequency-shift" and for `qplus`.
        hold_s: time after the reported end of a spectrum until the controller gives back the feedback that it holds in
            spectra. The controller's own time: at a clock of 100 times the speed, 0.3 s pass in 3 real ms.
        hold_reads: what the switch of a held feedback reads, "off" or "on".
    """

    mode: str = "amplitude"
    on: bool = True
    proportional_gain: float = 0.1
    integral_gain: float = 1500.0
    setpoint: float | None = None
    free_amplitude_v: float = 1.0
    sensitivity_m_per_v: float = 60e-9
    lag_s: float = 0.12e-3
    delay_s: float = 0.12e-3
    range_m: float = 5e-6
    decay_m: float = 0.05e-9
    current_floor_a: float = 0.2e-12
    qplus: bool = False
    sensor: SensorSettings = field(default_factory=SensorSettings)
    hold_s: float = 0.0
    hold_reads: str = "off"

    def __post_init__(self) -> None:
        one_of(self.mode, MODES, "mode")
        one_of(self.hold_reads, ("off", "on"), "hold_reads")
        check(self, above_zero="free_amplitude_v sensitivity_m_per_v lag_s delay_s range_m decay_m current_floor_a")
        check(self, from_zero="proportional_gain integral_gain hold_s")
        if refusal := self.refusal_of(self.first_setpoint):
            raise ConfigError(refusal, where="setpoint")

    @property
    def senses_shift(self) -> bool:
        """True if the tip oscillates on a sensor of its frequency shift."""
        return self.mode == "frequency-shift" or (self.mode == "current" and self.qplus)

    @property
    def first_setpoint(self) -> float:
        """The setpoint until another is set."""
        if self.setpoint is not None:
            return self.setpoint
        return {"amplitude": 0.7, "current": 100e-12}.get(self.mode, self.sensor.largest_hz / 2.0)

    def refusal_of(self, setpoint: float) -> str:
        """Return the reason why a setpoint is impossible in this mode; empty for a possible setpoint."""
        if self.mode != "frequency-shift":
            return "" if 0 < setpoint < math.inf else f"a setpoint is above zero, not {setpoint:g}"
        largest = self.sensor.largest_hz
        if largest < setpoint < 0:
            return ""
        return f"a frequency shift as a setpoint is between {largest:.4g} Hz and zero, not {setpoint:g}"


@dataclass(frozen=True)
class Loop:
    """The feedback in force during one scan."""

    settings: FeedbackSettings
    on: bool
    proportional_gain: float
    integral_gain: float
    setpoint: float

    @classmethod
    def of(cls, settings: FeedbackSettings, feedback: Feedback | None) -> Loop:
        """Create a loop from the settings, overridden by the fields of `feedback`.

        Raises:
            InvalidValue: a negative gain, an impossible setpoint of this mode, or a value that is not finite.
        """
        said = feedback or Feedback()
        on = settings.on if said.on is None else said.on
        p, i, setpoint = (
            before if asked is None else float(asked)
            for before, asked in (
                (settings.proportional_gain, said.proportional_gain),
                (settings.integral_gain, said.integral_gain),
                (settings.first_setpoint, said.setpoint),
            )
        )
        if not (math.isfinite(p) and math.isfinite(i) and p >= 0 and i >= 0):
            raise InvalidValue(f"feedback gains are zero or more, not {p:g} and {i:g}", where="feedback")
        if refusal := settings.refusal_of(setpoint):
            raise InvalidValue(refusal, where="feedback")
        return cls(settings, on, p, i, setpoint)

    @property
    def engages(self) -> bool:
        """True if the setpoint can be reached: an amplitude must be below the free amplitude."""
        return self.settings.mode != "amplitude" or self.setpoint < self.settings.free_amplitude_v

    @property
    def force(self) -> float:
        """The relative force between tip and sample; 1 at a gentle setpoint, 0 without contact."""
        s = self.settings
        if s.mode == "current":
            return math.log1p(self.setpoint / 50e-12) / math.log(2.0)
        if s.mode == "frequency-shift":
            return (_GENTLE_M / s.sensor.distance_m(self.setpoint)) ** 2
        return max(0.0, (s.free_amplitude_v - self.setpoint) / s.free_amplitude_v / _GENTLE)

    def tunnelling_distance_m(self, bias_v: float) -> float:
        """Return the distance from the sample at which the tunnelling current is the setpoint.

        The conductance falls by e over each `decay_m`, from the conductance of a one-atom contact.
        """
        conductance_s = self.setpoint / max(abs(bias_v), LEAST_BIAS_V)
        return self.settings.decay_m * math.log(max(_ONE_ATOM_S / conductance_s, 1.0))

    @property
    def error_limits_m(self) -> tuple[float, float]:
        """The largest errors that the detector can measure: (tip too high, tip too low), both positive."""
        s = self.settings
        if s.mode == "current":
            below = math.log(max(self.setpoint / s.current_floor_a, math.e)) * s.decay_m
            return below, 3.0 * below
        if s.mode == "frequency-shift":
            slope = s.sensor.slope_hz_per_m(s.sensor.distance_m(self.setpoint))
            return -self.setpoint / slope, (self.setpoint - s.sensor.largest_hz) / slope
        return (s.free_amplitude_v - self.setpoint) * s.sensitivity_m_per_v, self.setpoint * s.sensitivity_m_per_v

    def follow(self, height_m: Array, step_s: float, start_v: Array) -> Array:
        """Return z along the paths, one path per column.

        Args:
            height_m: heights at which the setpoint is reached, shape (steps, paths), `step_s` apart, linear in between.
            start_v: initial speed of z for each path, from which an oscillation of the loop grows.
        """
        splits = self._splits(step_s)
        dt = step_s / splits
        move = self._propagator(dt)
        too_high, too_low = self.error_limits_m
        rate = self.integral_gain + self.proportional_gain / self.settings.lag_s
        down, up = np.float64(rate * too_high), np.float64(rate * too_low)
        v = start_v.copy()
        # An oscillation starts at any phase: besides the speed, half of its amplitude is in z.
        z = height_m[0] + (np.roll(start_v, 1) / self._omega if self.oscillates else 0.0)
        result = np.empty_like(height_m)
        result[0] = z
        for n in range(1, len(height_m)):
            part = (height_m[n] - height_m[n - 1]) / splits
            for k in range(splits):
                h = height_m[n - 1] + k * part
                y = z - h
                z_new = z + move[0, 0] * y + move[0, 1] * v + move[0, 2] * part
                v = move[1, 0] * y + move[1, 1] * v + move[1, 2] * part
                if self.oscillates:
                    z, v = self._limited(z_new, v, h + part)
                else:
                    z, v = np.clip(z_new, z - down * dt, z + up * dt), np.clip(v, -down, up)
            result[n] = z
        return result

    def amplitude_v(self, gap_m: Array) -> Array:
        """Return the detector's amplitude; gap is z minus the height at which the setpoint is reached."""
        s = self.settings
        return np.clip(self.setpoint + gap_m / s.sensitivity_m_per_v, 0.0, s.free_amplitude_v)

    def distance_m(self, bias_v: float, contact_v: Array | float) -> Array:
        """Return the distance from the sample at which the setpoint is reached, of a tunnelling tip or a sensor.

        Args:
            contact_v: the contact potential, which a frequency shift as a setpoint contains.
        """
        if self.settings.mode == "current":
            return np.asarray(self.tunnelling_distance_m(bias_v))
        return self.settings.sensor.charged_distance_m(self.setpoint, bias_v - contact_v)

    @property
    def oscillates(self) -> bool:
        """True if the gains are beyond the limit of stability."""
        return self._damping <= 0.0 or self._inertia <= 0.0

    @property
    def _damping(self) -> float:
        return 1.0 + self.proportional_gain - self.integral_gain * self.settings.delay_s

    @property
    def _inertia(self) -> float:
        return self.settings.lag_s - self.proportional_gain * self.settings.delay_s

    @property
    def _omega(self) -> float:
        # angular frequency in 1/s; a quarter of the period is not shorter than the delay of the loop
        linear = math.sqrt(max(self.integral_gain, 1.0) / max(self._inertia, 0.1 * self.settings.lag_s))
        return min(linear, math.pi / (2.0 * self.settings.delay_s))

    def _splits(self, step_s: float) -> int:
        # a step is exact unless the detector saturates; several parts resolve ringing better
        ringing = self._damping**2 < 2.0 * max(self._inertia, 0.1 * self.settings.lag_s) * self.integral_gain
        return min(4, max(1, math.ceil(step_s / self.settings.lag_s / 3.0))) if ringing else 1

    def _limited(self, z: Array, v: Array, h: Array) -> tuple[Array, Array]:
        # An oscillation grows until the saturated detector reduces the gain to the limit of stability. For a saturating
        # sine the gain falls about as 4 / pi * limit / amplitude (its describing function).
        excess = self.integral_gain * self.settings.delay_s / (1.0 + self.proportional_gain)
        most_m = min(self.error_limits_m) * 4.0 / math.pi * max(excess, 1.0)
        y = z - h
        share = np.minimum(1.0, most_m / np.maximum(np.hypot(y, v / self._omega), 1e-15))
        return h + share * y, share * v

    def _propagator(self, dt: float) -> NDArray[np.float64]:
        # exact over dt; rows give the change of z and the new v from (z - h, v, change of h during dt)
        inertia = self._inertia
        limit = 0.1 * self.settings.lag_s
        damping = self._damping if inertia > limit else min(self._damping, -0.5)  # a P gain alone may be too high
        inertia = max(inertia, limit)
        ki, drive = self.integral_gain, self.proportional_gain - self.integral_gain * self.settings.delay_s
        growth = -damping * dt / (2.0 * inertia)
        # Beyond the second bound the equation diverges without oscillating, unlike any loop with a delay.
        if growth > _GROWN or (growth > 0.0 and damping**2 >= 4.0 * inertia * ki):
            return self._turned(dt, min(growth, _GROWN))
        # state (z - h0, v, h - h0, h'), with time in units of dt
        a = np.zeros((4, 4))
        a[0, 1] = 1.0
        a[1] = [-ki * dt * dt / inertia, -damping * dt / inertia, ki * dt * dt / inertia, drive * dt / inertia]
        a[2, 3] = 1.0
        e = _exponential(a)
        # columns: y = z - h0, v in m/s, rise of h over dt
        return np.array([[e[0, 0] - 1.0, e[0, 1] * dt, e[0, 3]], [e[1, 0] / dt, e[1, 1], e[1, 3] / dt]])

    def _turned(self, dt: float, growth: float) -> NDArray[np.float64]:
        # the propagator of an oscillation that soon saturates: it grows, its phase advances, the surface has no effect
        omega, grown = self._omega, math.exp(growth)
        sine, cosine = grown * math.sin(omega * dt), grown * math.cos(omega * dt)
        return np.array([[cosine - 1.0, sine / omega, 0.0], [-omega * sine, cosine, 0.0]])


def _exponential(a: NDArray[np.float64]) -> NDArray[np.float64]:
    # exp(a) by scaling and squaring; values beyond a float's range are clipped (an unstable loop saturates anyway)
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(a).max()), 1e-9))) + 3)
    small = a / 2.0**halvings
    term = total = np.eye(len(a))
    for n in range(1, 14):
        term = term @ small / n
        total = total + term
    for _ in range(halvings):
        total = np.clip(total @ total, -1e12, 1e12)
    return total
