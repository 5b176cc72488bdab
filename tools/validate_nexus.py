"""Validates the files of runs with NeXus' own validator (`pynx validate` of pynxtools), in an environment of its own.

Run by `make test-nexus`: a run with scans and one with spectra, and every file that they leave.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import bootstrap

ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "build" / "nexus-runs"
VALIDATOR = "pynxtools==0.14.1"
PROGRAMS = "Scripts" if os.name == "nt" else "bin"
METADATA = '[metadata]\nsample = "Au(111)"\nperson = "A. Student"\norcid = "0000-0002-1825-0097"\nproject = "steps"\n'
MICROSCOPE = """
[clock]
speed = 600.0

[microscope]
component = true
class = "Simulator"
feedback = { mode = "current", setpoint = 1e-10 }
initial = { scan-speed = "4 um/s" }

[scheduler]
component = true
class = "Scheduler"
"""
SCANS = """
[series]
component = true
class = "ScanSeries"
size = ["1 um", "500 nm"]
angle = "30 deg"
scans = 2
end_when_done = true
"""
SPECTRA = """
[grid]
component = true
class = "SpectroscopyGrid"
counts = [2, 1]
spacing = ["50 nm", "50 nm"]
kind = "{kind}"
end_when_done = true
"""


def main() -> None:
    validator = bootstrap.environment_of("nexus", VALIDATOR) / "pynx"
    RUNS.mkdir(parents=True, exist_ok=True)
    parts = {"scans": SCANS, "bias": SPECTRA.format(kind="IV"), "force": SPECTRA.format(kind="force")}
    wrong = [name for name, part in parts.items() if not _is_valid(name, METADATA + MICROSCOPE + part, validator)]
    if wrong:
        sys.exit(f"not valid: {', '.join(wrong)}")


def _is_valid(name: str, experiment: str, validator: Path) -> bool:
    file = RUNS / f"{name}.toml"
    file.write_text(experiment, encoding="utf-8")
    afspm = ROOT / ".venv" / PROGRAMS / "afspm"
    subprocess.run([afspm, "run", file, "--runs", RUNS, "--no-report"], check=True)
    folder = max(RUNS.glob(f"{name}-*"), key=lambda one: one.stat().st_mtime)
    files = [*folder.glob("scans/*.h5"), *folder.glob("spectra/*.h5")]
    refused = [one for one in files if not _accepts(validator, one)]
    return bool(files) and not refused


def _accepts(validator: Path, file: Path) -> bool:
    done = subprocess.run([validator, "validate", file], capture_output=True, text=True, check=False)
    told = done.stdout + done.stderr
    sys.stdout.write(told)
    return "is valid according to" in told and "WARNING" not in told


main()
