"""The client in Java, as MATLAB uses it, run by GNU Octave: a component of the experiment, and a script that joins."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from systems import interrupt
from tests.system.experiment.experiment_lab import AfspmRun

import afspm
from afspm.model import ScopeState
from afspm.night import ScanRow

ROOT = Path(__file__).parents[3]
CLIENT = ROOT / "clients" / "java"
SAMPLES = ROOT / "experiments" / "other_language"
PAGE = ROOT / "docs" / "how-to" / "from-matlab.md"
NEEDED = {"octave-cli": "octave", "java": "default-jre-headless", "mvn": "maven"}
"""Programs, and Debian's packages with them."""
SLOWER = '[clock]\nspeed = 60.0\n[microscope]\ninitial = { scan-speed = "0.5 um/s" }\n'
ALONE = """
[clock]
speed = 600.0
[microscope]
component = true
class = "Simulator"
initial = { scan-speed = "4 um/s" }
[scheduler]
component = true
class = "Scheduler"
[security]
tcp = true
"""


@pytest.fixture(scope="session")
def jar() -> Path:
    if missing := [package for program, package in NEEDED.items() if shutil.which(program) is None]:
        pytest.skip(f"missing for the client in Octave: apt-get install {' '.join(missing)}")
    subprocess.run(["mvn", "-q", "-B", "-DskipTests", "package"], cwd=CLIENT, check=True, timeout=DEADLINE_S)
    return CLIENT / "target" / "afspm-client.jar"


@contextmanager
def started(folder: Path, *files: Path) -> Iterator[AfspmRun]:
    run = AfspmRun("run", "--verbose", "--no-report", *map(str, files), "--runs", str(folder / "runs"), folder=folder)
    try:
        run.wait_for("scheduler .*is up$")
        yield run
    finally:
        run.close()


def complete_scans(folder: Path) -> list[ScanRow]:
    with afspm.open_run(folder) as record:
        return list(record.scans.where(lambda row: not row.interrupted))


@pytest.mark.usefixtures("jar")
def test_component_in_octave_scans_the_flattest_place_and_ends_the_experiment(tmp_path: Path) -> None:
    with started(tmp_path, SAMPLES / "experiment.toml", SAMPLES / "octave.toml") as run:
        assert run.end() == 0, run.output
        run.wait_for("scanned the flattest place at ")
        overview, detail = complete_scans(run.folder)
        assert overview.holder == detail.holder == "flattest"
        assert detail.region is not None
        assert detail.region.size_m == pytest.approx((0.25e-6, 0.25e-6))
        assert not run.said("flattest", "restart|crash|exit code"), run.output


@pytest.mark.usefixtures("jar")
@pytest.mark.parametrize("killed", ["flattest", "microscope", "scheduler"])
def test_keyed_scan_of_a_component_in_octave_is_taken_once(tmp_path: Path, killed: str) -> None:
    slower = tmp_path / "slower.toml"
    slower.write_text(SLOWER, encoding="utf-8")
    with started(tmp_path, SAMPLES / "experiment.toml", SAMPLES / "octave.toml", slower) as run:
        with afspm.connect(run.folder, "onlooker") as scope:
            assert scope.wait_until(lambda: scope.state is ScopeState.SCANNING, timeout_s=DEADLINE_S)
        run.kill(killed)
        assert run.end() == 0, run.output
        assert len(complete_scans(run.folder)) == 2, run.output


def test_script_of_the_page_joins_an_experiment_and_takes_a_scan(jar: Path, tmp_path: Path) -> None:
    (tmp_path / "alone.toml").write_text(ALONE, encoding="utf-8")
    shutil.copy(jar, tmp_path)
    first = re.findall(r"```matlab\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]
    script = tmp_path / "of_the_page.m"
    script.write_text(first + 'printf("%d x %d, speed %g\\n", size(z), speed)\n', encoding="utf-8")
    with started(tmp_path, tmp_path / "alone.toml") as run:
        with afspm.connect(run.folder, "onlooker") as scope:
            assert scope.wait_until(lambda: scope.state is ScopeState.FREE, timeout_s=DEADLINE_S)
        command = ["octave-cli", "--quiet", script.name]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
        assert done.returncode == 0, done.stderr + run.output
        assert done.stdout.splitlines()[-1] == "64 x 128, speed 4"
        interrupt(run.process)
        run.end()
        assert [(row.holder, row.shape) for row in complete_scans(run.folder)] == [("matlab", (64, 128))]
