"""The scripts of the sample, each in its language, beside the series; they disturb it no more than stated."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from tests.system.gateway.gateway_lab import GatewayRun

import afspm

SAMPLE = Path(__file__).parents[3] / "experiments" / "gateway"
SCRIPTS = {
    "curl": ("sh", "scan.sh"),
    "node": ("node", "scan.mjs"),
    "octave": ("octave", "--no-gui", "scan.m"),
}
SAID = {"curl": '"state":"done"', "node": "64 x 64 pixels, the highest at", "octave": "64 x 64 pixels, the highest at"}


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewayRun]:
    run = GatewayRun(tmp_path_factory.mktemp("night"), file=SAMPLE / "experiment.toml")
    yield run
    run.close()


@pytest.mark.parametrize("language", SCRIPTS)
def test_a_script_of_the_sample_takes_its_scan(language: str, night: GatewayRun, tmp_path: Path) -> None:
    program, *arguments = SCRIPTS[language]
    if shutil.which(language) is None:
        pytest.skip(f"there is no {language}: install it to have this script tested")
    arguments = [str(SAMPLE / one) if one.startswith("scan") else one for one in arguments]
    done = subprocess.run(
        (program, *arguments, night.url, language), cwd=tmp_path, capture_output=True, encoding="utf-8",
        timeout=DEADLINE_S, check=False, env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert SAID[language] in done.stdout
    scans = [one for one in night.client().get("/scans?limit=500") if one["holder"] == f"gateway:{language}"]
    assert [(one["shape"], one["region"]["size_m"]) for one in scans] == [([64, 64], [5e-7, 5e-7])]
    assert night.client().get("/state")["holder"] != f"gateway:{language}", "it was given back"


def test_the_series_takes_all_its_scans_beside_them(night: GatewayRun) -> None:
    assert night.process.wait(DEADLINE_S) == 0
    with afspm.open_run(night.folder) as record:
        assert sum(row.holder == "series" and not row.interrupted for row in record.scans) == 12
