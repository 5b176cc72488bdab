"""Samples: independent of resolution and order, without bounds, and with their declared properties."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.unit.storage.samples import HEIGHT_M, REGION, WHOLE

from afspm.basics.errors import ConfigError, FileError
from afspm.simulation.surfaces import surface_from
from afspm.simulation.surfaces.patterns import _frame_edges
from afspm.simulation.surfaces.picture import read

GENERATED = ["steps", "particles", "stamper", "lattice", "rough", "flat"]


def extent_m(kind: str) -> float:
    return 8e-9 if kind == "lattice" else 3e-6


@pytest.mark.parametrize("kind", GENERATED)
@pytest.mark.parametrize("origin", [0.0, -3.7e-5])
def test_grid_and_its_points_one_by_one_show_the_same(kind: str, origin: float) -> None:
    surface = surface_from(kind)
    x = origin + np.linspace(0.0, extent_m(kind), 60)[None, :]
    y = -origin + np.linspace(0.0, extent_m(kind), 50)[:, None]
    grid = surface.relief(x, y, 1e-11, 7)
    some_x, some_y = (a[::7, ::5] for a in np.meshgrid(x[0], y[:, 0]))
    points = surface.relief(some_x, some_y, 1e-11, 7)
    np.testing.assert_allclose(points.height_m, grid.height_m[::7, ::5], atol=1e-18)
    np.testing.assert_allclose(points.material, grid.material[::7, ::5], atol=1e-9)
    assert grid.material.min() >= 0.0
    assert grid.material.max() <= 1.0


@pytest.mark.parametrize("kind", [k for k in GENERATED if k != "flat"])
def test_seed_determines_the_sample(kind: str) -> None:
    x = np.linspace(0.0, extent_m(kind), 80)[None, :]
    a, again, b = (surface_from(kind).relief(x, x.T, 0.0, seed).height_m for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, again)
    assert not np.allclose(a, b, atol=0.01 * np.ptp(a))


@pytest.mark.parametrize("kind", ["particles", "stamper", "rough"])
def test_sample_has_no_period(kind: str) -> None:
    surface = surface_from(kind)
    x = np.linspace(0.0, 6e-6, 120)[None, :]
    y = np.linspace(0.0, 6e-6, 120)[:, None]
    here = surface.relief(x, y, 5e-8, 3).height_m
    for away in (1.6e-6 * 8, 1e-4, 1e-2):
        there = surface.relief(x + away, y, 5e-8, 3).height_m
        assert np.corrcoef(here.ravel(), there.ravel())[0, 1] < 0.9


def test_bumps_of_a_stamper_are_three_to_eleven_bits_long() -> None:
    for frame in range(40):
        edges = np.append(_frame_edges(5, 2, frame), 588.0)
        runs = np.diff(edges)
        assert edges[0] == 0.0
        assert len(runs) % 2 == 0  # as many gaps as bumps: the next frame starts with a bump
        assert set(runs) <= set(range(3, 12))


def test_stamper_has_its_pitch_and_its_height() -> None:
    surface = surface_from({"kind": "stamper", "angle_deg": 0.0, "roughness_rms_m": 0.0})
    x, y = np.linspace(0.0, 60e-6, 1500)[None, :], np.linspace(-0.8e-6, 15.2e-6, 1000)[:, None]
    height = surface.relief(x, y, 0.0, 1).height_m
    assert height.max() == pytest.approx(120e-9, rel=0.01)
    assert height.min() == 0.0
    profile = height.mean(axis=1)
    spectrum = np.abs(np.fft.rfft(profile - profile.mean()))
    assert 16e-6 / int(spectrum.argmax()) == pytest.approx(1.6e-6, rel=0.02)


def test_steps_are_terraces_one_step_apart() -> None:
    surface = surface_from({"kind": "steps", "roughness_rms_m": 0.0})
    x = np.linspace(0.0, 2e-6, 400)[None, :]
    heights = surface.relief(x, x.T, 0.0, 1).height_m / 0.4e-9
    on_a_terrace = np.abs(heights - np.round(heights + 0.5) + 0.5)
    assert np.mean(np.minimum(on_a_terrace, np.abs(on_a_terrace - 0.5)) < 1e-6) > 0.95
    assert len(np.unique(np.round(heights * 2))) > 5


def test_lattice_has_its_constant() -> None:
    surface = surface_from({"kind": "lattice", "angle_deg": 0.0, "defect_fraction": 0.0, "strain_m": 0.0})
    a = 0.246e-9
    x, y = np.linspace(0, 4e-9, 300)[None, :], np.linspace(0, 4e-9, 300)[:, None]
    base = surface.relief(x, y, 0.0, 1).height_m
    for shift in ((a, 0.0), (a / 2, a * np.sqrt(3) / 2)):
        np.testing.assert_allclose(surface.relief(x + shift[0], y + shift[1], 0.0, 1).height_m, base, atol=1e-15)
    assert np.ptp(base) == pytest.approx(0.06e-9, rel=0.02)
    assert surface.relief(np.zeros((1, 1)), np.zeros((1, 1)), 0.0, 1).height_m[0, 0] == pytest.approx(0.06e-9)


def test_rough_ground_is_self_affine() -> None:
    surface = surface_from({"kind": "rough", "hurst": 0.7, "largest_m": 4e-6, "smallest_m": 5e-9})
    x = np.linspace(0.0, 60e-6, 60001)[None, :]
    profile = surface.relief(x, np.zeros((1, 1)), 0.0, 1).height_m[0]
    lags = np.array([16, 64, 256])  # nm; well between smallest and largest
    growth = [np.sqrt(np.mean((profile[lag:] - profile[:-lag]) ** 2)) for lag in lags]
    slope = np.polyfit(np.log(lags), np.log(growth), 1)[0]
    assert slope == pytest.approx(0.7, abs=0.12)
    assert np.std(profile) == pytest.approx(6e-9, rel=0.3)


def test_picture_is_scaled_and_stands_upright(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    grey = np.zeros((40, 60), dtype=np.uint8)
    grey[:10, :15] = 200  # top left of the picture
    image.fromarray(grey).save(tmp_path / "picture.png")
    surface = surface_from(
        {"kind": "file", "path": str(tmp_path / "picture.png"), "width_m": 6e-6, "height_range_m": 50e-9}
    )
    x, y = np.linspace(-3e-6, 3e-6, 60)[None, :], np.linspace(-2e-6, 2e-6, 40)[:, None]
    height = surface.relief(x, y, 0.0, 0).height_m
    assert np.ptp(height) == pytest.approx(50e-9, rel=0.2)
    assert height[-5:, :10].mean() > height[:5, :10].mean() + 40e-9  # large y is the picture's top
    assert height[-5:, :10].mean() > height[-5:, -10:].mean() + 40e-9
    beyond = surface.relief(x + 6e-6, y, 0.0, 0).height_m
    np.testing.assert_allclose(beyond, height[:, ::-1], atol=1e-12)  # mirrored


def test_invalid_surface_file_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(20, 20)))
    with pytest.raises(ConfigError, match="wide"):
        surface_from({"kind": "file", "path": str(tmp_path / "a.npy")})
    with pytest.raises(ConfigError, match="high"):
        surface_from({"kind": "file", "path": str(tmp_path / "a.npy"), "width_m": 1e-6})
    with pytest.raises(FileError, match="no such file"):
        surface_from({"kind": "file", "path": str(tmp_path / "b.png")})
    (tmp_path / "c.sxm").write_bytes(b"not a scan")
    with pytest.raises(FileError, match="not a Nanonis scan"):
        read(tmp_path / "c.sxm")


IMAGES = (
    "up.sxm",
    "scan.ibw",
    "nsid.h5",
    "simulated.nc",
    "gxsm3.nc",
    "gxsm4.nc",
    "image.nhf",
    "image.nid",
    "image.tiff",
)


@pytest.mark.parametrize("name", IMAGES)
def test_heights_of_every_format_make_a_surface(name: str, tmp_path: Path) -> None:
    WHOLE[name](tmp_path / name)
    found = read(tmp_path / name)
    assert found.size_m == pytest.approx(REGION.size_m)
    assert found.height_m.shape == HEIGHT_M.shape
    np.testing.assert_allclose(np.ptp(found.height_m), np.ptp(HEIGHT_M), rtol=1e-6)


def test_file_without_heights_is_refused(tmp_path: Path) -> None:
    WHOLE["force.ibw"](tmp_path / "force.ibw")
    with pytest.raises(FileError, match="no heights"):
        read(tmp_path / "force.ibw")


def test_wrong_surface_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match="particles"):
        surface_from("partikles")
    with pytest.raises(ConfigError, match="pitch_m"):
        surface_from({"kind": "stamper", "pich_m": 1e-6})
    with pytest.raises(ConfigError, match="above zero"):
        surface_from({"kind": "stamper", "pitch_m": 0.0})
