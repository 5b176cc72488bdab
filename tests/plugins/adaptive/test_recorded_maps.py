"""The benchmark of adaptive maps on recorded samples, with a small sample written here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks import recorded_maps

from afspm.plugins.adaptive.refinement import AdaptiveMap

STEPS = np.concatenate([np.linspace(-1.0, 1.0, 8), np.linspace(1.0, -1.0, 8)])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with one sample of 20 rows and 30 columns, whose loops open from left to right."""
    _, columns = np.mgrid[0:20, 0:30]
    rises = np.gradient(STEPS) > 0
    spectra = np.where(rises, columns[..., None] / 29.0, 0.0) + 0.0 * STEPS
    np.savez(tmp_path / "loops.npz", spectra=spectra, vstep=STEPS)
    return tmp_path


def test_opening_of_a_recorded_loop_is_the_difference_of_both_ways(folder: Path) -> None:
    opening = recorded_maps.quantities(folder / "loops.npz")["opening"]
    assert opening.shape == (20, 30)
    assert opening[5] == pytest.approx(np.linspace(0.0, 1.0, 30))


def test_map_of_a_recorded_slope_is_about_as_wrong_as_expected(folder: Path) -> None:
    found = recorded_maps.mapped(AdaptiveMap, recorded_maps.quantities(folder / "loops.npz")["opening"], 90)
    assert found.error < 0.1
    assert 0.3 < found.error / found.expected < 1.3
    assert not found.is_grid


def test_folder_without_recordings_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert recorded_maps.main([str(tmp_path)]) == 1
    assert f"{tmp_path} has no *.npz" in capsys.readouterr().out
