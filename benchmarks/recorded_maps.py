"""`python -m benchmarks.recorded_maps FOLDER`: adaptive maps and nested grids of recorded samples.

FOLDER has samples with a curve at each pixel: the folder `mexpsimu/data` of the package mexpsimu (PyPI, MIT licence),
with `spectra` (rows, columns, points) and `vstep` in each *.npz. Two quantities of each are mapped with 320 curves: the
mean of a curve, and the opening of its loop, or its last values where the voltage only rises.

The true map is that of all pixels, with the noise of the recording. Errors are rms, in standard deviations of the true
map. Prints them, the errors that both expect, and their processor time.

With `--still` each map is measured in eight ways, turned and mirrored, with 120 curves and a search for a drift, and
the number of maps that follow one is printed: the recordings do not move.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

# before numpy starts its own threads
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from afspm.model import Region
from afspm.plugins.adaptive.refinement import AdaptiveMap, LatticeMap, NestedGrid

CURVES = 320
FEWER = 120  # to search for a drift in, which more curves exclude better
LOOKS = 20  # curves between two looks at the expected error, from the second lattice on
REGION = Region((0.0, 0.0), (1e-6, 1e-6))
LEVELS = 4  # up to 65 x 65 positions


@dataclass(frozen=True)
class Outcome:
    """A map after all curves.

    Attributes:
        error, expected: true and expected rms error, in standard deviations of the true map.
        is_grid: whether an adaptive map went on as a grid.
        followed: whether it followed a drift at any time.
    """

    error: float
    expected: float
    processor_s: float
    is_grid: bool
    followed: bool

    def __str__(self) -> str:
        as_grid = ", as a grid" if self.is_grid else ""
        return f"{self.error:.2f} (expected {self.expected:.2f}, {self.processor_s:.1f} s{as_grid})"


def quantities(file: Path) -> dict[str, np.ndarray]:
    """Return the true maps (rows, columns) of a file by quantity."""
    with np.load(file, allow_pickle=False) as found:
        spectra, steps = found["spectra"], found["vstep"]
    mean = spectra.mean(axis=-1)
    rises = np.gradient(steps) > 0
    if rises.all():
        return {"mean": mean, "last": spectra[..., -8:].mean(axis=-1)}
    return {"mean": mean, "opening": np.abs(spectra[..., rises].mean(axis=-1) - spectra[..., ~rises].mean(axis=-1))}


def mapped(planner: type[LatticeMap], truth: np.ndarray, curves: int = CURVES, *, follows: bool = False) -> Outcome:
    """Map a recorded quantity, and compare the map with all pixels.

    Args:
        follows: whether to search for a drift.
    """
    planned = planner(REGION, "value", levels=LEVELS, velocity_m_s=None if follows else (0.0, 0.0))
    pixels = np.array(truth.shape[::-1]) - 1
    began_s, followed = time.process_time(), False
    for number in range(curves):
        (point,) = planned.suggest(1)
        followed |= any(planned.parameters.velocity_m_s)
        along = np.array([point["x"], point["y"]]) / REGION.size_m + 0.5
        column, row = np.rint(np.clip(along, 0.0, 1.0) * pixels).astype(int)
        planned.ingest([{**point, "value": float(truth[row, column]), "time_s": float(number), "seconds": 1.0}])
        if number > len(planned.lattice.cells(1)) and number % LOOKS == 0:
            planned.fit()
            planned.expected_error()
    planned.fit()
    processor_s = time.process_time() - began_s
    axes_m = [np.linspace(-0.5, 0.5, count + 1) * size for count, size in zip(pixels, REGION.size_m, strict=True)]
    places_m = np.stack([axis.ravel() for axis in np.meshgrid(*axes_m)], axis=1)
    error = float(np.sqrt(np.mean((planned.map(places_m) - truth.ravel()) ** 2)))
    is_grid = isinstance(planned, AdaptiveMap) and planned.is_grid
    spread = float(truth.std())
    return Outcome(error / spread, planned.expected_error() / spread, processor_s, is_grid, followed)


def invented(maps: Sequence[np.ndarray]) -> int:
    """Print how many maps of still samples follow a drift; return 1 if one does."""
    ways = [turned for truth in maps for once in (truth, truth.T) for turned in (once, once[::-1])]
    ways += [way[:, ::-1] for way in ways]
    wrong = sum(mapped(AdaptiveMap, way, FEWER, follows=True).followed for way in ways)
    print(f"{wrong} of {len(ways)} maps with {FEWER} curves followed a drift")
    return int(wrong > 0)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recorded_maps", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--still", action="store_true", help="search for a drift, where there is none")
    asked = parser.parse_args(arguments)
    files = sorted(asked.folder.glob("*.npz"))
    if not files:
        print(f"{asked.folder} has no *.npz: give the folder mexpsimu/data of the package mexpsimu")
        return 1
    if asked.still:
        return invented([truth for file in files for truth in quantities(file).values()])
    pairs = []
    for file in files:
        for name, truth in quantities(file).items():
            pairs.append((mapped(AdaptiveMap, truth), mapped(NestedGrid, truth)))
            print(f"{file.stem:24} {name:8} adaptive {pairs[-1][0]}; grid {pairs[-1][1]}", flush=True)
    for kind, outcomes in zip(("adaptive", "grid"), zip(*pairs, strict=True), strict=True):
        over = [one.error / one.expected for one in outcomes]
        print(f"{kind}: true error {min(over):.2f} to {max(over):.2f} times the expected error")
    ratios = [adaptive.error / grid.error for adaptive, grid in pairs]
    print(f"error of the adaptive map over the grid's: {min(ratios):.2f} to {max(ratios):.2f}")
    own_s, grids_s = (sum(one.processor_s for one in outcomes) for outcomes in zip(*pairs, strict=True))
    load = os.getloadavg()[0]
    print(f"processor time: {own_s:.1f} s, {own_s / grids_s:.1f} times the grid's, at a load of {load:.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
