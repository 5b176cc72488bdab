"""Noise has the requested size and spectrum, flattening subtracts lines."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.model import Region
from afspm.simulation import World
from afspm.simulation.noise import NoiseSettings, disturbances, flattened, height_noise, one_over_f
from afspm.simulation.tip import TipShape

SILENT = {"white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0}


def draw(**settings: float) -> np.ndarray:
    return height_noise(NoiseSettings(**{**SILENT, **settings}), 200, 100, 1.0, 0.0, np.random.default_rng(1))


def test_white_noise_and_line_offsets_have_their_rms() -> None:
    assert draw(white_m=2e-10).std() == pytest.approx(2e-10, rel=0.02)
    lines = draw(line_offset_m=3e-10)
    assert np.ptp(lines, axis=1).max() == 0.0
    assert lines[:, 0].std() == pytest.approx(3e-10, rel=0.15)


def test_one_over_f_noise_has_its_rms_and_its_spectrum() -> None:
    rms = [one_over_f(4096, np.random.default_rng(seed)).std() for seed in range(60)]
    assert np.sqrt(np.mean(np.square(rms))) == pytest.approx(1.0, rel=0.1)
    power = np.mean([np.abs(np.fft.rfft(one_over_f(8192, np.random.default_rng(s)))) ** 2 for s in range(60)], axis=0)
    f = np.arange(10, 2000)
    assert np.polyfit(np.log(f), np.log(power[10:2000]), 1)[0] == pytest.approx(-1.0, abs=0.08)


def test_hum_has_its_frequency() -> None:
    series = draw(hum_m=1e-9, hum_hz=5.0).ravel()  # 200 samples a second
    peak = np.abs(np.fft.rfft(series)).argmax() / (len(series) / 200.0)
    assert peak == pytest.approx(5.0, abs=0.01)


def test_scars_and_debris_disturb_parts_of_lines() -> None:
    clean, dirty = TipShape(8e-9, 18.0), TipShape(8e-9, 18.0, debris_m=12e-9, flaws=("contaminated",))
    quiet = NoiseSettings(scar_probability=0.0)
    assert disturbances(quiet, [clean] * 100, 1.0, 64, np.random.default_rng(1)) is None
    scars = disturbances(NoiseSettings(scar_probability=0.1), [clean] * 500, 1.0, 64, np.random.default_rng(1))
    assert scars is not None
    assert 25 < np.count_nonzero(scars.any(axis=1)) < 75
    jumps = disturbances(quiet, [clean] * 50 + [dirty] * 50, 1.0, 64, np.random.default_rng(1))
    assert jumps is not None
    assert not jumps[:50].any()
    assert np.count_nonzero(jumps[50:].any(axis=1)) > 5


def test_flattening_subtracts_the_line_of_each_row() -> None:
    x = np.linspace(0.0, 1.0, 50)
    rows = np.random.default_rng(0).normal(size=(20, 2)) @ np.stack([np.ones(50), x])
    np.testing.assert_allclose(flattened(rows, "line"), 0.0, atol=1e-12)
    np.testing.assert_allclose(flattened(rows, "offset").mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_array_equal(flattened(rows, "none"), rows)


def test_flattening_world_delivers_flat_lines_of_height_only() -> None:
    world = World.from_settings({"surface": "steps", "scanner": {"flatten": "line"}}, seed=1, start_s=0.0)
    scan = world.scan(Region((0.0, 0.0), (1e-6, 1e-6)), (32, 48), 1.0, 0.0).channels()
    for name in ("Height", "Height Retrace"):
        values = scan[name][1]
        np.testing.assert_allclose(values.mean(axis=1), 0.0, atol=1e-18)
        np.testing.assert_allclose(values @ np.linspace(-1, 1, 48), 0.0, atol=1e-17)
    assert scan["Amplitude"][1].mean() == pytest.approx(0.7, abs=0.01)
