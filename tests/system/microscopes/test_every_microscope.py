"""The same experiment file, unchanged, on the simulator and on every emulated controller: the same scans."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from makers import MAKERS
from numpy.typing import NDArray

ROOT = Path(__file__).parents[3]
FILES = ROOT / "experiments" / "every_microscope"
NOISE_M = 0.8e-9
"""The rms between two scans of the same place whose lines are not taken at the same moments."""
OVERLAY = """
[keeper]
component = true
class = "keeper.Keeper"
"""
ELSEWHERE = """
[microscope]
address = "{address}"
"""

Kept = list[tuple[list[Any], NDArray[np.float64]]]
"""[x, y, width, height, angle] and the heights of each scan."""


def scans_on(microscope: str, folder: Path, more: str = "") -> Kept:
    """Run the experiment, with `more` in its file; return the published heights."""
    overlay = folder / "overlay.toml"
    overlay.write_text(OVERLAY + more, encoding="utf-8")
    (folder / "keeper.py").write_text(Path(__file__).with_name("keeper.py").read_text(encoding="utf-8"))
    maker = MAKERS.get(microscope)
    second, height = (FILES / "simulator.toml", "Height") if maker is None else (maker.emulated, maker.heights)
    files = [str(FILES / "experiment.toml"), str(second), str(overlay)]
    done = subprocess.run(
        [*AFSPM, "run", *files, "--runs", str(folder / "runs"), "--no-report", "--without", "metadata,recorder"],
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (facts,) = (folder / "runs").glob("*-*/run.json")
    assert json.loads(facts.read_text(encoding="utf-8"))["simulated"] is True
    kept = []
    for file in sorted((folder / "runs").glob("*-*/kept-*.npz")):
        with np.load(file) as found:
            channel, unit, *place = json.loads(str(found["facts"]))
            if channel == height:
                assert unit == "m"
                kept.append((place, found["values"]))
    return kept


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    return scans_on("simulator", tmp_path_factory.mktemp("simulator"))


def apart_m(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the rms of the difference without its plane: zero and tilt of z are arbitrary."""
    rows, columns = np.indices(a.shape).reshape(2, -1)
    plane = np.stack([rows, columns, np.ones(a.size)], axis=1)
    difference = (a - b).ravel()
    return float(np.std(difference - plane @ np.linalg.lstsq(plane, difference, rcond=None)[0]))


@pytest.mark.xdist_group("every_microscope")
@pytest.mark.parametrize("microscope", sorted(MAKERS))
def test_the_same_scans_of_the_same_sample(microscope: str, simulated: Kept, tmp_path: Path, stranger: Any) -> None:
    """No request reaches the controller that the file names, which is not the emulator of this run."""
    address = MAKERS[microscope].address.format(port=stranger.port)
    found = scans_on(microscope, tmp_path, ELSEWHERE.format(address=address))
    assert len(found) == len(simulated) == 3
    for (place, heights), (wanted_place, wanted) in zip(found, simulated, strict=True):
        assert place == pytest.approx(wanted_place, rel=1e-6, abs=1e-12)
        assert heights.shape == wanted.shape == (48, 64)
        assert apart_m(heights, wanted) < NOISE_M


@pytest.mark.xdist_group("every_microscope")
def test_a_pixel_off_or_a_flipped_axis_would_be_seen(simulated: Kept) -> None:
    one_pixel_m = [
        min(apart_m(heights[:, 1:], heights[:, :-1]), apart_m(heights[1:], heights[:-1])) for _, heights in simulated
    ]
    assert max(one_pixel_m) > 1.5 * NOISE_M
    for _, heights in simulated:
        assert apart_m(heights[::-1], heights) > 3 * NOISE_M
        assert apart_m(heights[:, ::-1], heights) > 3 * NOISE_M
