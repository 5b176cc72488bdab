"""A laboratory's own package joins by being installed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from site_folder import EXAMPLE_PLUGIN, install
from systems import PATIENCE

from afspm import entry_points
from afspm.drift.estimators import estimator
from afspm.drift.registration import DriftScan
from afspm.errors import ConfigError, FileError
from afspm.experiment import load
from afspm.files import read
from afspm.model import Region

EXPERIMENT = """
[clock]
speed = 2000.0

[microscope]
component = true
class = "ExampleScope"

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [16, 16]

[counter]
component = true
class = "ExampleCounter"
scans = 2
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "site"
    folder.mkdir()
    install(EXAMPLE_PLUGIN, folder)
    monkeypatch.syspath_prepend(folder)
    entry_points.forget()
    yield folder
    entry_points.forget()
    for name in [name for name in sys.modules if name.partition(".")[0] == "example_plugin"]:
        del sys.modules[name]


def afspm(site: Path, *arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-m", "afspm", *arguments]
    return subprocess.run(
        command, env=environment, cwd=cwd, capture_output=True, encoding="utf-8", timeout=60 * PATIENCE
    )


def test_an_experiment_file_names_drivers_and_components_of_a_plug_in(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT)
    experiment = load(file)
    assert not experiment.check()
    paths = {name: process.class_path for name, process in experiment.resolved.processes.items()}
    assert paths["microscope"] == "example_plugin.scope.ExampleScope"
    assert paths["counter"] == "example_plugin.counter.ExampleCounter"


def test_an_experiment_with_a_plug_in_runs(site: Path, tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(EXPERIMENT)
    done = afspm(site, "run", "experiment.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "counted by the plug-in" in done.stdout + done.stderr


def test_a_file_is_read_by_the_reader_of_a_plug_in(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "scan.example"
    np.savetxt(file, np.arange(6.0).reshape(2, 3))
    (scan,) = read(file).scans
    assert scan.shape == (2, 3)


def test_a_suffix_that_nobody_reads_is_told_with_those_of_plug_ins(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "scan.other"
    file.touch()
    with pytest.raises(FileError) as refused:
        read(file)
    assert ".ibw" in refused.value.hint
    assert ".example" in refused.value.hint


def test_drift_is_estimated_by_the_estimator_of_a_plug_in(site: Path) -> None:
    scan = DriftScan(np.zeros((4, 4)), Region((1e-6, 0.0), (1e-6, 1e-6)), 0.0, 1.0)
    found = estimator("standstill").register(scan, scan)
    assert found.accepted
    assert not found.displacement_m.any()


def test_a_command_of_a_plug_in_is_run_and_a_broken_one_spoils_nothing(site: Path) -> None:
    done = afspm(site, "example-hello", "--name", "world")
    assert done.stdout == "hello world\n", done.stderr
    broken = afspm(site, "example-broken")
    assert broken.returncode == 1
    assert "'example-broken' of the package example-plugin can't be loaded" in broken.stderr


def test_a_name_that_nobody_offers_is_none() -> None:
    assert entry_points.find("example", entry_points.READERS) is None
    assert entry_points.load(entry_points.READERS, "example") is None


def test_a_name_that_two_packages_offer_is_refused(site: Path) -> None:
    info = site / "other_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[afspm.readers]\nexample = other_plugin:read\n")
    entry_points.forget()
    with pytest.raises(ConfigError, match="several packages: example-plugin, other-plugin"):
        entry_points.load(entry_points.READERS, "example")
