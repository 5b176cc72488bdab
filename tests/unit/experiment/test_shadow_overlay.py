"""Experiments that run as a shadow."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.basics.errors import ConfigError
from afspm.experiment import Experiment, load
from afspm.experiment.shadow import shadow_file, shadow_overlay

FILE = """
[scheduler]
component = true
class = "Scheduler"

[instrument]
component = true
class = "{driver}"
{settings}
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]

[classifier]
component = true
class = "TipClassifier"
"""


def shadow(folder: Path, driver: str, settings: str = "") -> Experiment:
    file = folder / "experiment.toml"
    file.write_text(FILE.format(driver=driver, settings=settings), encoding="utf-8")
    return load(file, shadow_overlay(load(file).resolved, folder))


@pytest.mark.parametrize(
    ("driver", "settings"),
    [("Nanonis", ""), ("Asylum", ""), ("Gxsm", ""), ("Park", ""), ("Nanosurf", "release = 18\n")],
)
def test_shadow_of_each_maker_is_valid_and_keeps_a_trace(tmp_path: Path, driver: str, settings: str) -> None:
    experiment = shadow(tmp_path, driver, settings)
    experiment.require_valid()
    instrument = experiment.resolved.processes["instrument"]
    assert instrument.class_path.endswith(f"{driver}Shadow")
    assert instrument.settings["trace"] is True
    assert experiment.resolved.sections.control.shadow


@pytest.mark.parametrize("release", [16, 19])
def test_studio_that_reports_only_to_handlers_has_no_shadow(tmp_path: Path, release: int) -> None:
    with pytest.raises(ConfigError, match="without leaving handlers"):
        shadow(tmp_path, "Nanosurf", f"release = {release}\n").require_valid()


def test_driver_without_a_shadow_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no shadow"):
        shadow(tmp_path, "Simulator")


def test_experiment_without_a_controller_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text('[scheduler]\ncomponent = true\nclass = "Scheduler"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="no controller to watch"):
        shadow_overlay(load(file).resolved, tmp_path)


@pytest.mark.parametrize(
    ("maker", "settings", "has_lines"),
    [
        ("nanonis", "", True),
        ("Asylum", "", False),
        ("gxsm", "", True),
        ("park", "", False),
        ("nanosurf", "[microscope]\nrelease = 18\n", False),
    ],
)
def test_maker_alone_gives_all_detectors(tmp_path: Path, maker: str, settings: str, has_lines: bool) -> None:
    own = tmp_path / "own.toml"
    own.write_text(settings, encoding="utf-8")
    files = (shadow_file(maker, tmp_path), own)
    experiment = load(*files, shadow_overlay(load(*files).resolved, tmp_path))
    experiment.require_valid()
    assert {"scheduler", "classifier"} <= experiment.resolved.processes.keys()
    assert ("lines" in experiment.resolved.processes) is has_lines


def test_unknown_maker_is_refused_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no driver 'nanoniss'") as caught:
        shadow_file("nanoniss", tmp_path)
    assert "nanonis" in caught.value.hint
