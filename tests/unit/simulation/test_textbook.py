"""The simulated physics against textbooks: one test a law, with its equation and source."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from afspm.model import Feedback, Region
from afspm.simulation import TipShape, World
from afspm.simulation.feedback import FeedbackSettings, Loop, SensorSettings
from afspm.simulation.measuring import Adjustment
from afspm.simulation.spectra import (
    ForceSettings,
    IVSettings,
    current_voltage,
    force_distance,
    lock_in_s,
    thermal_current,
)

HERE = (0.0, 0.0)
ON, OFF = Feedback(on=True), Feedback(on=False)
QPLUS = {"resonance_hz": 30e3, "spring_n_per_m": 1800.0, "oscillation_m": 100e-12}
STM = {"mode": "current", "qplus": True, "sensor": QPLUS}
QUIET = {
    "noise": dict.fromkeys(("white_m", "one_over_f_m", "line_offset_m", "current_a", "frequency_hz"), 0.0),
    "iv": {"noise_a": 0.0, "relative_noise": 0.0, "noise_density_a": 0.0},
}
SHARP = TipShape(10e-9, 18.0)
VACUUM_F_PER_M = 8.8541878128e-12
RANDOM = np.random.default_rng(0)


def quiet_world(**settings: Any) -> World:
    return World.from_settings({"surface": "lattice", "feedback": STM, **QUIET, **settings}, 1, 0.0)


def at_rest(world: World, bias_v: float, feedback: Feedback = OFF) -> dict[str, float]:
    return world.at_rest(HERE, 0.0, feedback, bias_v, random=RANDOM)


def half_width(x: np.ndarray, values: np.ndarray) -> float:
    above = x[values >= values.max() / 2]
    return float(np.ptp(above) + x[1] - x[0])


# results F1: the current was the setpoint at any bias, and the gap followed bias and setpoint.
# I = G V at one distance, with a constant conductance G at small V (Simmons, J. Appl. Phys. 34, 1793, 1963).
def test_current_at_a_held_z_is_proportional_to_the_bias() -> None:
    world = quiet_world()
    world.remember(HERE, 0.0, ON, 0.1)
    currents = {bias_v: at_rest(world, bias_v)["Current"] for bias_v in (1.0, 0.1, 0.01, 0.0, -0.1)}
    assert currents == pytest.approx({bias_v: 1e-9 * bias_v for bias_v in currents}, rel=1e-9)
    assert at_rest(world, 0.1, Feedback(on=False, setpoint=2e-9))["Current"] == pytest.approx(100e-12)
    assert at_rest(world, 0.0, ON)["Current"] == 0.0


def test_change_of_the_bias_in_a_scan_at_constant_height_changes_the_current_alone() -> None:
    changes = [Adjustment(0.4, OFF, 0.1), Adjustment(0.8, Feedback(on=False, setpoint=1e-9), 0.05)]
    world = quiet_world(surface="steps", feedback=STM | {"integral_gain": 0.0, "proportional_gain": 0.0})
    scan = world.scan(Region(HERE, (1e-9, 1e-9)), (12, 8), 0.1, 0.0, ON, 0.1, adjusted=changes)
    current, height = scan.channels()["Current"][1], scan.channels()["Height"][1]
    assert np.ptp(height[4:]) < 1e-13
    np.testing.assert_allclose(current[4:8].mean() / current[8:].mean(), 2.0, rtol=0.02)


# I = I0 exp(-2 kappa z), kappa = sqrt(2 m phi) / hbar; `decay_m` is 1 / (2 kappa) (Binnig et al., PRL 49, 57, 1982).
def test_current_falls_exponentially_with_z() -> None:
    z, current = quiet_world().spectrum("z", HERE, 0.0, ON, 0.1)[2][:, :2].T
    slope, offset = np.polyfit(z[current > 1e-15], np.log(current[current > 1e-15]), 1)
    assert (-1.0 / slope, math.exp(offset)) == pytest.approx((50e-12, 100e-12), rel=1e-6)
    decay_m = 1.0546e-34 / (2.0 * math.sqrt(2.0 * 9.109e-31 * 4.0 * 1.602e-19))
    assert FeedbackSettings().decay_m == pytest.approx(decay_m, rel=0.05), "a work function of 4 eV"


def test_curves_begin_at_the_held_z() -> None:
    world = quiet_world()
    world.remember(HERE, 0.0, ON, 0.1)
    world.hold(at_rest(world, 0.1)["Height"] + 50e-12)
    iv = world.spectrum("IV", HERE, 0.0, OFF, 1.0)[2]
    assert np.interp(0.1, iv[:, 0], iv[:, 1]) == pytest.approx(100e-12 / math.e, rel=1e-3)
    z = world.spectrum("z", HERE, 0.0, OFF, 0.1)[2]
    assert np.interp(0.0, z[:, 0], np.log(z[:, 1])) == pytest.approx(math.log(100e-12 / math.e), abs=1e-3)


# Small amplitude: df = -f / (2 k) dF/dz. Large amplitude: df = -f H R / (12 sqrt(2) k (A d)^(3/2)) for van der Waals'
# F = -H R / (6 d^2). Any amplitude: df = -f / (k A^2) <F q'> (Giessibl, PRB 56, 16010, 1997; RMP 75, 949, 2003).
@pytest.mark.parametrize("voltage_v", [0.0, 0.8])
def test_frequency_shift_has_the_limits_of_giessibl(voltage_v: float) -> None:
    d, f, k, hamaker_j, radius_m = 1e-9, 30e3, 1800.0, 1e-19, 8e-9
    electric = math.pi * VACUUM_F_PER_M * radius_m * voltage_v**2  # F = -pi e0 R V^2 / d (Hudlet et al., EPJ B 2, 5)

    def shift_hz(oscillation_m: float) -> float:
        sensor = SensorSettings(f, k, oscillation_m, radius_m, hamaker_j)
        return float(sensor.shift_hz(np.array(d), voltage_v))

    gradient = hamaker_j * radius_m / (3.0 * d**3) + electric / d**2
    assert shift_hz(1e-12) == pytest.approx(-f / (2.0 * k) * gradient, rel=5e-3)
    phase = (np.arange(200_000) + 0.5) * (2.0 * math.pi / 200_000)
    for oscillation_m in (0.1e-9, 5e-9, 500e-9):
        z = d + oscillation_m * (1.0 + np.cos(phase))
        force = -hamaker_j * radius_m / (6.0 * z**2) - electric / z
        mean = (force * oscillation_m * np.cos(phase)).mean()
        assert shift_hz(oscillation_m) == pytest.approx(-f / (k * oscillation_m**2) * mean, rel=1e-3)
    if not voltage_v:
        large = -f * hamaker_j * radius_m / (12.0 * math.sqrt(2.0) * k * (d * 500e-9) ** 1.5)
        assert shift_hz(500e-9) == pytest.approx(large, rel=5e-3)


@pytest.mark.parametrize("bias_v", [-2.0, 0.25, 2.0])
def test_setpoint_of_a_sensor_contains_the_contact_potential(bias_v: float) -> None:
    loop = Loop.of(FeedbackSettings(mode="frequency-shift", setpoint=-20.0), None)
    distance_m = loop.distance_m(bias_v, 0.25)
    assert loop.settings.sensor.shift_hz(distance_m, bias_v - 0.25) == pytest.approx(-20.0, rel=1e-9)


# df(V) = df0 - c (V - V_CPD)^2, with the vertex at the contact potential (Nonnenmacher et al., APL 58, 2921, 1991).
@pytest.mark.parametrize("material_v", [0.25, -0.4])
@pytest.mark.parametrize("mode", ["current", "frequency-shift"])
def test_vertex_of_the_kelvin_parabola_is_the_contact_potential(material_v: float, mode: str) -> None:
    world = quiet_world(feedback=STM | {"mode": mode}, signals={"contact_potential_v": (material_v, material_v)})
    world.remember(HERE, 0.0, ON, 0.1)
    biases_v = np.linspace(-1.0, 1.0, 9)
    at_held_z = np.polyfit(biases_v, [at_rest(world, v)["Frequency Shift"] for v in biases_v], 2)
    names, units, values = world.spectrum("IV", HERE, 0.0, ON, 0.1)
    assert (names[4], units[4]) == ("Frequency Shift", "Hz")
    curve = np.polyfit(values[:, 0], values[:, 4], 2)
    for square, linear, _ in (at_held_z, curve):
        assert square < 0.0
        assert -linear / (2.0 * square) == pytest.approx(material_v, abs=1e-6)
    np.testing.assert_allclose(at_held_z, curve, rtol=1e-6)
    assert at_rest(world, 0.1)["Frequency Shift"] == pytest.approx(at_rest(world, 0.1, ON)["Frequency Shift"])


def test_map_of_the_contact_potential_is_in_curves_and_scans() -> None:
    world = quiet_world(surface="steps", property_map={"kind": "smooth", "quantity": "contact_potential"})
    found, true = [], []
    for x_m in np.linspace(-400e-9, 400e-9, 7):
        values = world.spectrum("IV", (x_m, 0.0), 0.0, ON, 0.1)[2]
        square, linear, _ = np.polyfit(values[:, 0], values[:, 4], 2)
        found.append(-linear / (2.0 * square))
        truth: Any = world.property_truth((x_m, 0.0), 0.0)["property"]
        true.append(truth["value"])
        assert (truth["quantity"], truth["unit"]) == ("contact_potential", "V")
    assert np.ptp(true) > 0.1
    np.testing.assert_allclose(found, true, atol=1e-6)
    scan = world.scan(Region(HERE, (1e-6, 1e-6)), (16, 16), 1.0, 0.0, ON, 1.0)
    assert np.ptp(scan.channels()["Frequency Shift"][1]) > 1.0


# F = 4/3 E* sqrt(R) d^(3/2) (Hertz, J. reine angew. Math. 92, 156, 1881), with the adhesion of DMT added.
# Pull-off at F = -2 pi R w (Derjaguin, Muller and Toporov, J. Colloid Interface Sci. 53, 314, 1975).
@pytest.mark.parametrize(("material", "modulus_pa", "work_j_m2"), [(0.0, 2e9, 0.08), (1.0, 20e9, 0.03)])
def test_contact_is_of_hertz_and_pull_off_of_dmt(material: float, modulus_pa: float, work_j_m2: float) -> None:
    settings = ForceSettings(noise_m=0.0, points=8000, range_m=400e-9)
    for radius_m in (10e-9, 40e-9):
        tip = TipShape(radius_m, 18.0)
        z, deflection, _, _, back = force_distance(settings, tip, material, RANDOM)[2].T
        pull_off = 2.0 * math.pi * radius_m * work_j_m2
        assert back.min() == pytest.approx(-pull_off, rel=0.03)  # results F2: it was twice as much
        indented = -(z + deflection)
        deep = indented > 0.6 * indented.max()
        force = deflection * settings.spring_n_per_m + settings.approach_share * pull_off
        hertz = 4.0 / 3.0 * modulus_pa * math.sqrt(radius_m) * np.abs(indented) ** 1.5
        np.testing.assert_allclose(force[deep], hertz[deep], rtol=1e-3)


# dI/dV at temperature T is the density of states, broadened by the derivative of the Fermi function: a full width at
# half maximum of 3.53 kT (Chen, Introduction to Scanning Tunneling Microscopy, 2nd ed., section 1.5).
@pytest.mark.parametrize("kt_ev", [1e-3, 25.7e-3])
def test_temperature_broadens_a_peak_by_3_5_kt(kt_ev: float) -> None:
    energy = np.linspace(-0.3, 0.3, 24_001)
    narrow = np.exp(-((energy / (0.1 * kt_ev)) ** 2) / 2.0)
    conductance = np.gradient(thermal_current(energy, narrow, kt_ev), energy)
    assert half_width(energy, conductance) == pytest.approx(3.53 * kt_ev, rel=0.01)
    assert np.trapezoid(conductance, energy) == pytest.approx(np.trapezoid(narrow, energy), rel=1e-3)


# A modulation V_mod cos(wt) broadens by 2 / (pi V_mod^2) sqrt(V_mod^2 - V^2): a full width at half maximum of
# sqrt(3) V_mod, that is 2.45 times the rms amplitude (Klein et al., PRB 7, 2336, 1973).
@pytest.mark.parametrize("modulation_v", [2e-3, 20e-3])
def test_modulation_broadens_a_peak_by_its_half_circle(modulation_v: float) -> None:
    bias = np.linspace(-0.06, 0.06, 2401)
    energy = np.linspace(-0.1, 0.1, 40_001)
    step = 0.5e-12 * (1.0 + np.tanh(energy / 5e-5))  # the current of a narrow peak
    shown = lock_in_s(bias, energy, step, modulation_v, 1e-9, 1.0, np.zeros(len(bias)))
    assert half_width(bias, shown) == pytest.approx(math.sqrt(3.0) * modulation_v, rel=0.03)
    assert np.trapezoid(shown, bias) == pytest.approx(1e-12, rel=0.01)


# The noise of a lock-in amplifier is n sqrt(1 / (4 t)) / V_rms, for a density n and a low-pass of the first order with
# time constant t (Horowitz and Hill, The Art of Electronics, section 8.14).
def test_noise_of_the_lock_in_falls_with_time_constant_and_modulation() -> None:
    density = 1e-15

    def noise_s(time_constant_s: float, modulation_v: float) -> float:
        settings = IVSettings(
            points=20_000, duration_s=400.0, noise_density_a=density, modulation_v=modulation_v,
            time_constant_s=time_constant_s,
        )  # fmt: skip
        quiet = IVSettings(**{**vars(settings), "noise_density_a": 0.0})
        loop = Loop.of(FeedbackSettings(mode="current"), None)
        noisy, clean = (
            current_voltage(s, SHARP, 1.0, 0.1, loop, np.random.default_rng(2))[2][:, 3] for s in (settings, quiet)
        )
        return float(np.std(noisy - clean))

    for time_constant_s, modulation_v in ((1e-3, 20e-3), (1e-1, 20e-3), (1e-3, 5e-3)):
        expected = density * math.sqrt(1.0 / (4.0 * time_constant_s)) / (modulation_v / math.sqrt(2.0))
        assert noise_s(time_constant_s, modulation_v) == pytest.approx(expected, rel=0.05)


# results F12: dI/dV went on where the preamplifier clipped the current
def test_lock_in_sees_the_saturation_of_the_preamplifier() -> None:
    settings = IVSettings(noise_a=0.0, relative_noise=0.0, noise_density_a=0.0, preamplifier_a=50e-12)
    loop = Loop.of(FeedbackSettings(), None)
    bias, current, _, conductance = current_voltage(settings, SHARP, 1.0, 0.1, loop, RANDOM)[2].T
    clipped = np.abs(current) == 50e-12
    inside = np.flatnonzero(clipped & (np.abs(bias) > np.abs(bias[clipped]).min() + 0.05))
    assert len(inside) > 50
    assert np.abs(conductance[inside]).max() < 1e-3 * conductance.max()


# I(V) is the integral of the density of states over the energies between both Fermi levels (Tersoff and Hamann, PRB 31,
# 805, 1985): dI/dV without broadening is the derivative of the current, and their ratio at 0 V is that of a resistor.
def test_conductance_is_the_derivative_of_the_current() -> None:
    settings = IVSettings(
        points=1000, noise_a=0.0, relative_noise=0.0, noise_density_a=0.0, modulation_v=1e-3, time_constant_s=1e-6
    )
    loop = Loop.of(FeedbackSettings(), None)
    bias, current, _, conductance = current_voltage(settings, SHARP, 1.0, 0.1, loop, RANDOM)[2].T
    np.testing.assert_allclose(np.gradient(current, bias)[2:-2], conductance[2:-2], rtol=0.02)
    assert np.interp(0.0, bias, current) == pytest.approx(0.0, abs=1e-15)


def test_sensor_gives_frequency_shift_against_z() -> None:
    world = quiet_world(signals={"contact_potential_v": (0.1, 0.1)})
    names, units, values = world.spectrum("z", HERE, 0.0, ON, 0.1)
    assert names == ("Z", "Current", "Current Retrace", "Frequency Shift", "Frequency Shift Retrace")
    assert units == ("m", "A", "A", "Hz", "Hz")
    distance_m = Loop.of(FeedbackSettings(mode="current"), ON).tunnelling_distance_m(0.1)
    expected = SensorSettings(**QPLUS).shift_hz(values[:, 0] + distance_m)
    np.testing.assert_allclose(values[:, 3], expected, rtol=1e-9)
    plain = quiet_world(feedback={"mode": "current"})
    assert plain.spectrum("z", HERE, 0.0, ON, 0.1)[0] == ("Z", "Current", "Current Retrace")
