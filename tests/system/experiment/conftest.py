from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from experiment_lab import AFSPM, EXPERIMENT, WITNESS, AfspmRun, Run


def _started(command: Sequence[str], where: Path) -> AfspmRun:
    """In a group of its own, so that a Ctrl-C for it is not one for the tests."""
    return AfspmRun(
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, cwd=where)
    )


@pytest.fixture
def resume(tmp_path: Path) -> Iterator[Callable[[Path], AfspmRun]]:
    """Starts `afspm run --resume` with the folder of a run; killed after the test."""
    runs: list[AfspmRun] = []

    def start(folder: Path) -> AfspmRun:
        runs.append(_started((*AFSPM, "run", "--resume", str(folder), "--verbose", "--no-report"), tmp_path))
        return runs[-1]

    yield start
    for one in runs:
        one.process.kill()
        one.process.wait()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Starts `afspm run` of EXPERIMENT, `more` and a second file laid over it, in `where`; killed after the test."""
    runs: list[AfspmRun] = []

    def start(
        *options: str, more: str = "", over: str = "", scans: int = 4, speed: float = 120.0, where: Path = tmp_path
    ) -> AfspmRun:
        (tmp_path / "witness.py").write_text(WITNESS, encoding="utf-8")
        file = tmp_path / "experiment.toml"
        file.write_text(EXPERIMENT.format(scans=scans, speed=speed) + more, encoding="utf-8")
        overlay = tmp_path / "overlay.toml"
        overlay.write_text(over, encoding="utf-8")
        files, folder = (str(file), str(overlay)), str(tmp_path / "runs")
        command = (*AFSPM, "run", *files, "--runs", folder, "--verbose", "--no-report", *options)
        runs.append(_started(command, where))
        return runs[-1]

    yield start
    for one in runs:
        one.process.kill()
        one.process.wait()
