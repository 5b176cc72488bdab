"""A picture or a recorded scan as the sample."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError, FileError
from afspm.model import Scan, ScopeState
from afspm.plugins.image import ImageMicroscope
from afspm.simulation.scan_drawing import run_at_once

SIZE_M = (2e-6, 1.5e-6)


def heights() -> np.ndarray:
    """A smooth surface without mirror or rotation symmetry, [y, x]."""
    y, x = np.mgrid[0:48, 0:64] / 64.0
    return np.asarray(40e-9 * (x**2 + 0.4 * np.sin(5 * y) + 0.2 * np.sin(9 * x * y)))


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "heights.npy"
    np.save(path, heights())
    return path


def scanned(microscope: ImageMicroscope, folder: Path, clock: Any) -> Scan:
    microscope.clock, microscope.log, microscope.run_dir = clock, logging.getLogger("test"), folder
    microscope.memory, microscope.wake = {}, lambda: None
    microscope.run_drawing = run_at_once  # type: ignore[method-assign]
    microscope.connect()
    microscope.start_scan()
    clock.t_s += 1e4
    assert microscope.status().state is ScopeState.FREE
    (height,) = [scan for scan in microscope.load(microscope.results()[-1]) if getattr(scan, "channel", "") == "Height"]
    assert isinstance(height, Scan)
    return height


def frame(left_m: float, low_m: float, size_m: tuple[float, float], shape: tuple[int, int]) -> dict[str, Any]:
    return {
        "scan-top-left-x": f"{left_m} m",
        "scan-top-left-y": f"{low_m} m",
        "scan-size-x": f"{size_m[0]} m",
        "scan-size-y": f"{size_m[1]} m",
        "scan-resolution-x": shape[1],
        "scan-resolution-y": shape[0],
        "scan-speed": "1 um/s",
    }


def settings(picture: Path) -> dict[str, Any]:
    height = float(np.ptp(heights()))
    return {"file": picture, "width": SIZE_M[0], "height": height}


def test_whole_scan_is_the_picture_neither_mirrored_nor_turned(picture: Path, tmp_path: Path, fake_clock: Any) -> None:
    size_m = (SIZE_M[0], SIZE_M[0] * 47 / 63)
    whole = frame(-size_m[0] / 2, -size_m[1] / 2, size_m, (48, 64))
    scan = scanned(ImageMicroscope(**settings(picture), initial=whole), tmp_path, fake_clock)
    wrong = scan.values - heights()
    assert np.std(wrong) < 0.005 * np.ptp(heights())


def test_detail_is_at_its_place_in_the_picture(picture: Path, tmp_path: Path, fake_clock: Any) -> None:
    pixel_m = SIZE_M[0] / 63
    left_m, low_m = -SIZE_M[0] / 2 + 32 * pixel_m, -47 / 2 * pixel_m + 20 * pixel_m
    detail = frame(left_m, low_m, (15 * pixel_m, 11 * pixel_m), (12, 16))
    scan = scanned(ImageMicroscope(**settings(picture), initial=detail), tmp_path, fake_clock)
    expected = heights()[20:32, 32:48]
    wrong = scan.values - expected
    assert np.std(wrong) < 0.01 * np.ptp(expected)


def test_picture_may_be_degraded_by_settings(picture: Path, tmp_path: Path, fake_clock: Any) -> None:
    noisy = ImageMicroscope(
        **settings(picture), noise={"white_m": 5e-9}, initial=frame(-1e-6, 0, (2e-6, 1e-9), (8, 64))
    )
    flat = scanned(noisy, tmp_path, fake_clock).values
    assert np.std(flat - flat.mean(axis=0)) > 2e-9


def test_a_picture_without_a_scale_is_refused(picture: Path) -> None:
    with pytest.raises(ConfigError, match="how wide"):
        ImageMicroscope(picture)


def test_missing_file_is_refused_before_the_start(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such file"):
        ImageMicroscope(tmp_path / "missing.sxm")
