"""`Bench`: components in one process, with real decisions and faults on request."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from afspm import Component, ControlMode, Scan, wire
from afspm.basics.errors import ConfigError
from afspm.components.planned_scans import RegionGrid, ScanList, ScanSeries
from afspm.testing import Bench
from afspm.testing.skeletons import write

SIZE = (1e-6, 1e-6)


class Watch(Component):
    period_s = 5.0


class Roughness(Component):
    """Publishes a message about each scan."""

    publishes = ("SpatialROIWithScoreList",)

    def on_scan(self, scan: Scan) -> None:
        if scan.channel == "Height":
            self.publish(wire.message_type("SpatialROIWithScoreList")(channel=scan.channel))


def series(**microscope: object) -> Bench:
    return Bench(ScanSeries(SIZE, pixels=(8, 8), every=1800.0, scans=4), microscope=microscope)


def test_series_takes_its_scans() -> None:
    bench = series()
    bench.run(until="30 min")
    assert 1 <= len(bench.scans) < 4
    assert not bench.is_done
    bench.run(until="2 h")
    assert len(bench.scans) == 4
    assert bench.is_done


def test_same_seed_gives_the_same_scans() -> None:
    values = []
    for _ in range(2):
        bench = series()
        bench.run(until="1 h")
        values.append([scans.first.values.tobytes() for scans in bench.scans])
    assert values[0] == values[1]
    assert values[0]


@pytest.mark.parametrize("process", ["", "scheduler", "translator"])
def test_series_is_complete_after_a_kill(process: str) -> None:
    bench = series()
    for when in ("1 s", "31 min"):
        bench.at(when, bench.kill, process)
    bench.run(until="2 h")
    assert bench.is_done
    assert len(bench.scans) == 4


def test_component_without_restart_stays_dead() -> None:
    bench = series()
    bench.run(until="20 min")
    bench.kill(restarts=False)
    bench.run(until="3 h")
    assert len(bench.scans) == 1


def test_flagged_problem_stops_the_series_until_cleared() -> None:
    bench = series()
    bench.run(until="20 min")
    bench.flag("tip-shape-changed")
    assert bench.problems == ("tip-shape-changed",)
    bench.run(until="2 h")
    assert len(bench.scans) == 1
    bench.clear("tip-shape-changed")
    bench.run(until="6 h")
    assert len(bench.scans) == 4


def test_manual_mode_stops_the_series() -> None:
    bench = series()
    bench.at("20 min", bench.set_mode, ControlMode.MANUAL)
    bench.run(until="2 h")
    assert bench.control_state.mode is ControlMode.MANUAL
    assert len(bench.scans) == 1
    bench.set_mode(ControlMode.AUTOMATED)
    bench.run(until="6 h")
    assert len(bench.scans) == 4


def test_series_survives_a_lost_connection() -> None:
    bench = series()
    bench.at("1 s", bench.lose_connection, "1 min")
    bench.run(until="3 h")
    assert len(bench.scans) == 4


def test_refusal_reaches_the_component() -> None:
    class Once(Component):
        def run(self) -> None:
            self.scope.action("engage")

    bench = Bench(Once())
    bench.refuse("engage", reason="the motor is off", times=99)
    with pytest.raises(Exception, match="the motor is off"):
        bench.run(until="1 h")


def test_error_of_the_component_is_raised() -> None:
    class Broken(Component):
        def on_scan(self, scan: Scan) -> None:
            raise ZeroDivisionError("mine")

    scans = ScanSeries(SIZE, pixels=(8, 8), scans=1)
    with pytest.raises(ZeroDivisionError, match="mine"):
        Bench(Broken(), others={"series": scans}).run(until="1 h")


def test_error_of_a_script_is_raised() -> None:
    class BrokenScript(Component):
        def run(self) -> None:
            raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        Bench(BrokenScript()).run(until="1 min")


@pytest.mark.parametrize(
    ("component", "scans"),
    [
        (ScanSeries(SIZE, pixels=(8, 8), scans=2), 2),
        (ScanList([{"center": (0.0, 0.0), "size": SIZE}], pixels=(8, 8), rounds=2), 2),  # type: ignore[list-item]
        (RegionGrid(SIZE, (2, 2), pixels=(8, 8)), 4),
    ],
)
def test_our_planned_components_run_on_the_bench(component: Component, scans: int) -> None:
    bench = Bench(component, dies_in_call=0.01)
    bench.run(until="2 h")
    assert bench.is_done
    assert len(bench.scans) == scans


def test_benches_leave_no_thread() -> None:
    before = set(threading.enumerate())
    for _ in range(10):
        # a component that never ends, a killed one, and a plan that holds the bench
        bench = Bench(Watch(), others={"series": ScanSeries(SIZE, pixels=(8, 8), scans=1)})
        bench.at("10 s", bench.kill, "translator")
        bench.at("2 h", lambda bench=bench: bench.kill())
        bench.run(until="1 min")
    assert len(bench.scans) == 1
    left = [thread for thread in threading.enumerate() if thread not in before and thread.name != "syncer"]
    assert left  # of the newest bench, which may still run
    del bench
    # a component's thread holds its memory, whose thread writes to the disk
    for threads in ([one for one in left if one.name != "disk"], left):
        gc.collect()
        for thread in threads:
            thread.join(60.0)
    assert not [thread.name for thread in left if thread.is_alive()]


# contributors K6: four of five threads waited for the garbage collector
def test_closed_bench_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    bench = series()
    bench.run(until="1 min")
    left = [thread for thread in threading.enumerate() if thread not in before and thread.name != "syncer"]
    assert "disk" in {thread.name for thread in left}
    bench.close()
    for thread in left:
        thread.join(60.0)
    assert not [thread.name for thread in left if thread.is_alive()]
    assert len(bench.scans) == 1


def test_closed_bench_keeps_its_results_and_runs_no_more() -> None:
    bench = series()
    bench.run(until="1 min")
    folder = bench.folder
    bench.close()
    bench.close()
    assert len(bench.scans) == 1
    assert not folder.exists()
    with pytest.raises(ConfigError, match="closed"):
        bench.run(until="1 h")


def test_messages_of_components_and_of_the_microscope_are_published() -> None:
    bench = Bench(Roughness(), others={"series": ScanSeries(SIZE, pixels=(8, 8), scans=2)})
    bench.run(until="10 min")
    found = bench.published("SpatialROIWithScoreList")
    assert [one.channel for one in found] == ["Height", "Height"]
    assert bench.published("ScopeStateMsg")
    assert not bench.published("Spec1d")


def test_unknown_process_and_past_time_are_refused() -> None:
    bench = series()
    bench.run(until="1 min")
    with pytest.raises(ConfigError, match="no process"):
        bench.kill("nothing")
    with pytest.raises(ConfigError, match="has passed"):
        bench.run(until="1 s")


def test_generated_test_passes(tmp_path: Path) -> None:
    folder = write("component", "height-watch", tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "1 passed" in ran.stdout
