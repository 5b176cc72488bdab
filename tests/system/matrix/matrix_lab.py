"""The matrix of components and instruments: the jobs, what proves each, and the recorded outcomes.

A job is an experiment file without a microscope; a maker's own file, or the simulator's, is laid over it, and nothing
else. `make test-matrix` runs all of them, and writes `matrix.toml` again.
"""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path

from makers import MAKERS
from tests.system.experiment.experiment_lab import AfspmRun

import afspm
from afspm.basics import entry_points
from afspm.experiment import load

HERE = Path(__file__).parent
RECORD = HERE / "matrix.toml"
JOBS = HERE / "jobs"
EXPERIMENTS = HERE.parents[2] / "experiments"
OUTSIDE = {"nion": "Nion"}
"""Instruments of other distributions, by the names of their drivers: their cells run where the driver is installed."""
SECOND_FILES = (
    {"simulator": EXPERIMENTS / "every_microscope" / "simulator.toml"}
    | {name: maker.emulated for name, maker in MAKERS.items()}
    | {
        name: folder / "simulated.toml"
        for name, driver in OUTSIDE.items()
        if (folder := entry_points.folder(entry_points.DRIVERS, driver)) is not None
    }
)
DONE = "done"
Proof = Callable[[AfspmRun], bool]


def scans(at_least: int) -> Proof:
    """Return a proof: so many scans are in the record."""

    def proof(run: AfspmRun) -> bool:
        with afspm.open_run(run.folder) as record:
            return len([one for one in record.scans if not one.interrupted]) >= at_least

    return proof


def spectra(at_least: int) -> Proof:
    """Return a proof: so many spectra are in the record."""

    def proof(run: AfspmRun) -> bool:
        with afspm.open_run(run.folder) as record:
            return len(record.spectra) >= at_least

    return proof


def remembers(name: str, key: str) -> Proof:
    """Return a proof: a component has saved something in its memory."""
    return lambda run: f'"{key}"' in (run.folder / "state" / f"{name}.json").read_text(encoding="utf-8")


def file(name: str) -> Proof:
    """Return a proof: the run has left a file."""
    return lambda run: any(run.folder.glob(name))


def said(name: str, text: str) -> Proof:
    """Return a proof: a process has said something."""
    return lambda run: bool(run.said(rf"\b{name} +.*{text}"))


PROOFS: Mapping[str, Mapping[str, Proof]] = {
    "series": {
        "Scheduler": scans(4),
        "ScanSeries": scans(4),
        "NightPicture": file("night.png"),
        "Metadata": file("metadata.csv"),
        "LogCollector": file("log*.txt"),
        "Recorder": file("journal.sqlite"),
        "Dashboard": said("dashboard", "http"),
        "Gateway": said("gateway", "http"),
    },
    "judge": {"TipClassifier": said("tip_classifier", "good|bad|unclear")},
    "list": {"ScanList": scans(2)},
    "grid": {"RegionGrid": scans(2)},
    "sweep": {"Sweep": scans(2)},
    "drift": {
        "DriftCompensatedScheduler": scans(4),
        "Rescanner": scans(5),
        "DriftTable": file("drift_table.csv"),
        "DriftPictures": file("drift_offset.png"),
    },
    "curves": {"SpectroscopyGrid": spectra(2)},
    "adaptive": {"Adaptive": file("map.csv")},
    "survey": {"Survey": file("targets.csv")},
    "lines": {"LineWatch": scans(4)},
    "feedback": {
        "FeedbackAnalysis": remembers("analysis", "newest_ns"),
        "FeedbackTuner": said("tuner", "integral gain"),
    },
    "repair": {"TipCorrector": said("tip_corrector", "pulse|repaired|good")},
    "agent": {"Agent": spectra(1)},
}
"""What proves, for each job, that each of its components has done it."""
ELSEWHERE = {
    "Instrument": "speaks to another instrument, not to the microscope",
    "Notifier": "speaks to a person, not to the microscope",
    "TraceReplay": "stands in for a controller",
    "PublishedScheduler": "is the mediator of the published implementation",
    "PublishedPeers": "serves peers of the published implementation",
    "PublishedTranslator": "stands in for a driver",
    "SimulatedPublishedTranslator": "stands in for a driver",
}
"""Components that have no job here, and why."""
CELLS = [(job, instrument) for job in PROOFS for instrument in SECOND_FILES]


def files(folder: Path, job: str, instrument: str) -> tuple[Path, Path]:
    """Return the files of a cell; the job with the modules that it names is copied into the folder."""
    shutil.copytree(JOBS, folder)
    shutil.copy(EXPERIMENTS / "agent" / "scripted.py", folder)
    return folder / f"{job}.toml", SECOND_FILES[instrument]


def refusal(of_cell: tuple[Path, Path]) -> str:
    """Return why `afspm check` refuses the files of a cell; empty if it does not."""
    errors = [one.what for one in load(*of_cell).check() if one.is_error]
    return re.sub(r", which \[microscope\] .*", "", errors[-1]) if errors else ""


def recorded() -> dict[str, dict[str, str]]:
    """Return the recorded outcomes, by job and instrument."""
    return {job: one["on"] for job, one in tomllib.loads(RECORD.read_text(encoding="utf-8")).items()}
