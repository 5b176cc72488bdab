"""Every sample checks without a finding, can be drawn and could be started."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from makers import MAKERS

from afspm.experiment import Experiment, load
from afspm.experiment.graph import draw
from afspm.transport.keys import generate

EXPERIMENTS = Path(__file__).parents[3] / "experiments"
WITHOUT_A_MICROSCOPE = "every_microscope"  # its second file has it
SECOND_FILES = sorted(p.name for p in (EXPERIMENTS / WITHOUT_A_MICROSCOPE).glob("*.toml") if p.stem != "experiment")
SECOND_FILES += [str(maker.emulated) for maker in MAKERS.values()]
NAMES = sorted(
    file.parent.name
    for file in EXPERIMENTS.glob("*/experiment.toml")
    if not file.read_text(encoding="utf-8").startswith("# Needs a package:")  # it is tried by the package's tests
)
OF_DRIFT = [f"{name}.toml" for name in ("simulator", "stm-4k", *(name.lower() for name in MAKERS))]
SAMPLES: list[tuple[str, ...]] = [(name,) for name in NAMES if name not in (WITHOUT_A_MICROSCOPE, "drift_night")]
SAMPLES += [("drift_night", second) for second in OF_DRIFT]
SAMPLES += [("best_points", "drift.toml"), ("tip_repair", "stm-4k.toml")]
SAMPLES += [(WITHOUT_A_MICROSCOPE, second) for second in SECOND_FILES]


def sample(name: str, *overlays: str) -> Experiment:
    folder = EXPERIMENTS / name
    return load(folder / "experiment.toml", *(folder / overlay for overlay in overlays))


@pytest.mark.parametrize("files", SAMPLES, ids=" ".join)
def test_a_sample_has_nothing_wrong(files: tuple[str, ...]) -> None:
    experiment = sample(*files)
    assert experiment.check() == []
    assert experiment.name == files[0]
    assert (EXPERIMENTS / files[0] / "README.md").exists()


@pytest.mark.parametrize("files", SAMPLES, ids=" ".join)
def test_a_sample_can_be_drawn_and_started(files: tuple[str, ...]) -> None:
    experiment = sample(*files)
    assert all(part in draw(experiment) for part in experiment.component_names)
    ports = itertools.count(20000)
    starts = experiment.launches(take_address=lambda: f"tcp://127.0.0.1:{next(ports)}")
    assert {start.launch.name for start in starts} == set(experiment.component_names)


def test_a_small_file_ports_an_experiment_to_another_microscope() -> None:
    ported = sample("keep_scanning", "small_scanner.toml")
    assert ported.check() == []
    assert ported.resolved.processes["series"].settings["size"] == pytest.approx([500e-9, 500e-9])
    assert ported.resolved.processes["series"].settings["every"] == 900.0
    assert ported.resolved.limits.region is not None


def test_the_laboratory_s_file_of_two_computers_needs_its_keys(tmp_path: Path) -> None:
    without = sample("two_computers", "lab.toml")
    assert ["there is no folder" in finding.what for finding in without.check()] == [True]
    generate(tmp_path / "keys", without.component_names)
    lab = tmp_path / "lab.toml"
    lab.write_text((EXPERIMENTS / "two_computers" / "lab.toml").read_text(encoding="utf-8"), encoding="utf-8")
    experiment = load(EXPERIMENTS / "two_computers" / "experiment.toml", lab)
    assert experiment.check() == []
    (series,) = experiment.launches(take_address=lambda: "tcp://127.0.0.1:20000", only=["series"])
    assert series.launch.sockets.control == "tcp://192.168.1.20:29002"


def test_paper_s_form_and_short_form_are_the_same_experiment() -> None:
    short, long = sample("tip_repair").resolved, sample("paper_form").resolved
    for name in ("scheduler", "series", "tip_classifier", "tip_corrector"):
        assert long.processes[name].settings == short.processes[name].settings
        assert long.processes[name].class_path == short.processes[name].class_path
    assert long.processes["translator"].settings == short.processes["microscope"].settings
    assert long.limits.region == short.limits.region


def test_the_paper_s_drift_method_has_the_values_of_its_table() -> None:
    experiment = sample("drift_night", "simulator.toml", "paper.toml")
    assert experiment.check() == []
    drift, series = (experiment.resolved.processes[name].settings for name in ("scheduler", "series"))
    ransac = {"transform": "translation", "residual_threshold": 0.05, "iterations": 100, "tighten": False}
    assert drift["drift"]["estimator"] == {"class": "brief", **ransac}
    tracker, rescan = drift["drift"]["tracker"], drift["drift"]["rescan"]
    assert tracker == {"class": "paper", "transform": "translation", "f_min": 0.5, "sr_norm_min": 0.25, "w_update": 1.0}
    assert (rescan["rule"], rescan["f_rescan"]) == ("paper", 0.75)
    assert (series["size"], series["pixels"], series["every"]) == (pytest.approx([2e-6, 2e-6]), [128, 128], 900.0)
    assert experiment.resolved.metadata()["probe"] == "MikroMasch HQ:NSC15/Al, 40 N/m, 325 kHz"


def test_the_published_form_of_the_drift_night_has_nothing_wrong() -> None:
    assert load(EXPERIMENTS / "paper_form" / "drift.toml").check() == []
