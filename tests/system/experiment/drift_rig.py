"""Experiments under a Drift Compensated Scheduler, and what was true of them."""

from __future__ import annotations

import csv
import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from experiment_lab import AFSPM, AfspmRun

from afspm.microscopes.simulator import files

EXPERIMENT = """
[clock]
speed = {speed}

[microscope]
component = true
class = "Simulator"
seed = 5
surface = {{ kind = "particles" }}
drift = {{ velocity_m_per_s = [0.25e-9, -0.15e-9, 0.0] }}
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
from afspm.drift.registration import Registration

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
FEATURE_M = (0.2e-6, 0.1e-6)


class Surveyor(Component):
    def __init__(self, scans: int):
        self.scans = scans

    def run(self):
        for i in range(self.scans):
            scan = self.scope.scan(REGION, shape=(64, 64), key=f"scan-{i}").first
            self.note({"scan": scan.filename, "center_m": scan.region.center_m})
            spectrum = self.scope.spectrum(FEATURE_M, kind="IV", key=f"iv-{i}")
            self.note({"spectrum": spectrum.filename, "position_m": spectrum.position_m})
            self.log.info("round %d is done", i)
            self.scope.sleep(180.0)
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
    """Where things were, in m; the sample's coordinates are the tip's in the middle of the first scan.

    Attributes:
        said_m, true_m: (n, 2) centres of the scans as they were published, and as they were.
        spectra_said_m, spectra_true_m: the same of the spectra.
        drift_m: (n, 2) of the sample at the scans.
    """

    said_m: np.ndarray
    true_m: np.ndarray
    spectra_said_m: np.ndarray
    spectra_true_m: np.ndarray
    drift_m: np.ndarray


def surveyed(run: AfspmRun) -> Surveyed:
    """What the surveyor was told, beside the truth."""
    noted = [json.loads(line) for line in (run.folder / "surveyed.jsonl").read_text().splitlines()]
    events = [json.loads(line) for line in (run.folder / "truth.jsonl").read_text().splitlines()]
    truth = {event["file"]: event for event in events if "file" in event}
    drift = {name: _drift_m(event) for name, event in truth.items()}
    scans = [one for one in noted if "scan" in one]
    spectra = [one for one in noted if "spectrum" in one]
    start_m = drift[Path(scans[0]["scan"]).name]

    def tips(ones: list[dict[str, str]], key: str) -> np.ndarray:
        found = [files.load(Path(one[key]))[0] for one in ones]
        return np.array([one.region.center_m if key == "scan" else one.position_m for one in found])  # type: ignore[union-attr]

    drifts = {key: np.array([drift[Path(one[key]).name] - start_m for one in ones]) for key, ones in
              (("scan", scans), ("spectrum", spectra))}  # fmt: skip
    return Surveyed(
        np.array([one["center_m"] for one in scans]),
        tips(scans, "scan") - drifts["scan"],
        np.array([one["position_m"] for one in spectra]),
        tips(spectra, "spectrum") - drifts["spectrum"],
        drifts["scan"],
    )


def _drift_m(event: dict[str, Any]) -> np.ndarray:
    """Of the sample under the tip, less what the controller follows by itself."""
    if "scan" in event:
        scan = {
            name: np.array(value)[:2] for name, value in event["scan"].items() if name.endswith(("start_m", "end_m"))
        }
        seen = [scan[f"drift_{when}_m"] - scan[f"compensated_{when}_m"] for when in ("start", "end")]
        return np.asarray((seen[0] + seen[1]) / 2)
    truth = event["truth"]
    return np.subtract(truth["drift_m"], truth["compensated_m"])[:2]


def table(run: AfspmRun) -> list[dict[str, str]]:
    """The rows of drift_correction.csv."""
    with (run.folder / "drift_correction.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def worker_of(run: AfspmRun) -> int:
    """The process id of the scheduler's worker."""
    scheduler = run.pid("scheduler")
    children = Path(f"/proc/{scheduler}/task/{scheduler}/children")
    if not children.exists():
        pytest.skip("who has started whom is only told by Linux")
    (pid,) = map(int, children.read_text().split())
    return pid


class Rig:
    """Starts experiments in a folder, and kills them in the end."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._runs: list[AfspmRun] = []

    def start(self, drift: str = "", scans: int = 5, speed: float = 60.0) -> AfspmRun:
        """What a busy computer is late by, in real time, the sample has drifted on by at the speed of the clock."""
        (self._folder / "surveyor.py").write_text(SURVEYOR, encoding="utf-8")
        file = self._folder / "experiment.toml"
        file.write_text(EXPERIMENT.format(drift=drift, scans=scans, speed=speed), encoding="utf-8")
        options = ("--runs", str(self._folder / "runs"), "--verbose", "--no-report", "--without", "recorder")
        command = (*AFSPM, "run", str(file), *options)
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=os.name != "nt",
            cwd=self._folder,
        )
        self._runs.append(AfspmRun(process))
        return self._runs[-1]

    def close(self) -> None:
        for one in self._runs:
            one.process.kill()
            one.process.wait()
