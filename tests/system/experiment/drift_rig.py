"""Experiments under a Drift Compensated Scheduler, with the simulated truth."""

from __future__ import annotations

import cmath
import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from tests.system.experiment.experiment_lab import AfspmRun

from afspm.storage.formats import read

EXPERIMENT = """
[clock]
speed = {speed}

[microscope]
component = true
class = "Simulator"
seed = 5
surface = {{ kind = "particles" }}
drift = {{ {sample} }}
scanner = {{ flatten = "line" }}
initial = {{ scan-speed = "8 um/s", "scan-top-left-x" = "-0.5 um", "scan-top-left-y" = "-0.5 um" }}

[scheduler]
component = true
class = "DriftCompensatedScheduler"
drift = {{ {drift} }}

[rescanner]
component = true
class = "Rescanner"

[surveyor]
component = true
class = "surveyor.Surveyor"
scans = {scans}
pause_s = {pause_s}

[table]
component = true
class = "DriftTable"

[cache]
history = {{ Scan2d = 20 }}
"""

SURVEYOR = '''
"""Thinks in sample coordinates: the same region and the same feature, again and again."""

import json
import threading
from pathlib import Path

import numpy as np

from afspm import Component, Region
from afspm.plugins.drift.registration import Registration

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
FEATURE_M = (0.2e-6, 0.1e-6)


class Surveyor(Component):
    def __init__(self, scans: int, pause_s: float):
        self.scans = scans
        self.pause_s = pause_s

    def run(self):
        for i in range(self.scans):
            scan = self.scope.scan(REGION, shape=(64, 64), key=f"scan-{i}").first
            corners_m = scan.region.corners_m().tolist()
            self.note({"scan": scan.filename, "center_m": scan.region.center_m, "corners_m": corners_m})
            spectrum = self.scope.spectrum(FEATURE_M, kind="IV", key=f"iv-{i}")
            self.note({"spectrum": spectrum.filename, "position_m": spectrum.position_m})
            self.log.info("round %d is done", i)
            self.scope.sleep(self.pause_s)
        self.scope.end_experiment()

    def note(self, facts):
        with (self.run_dir / "surveyed.jsonl").open("a") as file:
            file.write(json.dumps(facts) + "\\n")


class Drifts:
    """An estimator that knows how this sample drifts."""

    def register(self, reference, scan, prior=None):
        moved_m = np.array([0.25e-9, -0.15e-9]) * (scan.mid_s - reference.mid_s)
        center_m = np.array(reference.region.center_m)
        return Registration(True, "", moved_m, np.eye(2) * 1e-20, np.zeros((2, 2)), center_m)


class Fails(Drifts):
    """It fails at the first scan that it is asked about, and never comes back from the second."""

    def register(self, reference, scan, prior=None):
        for trouble in (self.fail, self.hang):
            mark = Path(__file__).with_name(trouble.__name__)
            if not mark.exists():
                mark.write_text(scan.key)
            if mark.read_text() == scan.key:
                trouble()
        return super().register(reference, scan, prior)

    def fail(self):
        raise ZeroDivisionError("nothing is known")

    def hang(self):
        threading.Event().wait()
'''


@dataclass
class Surveyed:
    """Published and true places, in m; sample coordinates equal the tip's in the middle of the first scan.

    Attributes:
        said_m, true_m: (n, 2) published and true centres of the scans.
        corners_said_m, corners_true_m: (n, 4, 2) the same for their corners.
        spectra_said_m, spectra_true_m: the same for the spectra.
        drift_m: (n, 2) of the sample under the centres of the scans.
    """

    said_m: np.ndarray
    true_m: np.ndarray
    corners_said_m: np.ndarray
    corners_true_m: np.ndarray
    spectra_said_m: np.ndarray
    spectra_true_m: np.ndarray
    drift_m: np.ndarray


