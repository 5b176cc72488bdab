"""The shipped quantities on curves made from textbooks, with what an instrument adds to them."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.driver import SettingInForce
from afspm.model import Spectrum, names
from afspm.plugins.adaptive.band_gap import band_gap
from afspm.plugins.adaptive.pull_off import pull_off
from afspm.plugins.adaptive.quantities import kelvin_parabola

K_N_PER_M = 0.4
KT_4K_EV = 8.617e-5 * 4.2


def force_curve(adhesion_n: float, *, noise_n: float = 2e-11, ripple_n: float = 0.0, both: bool = True) -> Spectrum:
    """Return a curve on a stiff sample: contact at z = 0, a snap-in of 1 nN, offset and slope, and interference."""
    z = np.linspace(-30e-9, 400e-9, 500)
    random = np.random.default_rng(3)
    free = 3e-7 + 4e-3 * (z - z[-1]) + ripple_n * np.sin(2.0 * np.pi * z / 335e-9 + 1.0)
    ways = [np.where(z < least_n / K_N_PER_M, -K_N_PER_M * z, 0.0) for least_n in (1e-9, adhesion_n)]
    there, back = (free + way + noise_n * random.standard_normal(len(z)) for way in ways)
    columns, labels = (
        ([z, there, back], ("Z", "Force", "Force Retrace")) if both else ([z, back], ("Z", "Force Retrace"))
    )
    return Spectrum((0.0, 0.0), "force", labels, ("m", "N", "N")[: len(labels)], np.stack(columns, 1))


# before, the pull-off force was the lowest recorded force, with the offset of the deflection in it
@pytest.mark.parametrize("ripple_n", [0.0, 0.4e-9])
def test_pull_off_force_is_counted_from_the_free_cantilever(ripple_n: float) -> None:
    found = pull_off(force_curve(8e-9, ripple_n=ripple_n))
    step_n = K_N_PER_M * 430e-9 / 499  # the jump is between two points
    assert found.force_n == pytest.approx(8e-9 - step_n / 2.0, abs=step_n / 2.0 + 3.0 * found.error_n)
    assert found.error_n < 0.02 * found.force_n


def test_pull_off_force_needs_no_way_there() -> None:
    assert pull_off(force_curve(8e-9, both=False)).force_n == pytest.approx(7.9e-9, rel=0.03)


def test_force_curve_without_attraction_has_no_adhesion() -> None:
    z = np.linspace(-30e-9, 400e-9, 500)
    noise = 1e-10 * np.random.default_rng(1).standard_normal((2, 500))
    there, back = 2e-7 + np.maximum(-z, 0.0) + noise
    curve = Spectrum(
        (0.0, 0.0), "force", ("Z", "Force", "Force Retrace"), ("m", "N", "N"), np.stack([z, there, back], 1)
    )
    with pytest.raises(InvalidValue, match="not above the noise"):
        pull_off(curve)


def rounded(energy: Array, density: Array, kt_ev: float, modulation_v: float = 0.0) -> Array:
    """Return a density, rounded by the temperature and by a lock-in amplifier."""
    step = energy[1] - energy[0]
    half = len(energy) // 6
    x = np.arange(-half, half + 1) * step
    kernel = 1.0 / np.cosh(np.clip(x / (2.0 * kt_ev), -300.0, 300.0)) ** 2
    found = np.convolve(np.pad(density, half, mode="edge"), kernel / kernel.sum(), mode="valid")
    if modulation_v:
        circle = np.sqrt(np.maximum(modulation_v**2 - x**2, 0.0))
        found = np.convolve(np.pad(found, half, mode="edge"), circle / circle.sum(), mode="valid")
    return np.asarray(found)


def tunnelling(
    energy: Array, conductance: Array, *, noise: float = 2e-3, modulation_v: float | None = None
) -> Spectrum:
    """Return dI/dV on the inner half of the energies, with noise."""
    bias = np.linspace(energy[0] / 2.0, energy[-1] / 2.0, 256)
    values = np.interp(bias, energy, conductance) + noise * np.random.default_rng(2).standard_normal(256)
    stated = () if modulation_v is None else (SettingInForce(names.LOCK_IN_AMPLITUDE, "V", modulation_v, modulation_v),)
    return Spectrum((0.0, 0.0), "IV", ("Bias", "dI/dV"), ("V", "S"), np.stack([bias, values], 1), in_force=stated)


# Dynes, Narayanamurti and Garno, Phys. Rev. Lett. 41, 1509 (1978)
@pytest.mark.parametrize("is_stated", [True, False])
def test_gap_of_a_warm_superconductor_is_within_its_coherence_peaks(is_stated: bool) -> None:
    delta_ev, modulation_v = 1.4e-3, 0.3e-3
    energy = np.linspace(-12e-3, 12e-3, 6001)
    at = energy - 0.05e-3j
    density = np.abs(np.real(at / np.sqrt(at**2 - delta_ev**2)))
    curve = tunnelling(
        energy, rounded(energy, density, KT_4K_EV, modulation_v), modulation_v=modulation_v if is_stated else None
    )
    found = band_gap(curve)
    peaks = curve["Bias"][np.argmax(curve["dI/dV"])]
    assert abs(peaks) > 1.15 * delta_ev
    assert found.density == "superconductor"
    assert found.value_ev == pytest.approx(2.0 * delta_ev, rel=0.02)


@pytest.mark.parametrize("onset", [0.5, 1.0, 0.0])
def test_gap_of_bands_does_not_depend_on_how_they_begin(onset: float) -> None:
    energy = np.linspace(-3.0, 3.0, 6001)
    beyond = np.maximum(energy - 0.5, -0.3 - energy)
    density = np.where(beyond > 0.0, np.maximum(beyond, 1e-12) ** onset, 0.0)
    found = band_gap(tunnelling(energy, rounded(energy, density, 8.617e-5 * 77.0)))
    assert found.value_ev == pytest.approx(0.8, abs=max(3.0 * found.error_ev, 0.008))
    assert found.error_ev < 0.03


def test_gap_that_the_noise_hides_is_refused() -> None:
    energy = np.linspace(-3.0, 3.0, 3001)
    density = np.sqrt(np.maximum(np.abs(energy) - 0.4, 0.0))
    with pytest.raises(InvalidValue, match=r"no band edge|too uncertain"):
        band_gap(tunnelling(energy, density, noise=0.5))


def test_drift_of_the_frequency_shift_goes_out_of_both_ways() -> None:
    bias = np.linspace(-1.0, 1.0, 101)
    both = np.concatenate([bias, bias[::-1]])
    shift = -8.0 * (both - 0.2) ** 2 + np.linspace(0.0, 2.0, 202)  # Hz; 2 Hz of it are drift
    noise = 1e-3 * np.random.default_rng(1).standard_normal(202)
    labels, units = ("Bias", "Frequency Shift"), ("V", "Hz")
    curve = Spectrum((0.0, 0.0), "IV", labels, units, np.stack([both, shift + noise], 1))
    one_way = Spectrum((0.0, 0.0), "IV", labels, units, curve.values[:101])
    assert kelvin_parabola(one_way).vertex_v == pytest.approx(0.2 + 1.0 / 2.0 / 16.0, abs=0.003)
    assert kelvin_parabola(curve).vertex_v == pytest.approx(0.2, abs=0.001)
