"""A maker in a package of its own joins by being installed: nothing else of afspm knows of it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from site_folder import EXAMPLE_MAKER, install

EXPERIMENT = """
[clock]
speed = 60.0

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["500 nm", "500 nm"]
pixels = [32, 32]
scans = 2
end_when_done = true
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    folder = tmp_path / "site"
    folder.mkdir()
    install(EXAMPLE_MAKER, folder)
    return folder


def afspm(site: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "afspm", *arguments],
        env={**os.environ, "PYTHONPATH": str(site)},
        cwd=site.parent,
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_driver_of_a_package_passes_the_suite_on_its_own_emulator(site: Path) -> None:
    said = afspm(site, "test-translator", str(site / "example_maker" / "emulated.toml"), "--frame", "500 nm")
    assert "the translator passes the suite" in said


def test_maker_of_a_package_measures_exports_and_adds_a_command(site: Path) -> None:
    (site.parent / "experiment.toml").write_text(EXPERIMENT, encoding="utf-8")
    afspm(site, "run", "experiment.toml", str(site / "example_maker" / "emulated.toml"), "--no-report")
    afspm(site, "export", "--to", "acme", "--out", "out")
    first, second = sorted((site.parent / "out").glob("*.acme"))
    assert "Height" in afspm(site, "acme", "channels", str(first))
    assert first.read_bytes() != second.read_bytes()
    assert "acme: Acme" in afspm(site, "emulate")
