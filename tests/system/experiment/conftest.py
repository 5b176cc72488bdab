from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.system.experiment.experiment_lab import EXPERIMENT, SPEED, WITNESS, AfspmRun, Run


@pytest.fixture
def afspm_run(tmp_path: Path) -> Iterator[Run]:
    """Start `afspm run` with these arguments, in `where`; kill it after the test."""
    runs: list[AfspmRun] = []

    def start(*arguments: str, where: Path = tmp_path) -> AfspmRun:
        runs.append(AfspmRun("run", "--verbose", "--no-report", *arguments, folder=where))
        return runs[-1]

    yield start
    for one in runs:
        one.close()


@pytest.fixture
def run(afspm_run: Run, tmp_path: Path) -> Run:
    """Start `afspm run` of EXPERIMENT with the addition `more` and an overlay, in `where`."""

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