@dataclass(frozen=True)
class Lay:
    """True place of the sample under the tip, by truth.jsonl: x_tip = about + turn * (x_sample - about) + drift, as x +
    iy.

    The drift excludes the part that the controller compensates itself.
    """

    about_m: complex
    turn: complex
    drift_m: complex

    @classmethod
    def of(cls, event: dict[str, Any]) -> Lay:
        """Return it for the middle of a scan, or the end of a spectrum."""
        if "scan" in event:
            scan = event["scan"]
            start, end = (
                cls._at(scan[f"turn_{when}"], scan[f"drift_{when}_m"], scan[f"compensated_{when}_m"])
                for when in ("start", "end")
            )
            return cls(start.about_m, (start.turn + end.turn) / 2, (start.drift_m + end.drift_m) / 2)
        truth = event["truth"]
        return cls._at(truth["turn"], truth["drift_m"], truth["compensated_m"])

    @classmethod
    def _at(cls, turn: dict[str, Any], drift_m: list[float], compensated_m: list[float]) -> Lay:
        seen_m = np.subtract(drift_m, compensated_m)
        return cls(complex(*turn["about_m"]), cmath.rect(turn["scale"], turn["angle_rad"]), complex(*seen_m[:2]))

    def to_tip_of(self, first: Lay, xy_m: ArrayLike) -> np.ndarray:
        """Return the tip coordinates, at the time of the first scan, of features at positions (..., 2) now."""
        x_m, y_m = np.moveaxis(np.asarray(xy_m), -1, 0)
        on_sample = self.about_m + (x_m + 1j * y_m - self.about_m - self.drift_m) / self.turn
        at_first = first.about_m + first.turn * (on_sample - first.about_m) + first.drift_m
        return np.stack([at_first.real, at_first.imag], axis=-1)


def surveyed(run: AfspmRun) -> Surveyed:
    """Return the places published for the surveyor's scans, and the true ones."""
    noted = [json.loads(line) for line in (run.folder / "surveyed.jsonl").read_text().splitlines()]
    events = [json.loads(line) for line in (run.folder / "truth.jsonl").read_text().splitlines()]
    lay = {event["file"]: Lay.of(event) for event in events if "file" in event}
    scans = [Path(one["scan"]) for one in noted if "scan" in one]
    spectra = [Path(one["spectrum"]) for one in noted if "spectrum" in one]
    first = lay[scans[0].name]
    regions = [next(iter(read(path))).region for path in scans]  # type: ignore[union-attr]
    true = [lay[path.name].to_tip_of(first, region.center_m) for path, region in zip(scans, regions, strict=True)]
    corners = [lay[path.name].to_tip_of(first, region.corners_m()) for path, region in zip(scans, regions, strict=True)]
    positions: list[Any] = [next(iter(read(path))).position_m for path in spectra]  # type: ignore[union-attr]
    at = [lay[path.name].to_tip_of(first, at_m) for path, at_m in zip(spectra, positions, strict=True)]
    return Surveyed(
        said_m=np.array([one["center_m"] for one in noted if "scan" in one]),
        true_m=np.array(true),
        corners_said_m=np.array([one["corners_m"] for one in noted if "scan" in one]),
        corners_true_m=np.array(corners),
        spectra_said_m=np.array([one["position_m"] for one in noted if "spectrum" in one]),
        spectra_true_m=np.array(at),
        drift_m=np.array([region.center_m for region in regions]) - np.array(true),
    )


def table(run: AfspmRun) -> list[dict[str, str]]:
    """Return the rows of drift_correction.csv."""
    with (run.folder / "drift_correction.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def worker_of(run: AfspmRun) -> int:
    """Return the process id of the scheduler's worker."""
    scheduler = run.pid("scheduler")
    children = Path(f"/proc/{scheduler}/task/{scheduler}/children")
    if not children.exists():
        pytest.skip("who has started whom is only told by Linux")
    # beside it runs the resource tracker of multiprocessing
    pids = children.read_text().split()
    (pid,) = [int(pid) for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    return pid


class Rig:
    """Starts experiments in a folder, and kills them after the test."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._runs: list[AfspmRun] = []

    def start(
        self,
        drift: str = "",
        scans: int = 5,
        speed: float = 60.0,
        sample: str = "velocity_m_per_s = [0.25e-9, -0.15e-9, 0.0]",
        pause_s: float = 180.0,
    ) -> AfspmRun:
        """Start an experiment. While processes are late on a busy computer, the sample drifts on with the clock."""
        (self._folder / "surveyor.py").write_text(SURVEYOR, encoding="utf-8")
        settings = {"drift": drift, "scans": scans, "speed": speed, "sample": sample, "pause_s": pause_s}
        file = self._folder / "experiment.toml"
        file.write_text(EXPERIMENT.format(**settings), encoding="utf-8")
        options = ("--runs", str(self._folder / "runs"), "--verbose", "--no-report", "--without", "recorder")
        self._runs.append(AfspmRun("run", str(file), *options, folder=self._folder))
        return self._runs[-1]

    def close(self) -> None:
        for one in self._runs:
            one.close()
