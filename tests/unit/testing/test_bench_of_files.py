"""`Bench.of`: the components of an experiment file in one process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from afspm import wire
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.testing import Bench

NIGHT = """
[microscope]
component = true
class = "Simulator"
initial = { scan-speed = "4 um/s" }
[scheduler]
component = true
class = "Scheduler"
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "10 min"
scans = 4
"""
DRIFTS = """
[microscope]
surface = { kind = "particles" }
drift = { velocity_m_per_s = [40e-12, -20e-12, 0.0] }
[scheduler]
class = "DriftCompensatedScheduler"
[rescanner]
component = true
class = "Rescanner"
"""
OWN = """
from afspm import Component, wire

class Judge(Component):
    publishes = ("SpatialROIWithScoreList",)

    def on_scan(self, scan):
        self.publish(wire.message_type("SpatialROIWithScoreList")(channel=scan.channel))

class Listener(Component):
    listens = ("SpatialROIWithScoreList",)

    def on_message(self, envelope, message):
        self.memory["verdicts"] = [*self.memory.get("verdicts", []), envelope]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "experiment.toml"
    path.write_text(NIGHT, encoding="utf-8")
    return path


def overlay(file: Path, text: str) -> Path:
    path = file.with_name("overlay.toml")
    path.write_text(text, encoding="utf-8")
    return path


def test_bench_runs_the_components_of_a_file(file: Path) -> None:
    bench = Bench.of(file)
    bench.run(until="1 h")
    assert bench.name == "series"
    assert len(bench.scans) == 4
    assert bench.is_done
    assert bench.scans[0].first.values.shape == (32, 32)


def test_killed_scheduler_that_corrects_drift_goes_on_with_it(file: Path) -> None:
    bench = Bench.of(file, overlay(file, DRIFTS), component="series")
    bench.at("15 min", bench.kill, "scheduler")
    bench.run(until="1 h")
    assert bench.is_done
    found = [wire.decode("DriftMapping", one.payload) for one in bench.packets if one.envelope == "DriftMapping"]
    last = found[-1]
    drift_m = np.array(last.matrix).reshape(2, 3)[:, 2]
    passed_s = last.timestamp.seconds - found[0].timestamp.seconds
    moved_m = drift_m - np.array(found[0].matrix).reshape(2, 3)[:, 2]
    assert passed_s > 1500.0
    np.testing.assert_allclose(np.abs(moved_m), np.array([40e-12, 20e-12]) * passed_s, atol=8e-9)


def test_killed_holders_of_arrays_go_on_as_if_nothing_had_been(file: Path) -> None:
    """Arrays of a saved state are restored by the types of its fields, which numpy 2.5 changed."""
    judges = {"tip_classifier": "judge", "line_watch": "line_judge"}
    parts = (
        '[series]\nevery = "1 min"\nscans = 4\n'
        '[tip_classifier]\ncomponent = true\nclass = "TipClassifier"\n'
        '[line_watch]\ncomponent = true\nclass = "LineWatch"\n'
        '[control]\nsolved_by_hand = ["tip-shape-changed", "device-malfunction"]\n'
    )
    nights = []
    for killed in ((), ("scheduler", "translator", *judges)):
        bench = Bench.of(file, overlay(file, DRIFTS + parts), component="series")
        for number, name in enumerate(killed):
            bench.at(3.7 * 60.0 + 2.0 * number, bench.kill, name)  # between two scans
        bench.run(until="7 min")
        nights.append(bench)
    assert [bench.is_done for bench in nights] == [True, True]
    undisturbed, disturbed = ([scans.first.values for scans in bench.scans] for bench in nights)
    assert len(undisturbed) == 5, "one of them for the rescanner"
    np.testing.assert_array_equal(undisturbed, disturbed)
    memories = [[bench.components[name].memory[key] for name, key in judges.items()] for bench in nights]
    assert memories[0] == memories[1]


def test_tip_changes_on_demand(file: Path) -> None:
    values = []
    for condition in ("", "double"):
        bench = Bench.of(file)
        bench.run(until=602.0)  # during the second scan
        if condition:
            bench.change_tip(condition)
        bench.run(until="1 h")
        values.append([scans.first.values for scans in bench.scans])
    same = [np.array_equal(*pair) for pair in zip(*values, strict=True)]
    assert same == [True, False, False, False]


def test_changed_tip_outlives_a_kill_of_the_translator(file: Path) -> None:
    values = []
    for killed in (False, True):
        bench = Bench.of(file)
        bench.run(until="15 min")
        bench.change_tip("double")
        if killed:
            bench.kill("translator")
        bench.run(until="1 h")
        values.append(bench.scans[-1].first.values)
    np.testing.assert_array_equal(values[0], values[1])


def test_unknown_tip_is_refused(file: Path) -> None:
    with pytest.raises(InvalidValue, match="sharpest"):
        Bench.of(file).change_tip("sharpest")


def test_messages_of_a_component_reach_its_listeners(file: Path) -> None:
    file.with_name("own.py").write_text(OWN, encoding="utf-8")
    parts = "".join(f'[{name.lower()}]\ncomponent = true\nclass = "own.{name}"\n' for name in ("Judge", "Listener"))
    bench = Bench.of(file, overlay(file, parts))
    bench.run(until="1 h")
    assert len(bench.components["listener"].memory["verdicts"]) >= 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[page]\ncomponent = true\nclass = "Dashboard"\n', "can't run on the bench"),
        ('[series]\nscans = "many"\n', "scans"),
        ('[other]\ncomponent = true\nclass = "ScanSeries"\nsize = ["1 um", "1 um"]\n', "several components"),
    ],
)
def test_file_that_cannot_run_on_the_bench_is_refused(file: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Bench.of(file, overlay(file, text))


def test_controller_that_is_not_simulated_is_refused(file: Path) -> None:
    _, initial, rest = NIGHT.partition('class = "Simulator"\ninitial = { scan-speed = "4 um/s" }\n')
    assert initial
    file.write_text(f'[microscope]\ncomponent = true\nclass = "Nanonis"\n{rest}', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"\[microscope\] can't run on the bench"):
        Bench.of(file)
