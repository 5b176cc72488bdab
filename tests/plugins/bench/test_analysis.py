"""Numbers from simulated scans against the truth; the judges and the script use these functions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from afspm.emulation import World
from afspm.model import Region, Scan, Spectrum
from afspm_bench import analysis
from afspm_bench.evidence import true_heights


def scanned(world: World, region: Region, pixels: int, at_s: float = 0.0, line_s: float = 0.2) -> Scan:
    unit, values = world.scan(region, (pixels, pixels), line_s, at_s).channels()["Height"]
    return Scan(region, "Height", unit, values)


@pytest.mark.parametrize("seed", range(3))
def test_lattice_constant_is_within_one_percent(seed: int) -> None:
    true = 0.23e-9 + 0.03e-9 * seed
    surface = {"kind": "lattice", "constant_m": true, "angle_deg": 17.0 * seed, "strain_m": 5e-12}
    world = World.from_settings({"surface": surface}, seed, 0.0)
    value, error = analysis.lattice_constant(scanned(world, Region((0.0, 0.0), (8e-9, 8e-9)), 256))
    assert value == pytest.approx(true, rel=0.01)
    assert 0.0 < error < 0.02 * true


@pytest.mark.parametrize("seed", range(4))
def test_step_height_is_within_two_percent(seed: int) -> None:
    true = (0.25e-9, 0.34e-9, 0.45e-9, 0.58e-9)[seed]
    surface = {"kind": "steps", "step_m": true, "terrace_m": 120e-9, "angle_deg": 20.0 * seed - 30.0}
    world = World.from_settings({"surface": surface}, seed, 0.0)
    value, _ = analysis.step_height(scanned(world, Region((0.0, 0.0), (600e-9, 600e-9)), 192))
    assert value == pytest.approx(true, rel=0.02)


@pytest.mark.parametrize("gap_ev", [0.7, 1.0, 1.3])
def test_band_gap_is_within_ten_percent_and_metal_has_none(gap_ev: float) -> None:
    settings: dict[str, Any] = {"surface": {"kind": "particles"}, "iv": {"gap_ev": gap_ev}}
    world = World.from_settings(settings, 3, 0.0)
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    heights = true_heights(world, region, 251)
    metal = analysis.peaks(heights, region, least_m=30e-9, apart_m=40e-9)[0].xy_m
    ground, _ = analysis.flattest(heights, region, 80e-9)
    curves = []
    for at_m in (metal, ground):
        names, units, values = world.spectrum("IV", at_m, 10.0)
        curves.append(Spectrum(at_m, "IV", tuple(names), tuple(units), values))
    assert analysis.conductance_in_gap(curves[0]) > 0.5
    assert analysis.conductance_in_gap(curves[1]) < 0.2
    assert analysis.band_gap(curves[1:])[0] == pytest.approx(gap_ev, rel=0.1)


def test_shift_is_the_drift_between_two_scans() -> None:
    velocity = (30e-12, -20e-12)
    world = World.from_settings(
        {"surface": {"kind": "particles"}, "drift": {"velocity_m_per_s": [*velocity, 0.0]}}, 5, 0.0
    )
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    first, last = (scanned(world, region, 128, at_s) for at_s in (0.0, 2400.0))
    dx, dy = analysis.shift_m(first, last)
    assert math.hypot(dx - velocity[0] * 2400.0, dy - velocity[1] * 2400.0) < 3e-9


def test_peaks_are_the_true_particles_highest_first() -> None:
    world = World.from_settings({"surface": {"kind": "particles", "radius_m": 25e-9, "spacing_m": 260e-9}}, 8, 0.0)
    region = Region((0.0, 0.0), (2e-6, 2e-6))
    true = analysis.peaks(true_heights(world, region, 501), region, least_m=30e-9, apart_m=40e-9)[:3]
    seen = analysis.peaks_of(scanned(world, region, 256, line_s=0.4))[:3]
    for one, other in zip(seen, true, strict=True):
        assert math.dist(one.xy_m, other.xy_m) < other.height_m / 4
        assert one.height_m == pytest.approx(other.height_m, rel=0.05)


def test_constellation_is_found_among_other_peaks() -> None:
    random = np.random.default_rng(4)
    known = [(float(x), float(y)) for x, y in random.uniform(-5e-7, 5e-7, (6, 2))]
    shift = (1.3e-7, -0.7e-7)
    others = [analysis.Peak((float(x), float(y)), 3e-8) for x, y in random.uniform(-9e-7, 9e-7, (20, 2))]
    found = [*others, *(analysis.Peak((x + shift[0], y + shift[1]), 5e-8) for x, y in known[:5])]
    best, count = analysis.constellation_shift(known, found, 10e-9)
    assert count >= 5
    assert math.dist(best, shift) < 5e-9
