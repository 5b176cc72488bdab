from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from experiment_lab import AFSPM, EXPERIMENT, SPEED, WITNESS, AfspmRun, Run


@pytest.fixture
def afspm_run(tmp_path: Path) -> Iterator[Run]:
    """Starts `afspm run` with these arguments, in `where`; killed after the test."""
    runs: list[AfspmRun] = []

    def start(*arguments: str, where: Path = tmp_path) -> AfspmRun:
        command = (*AFSPM, "run", "--verbose", "--no-report", *arguments)
        # in a group of its own, so that a Ctrl-C for it is not one for the tests
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, cwd=where
        )
        runs.append(AfspmRun(process))
        return runs[-1]

    yield start
    for one in runs:
        one.process.kill()
        one.process.wait()


@pytest.fixture
def run(afspm_run: Run, tmp_path: Path) -> Run:
    """Starts `afspm run` of EXPERIMENT, `more` and a second file laid over it, in `where`."""

    def start(
        *options: str,
        more: str = "",
        over: str = "",
        scans: int = 4,
        speed: float = SPEED,
        where: Path = tmp_path,
    ) -> AfspmRun:
        (tmp_path / "witness.py").write_text(WITNESS, encoding="utf-8")
        file = tmp_path / "experiment.toml"
        file.write_text(EXPERIMENT.format(scans=scans, speed=speed) + more, encoding="utf-8")
        overlay = tmp_path / "overlay.toml"
        overlay.write_text(over, encoding="utf-8")
        files, folder = (str(file), str(overlay)), str(tmp_path / "runs")
        return afspm_run(*files, "--runs", folder, *options, where=where)

    return start
