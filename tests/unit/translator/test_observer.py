"""Lines of a running scan, published during the scan."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.basics.shared_time import Publication
from afspm.model import ControlRequest, Region, ScanLines, ScopeState, ScopeStatus, names
from afspm.simulation.scan_drawing import run_at_once
from afspm.simulation.simulator import Simulator
from afspm.translator.observer import LiveLines

REGION = Region((0.0, 0.0), (1e-6, 1e-6))


@pytest.fixture
def live(make_live_bench: Any) -> Any:
    bench = make_live_bench({"live_lines_s": 1.0})
    bench.heard()
    return bench


def published(bench: Any) -> list[ScanLines]:
    packets, bench.port.packets = bench.port.packets, []
    return [thing for name, thing, _ in packets if name == "ScanLines"]


def test_new_lines_are_published_at_the_set_period(live: Any) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.microscope.there = 3
    live.look(0.5)
    assert published(live) == []
    live.look(0.5)
    first = published(live)
    assert [(lines.channel, lines.first_row, lines.values[:, 0].tolist()) for lines in first] == [
        ("Height", 0, [0, 1, 2]),
        ("Phase", 0, [0, 1, 2]),
    ]
    live.microscope.there = 5
    live.look(1.0)
    second = published(live)
    assert [(lines.first_row, len(lines.values)) for lines in second] == [(3, 2), (3, 2)]
    assert first[0].began_ns == second[0].began_ns == 1_000_000_000_000
    live.look(1.0)
    assert published(live) == []  # nothing new


def test_the_next_scan_begins_with_its_first_line(live: Any, scan: Any) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.microscope.there = 8
    live.look(1.0)
    began_ns = published(live)[0].began_ns
    assert began_ns is not None
    live.microscope.files["a"], live.microscope.state = [scan()], ScopeState.FREE
    live.look(1.0)
    live.look(1.0)
    assert published(live) == []
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.microscope.there = 1
    live.look(1.0)
    again = published(live)[0]
    assert (again.first_row, len(again.values)) == (0, 1)
    assert again.began_ns == began_ns + 3_000_000_000


def test_lines_go_on_after_a_pause(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.microscope.there = 3
    live.look(1.0)
    [began_ns] = {lines.began_ns for lines in published(live)}
    with monkeypatch.context() as patch:
        patch.setattr(live.microscope, "status", lambda: ScopeStatus(ScopeState.SCANNING, paused=True))
        live.look(5.0)
    live.microscope.there = 5
    live.look(1.0)
    assert {(lines.began_ns, lines.first_row, len(lines.values)) for lines in published(live)} == {(began_ns, 3, 2)}


def test_restarted_translator_publishes_the_lines_of_a_running_scan_from_its_first(live: Any) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.microscope.there = 3
    live.look(1.0)
    live.start()
    live.microscope.there = 5
    live.look(1.0)
    assert [(lines.first_row, len(lines.values)) for lines in published(live)] == [(0, 5), (0, 5)]
    live.microscope.state = ScopeState.FREE
    live.look(20.0)
    live.look(20.0)
    live.start()
    live.look(20.0)
    assert published(live) == []


def test_lines_that_cannot_be_read_do_not_lose_the_controller(
    live: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.heard()

    def refuse(self: Any, start: int) -> list[ScanLines]:
        raise InvalidValue("the channel is not acquired")

    with monkeypatch.context() as patch:
        patch.setattr(type(live.microscope), "lines", refuse)
        for _ in range(5):
            live.look(1.0)
    assert live.heard() == []
    assert caplog.text.count("no more lines of this scan are published") == 1
    live.microscope.lost = True
    live.look(1.0)
    assert live.heard() == ["UNDEFINED"]


def test_lines_are_not_cached_for_late_joiners(live: Any) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.heard()
    live.microscope.there = 8
    live.look(1.0)
    assert live.port.kept == []
    assert published(live)


def test_lines_are_read_when_due(live: Any) -> None:
    live.ask(ControlRequest.ACTION, names.START_SCAN)
    live.look(0.99)
    assert live.translator.wait_s() <= 0.0101


def test_lines_are_not_read_without_the_setting(make_live_bench: Any) -> None:
    bench = make_live_bench(None)
    bench.microscope.there = 3
    bench.ask(ControlRequest.ACTION, names.START_SCAN)
    for _ in range(50):
        bench.look(1.0)
    assert published(bench) == []


def test_driver_without_lines_refuses_the_setting(make_bench: Any) -> None:
    with pytest.raises(ConfigError, match="does not publish lines"):
        make_bench({"live_lines_s": 1.0})


@pytest.mark.parametrize("direction", ["up", "down"])
def test_the_simulators_lines_make_up_its_scan(direction: str, tmp_path: Path, fake_clock: Any) -> None:
    simulator = Simulator(initial={"scan-resolution-x": 8, "scan-resolution-y": 16, "x-scan-direction": direction})
    simulator.clock, simulator.log, simulator.run_dir = fake_clock, logging.getLogger("test"), tmp_path
    simulator.memory, simulator.wake = {}, lambda: None
    simulator.run_drawing = run_at_once  # type: ignore[method-assign]
    simulator.connect()
    simulator.start_scan()  # 16 lines of a second
    pictures: dict[str, np.ndarray] = {}
    start = 0
    for seconds, rows in ((0.5, 0), (3.0, 3), (3.0, 3), (9.0, 9)):
        fake_clock.t_s += seconds
        new = simulator.lines(start)
        assert {len(lines.values) for lines in new} == ({rows} if rows else set())
        start += rows
        for lines in new:
            pictures[lines.channel] = lines.into(pictures.get(lines.channel))
    missing = 0 if direction == "down" else 15
    assert np.isnan(pictures["Height"]).all(axis=1).nonzero()[0].tolist() == [missing]
    fake_clock.t_s += 10.0
    assert simulator.status().state is ScopeState.FREE
    for scan in simulator.load(simulator.results()[-1]):
        taken = ~np.isnan(pictures[scan.channel])  # type: ignore[union-attr]
        assert np.array_equal(pictures[scan.channel][taken], scan.values[taken])  # type: ignore[union-attr]


@pytest.mark.parametrize(("given", "every_s"), [(None, 120.0), (0.0, None), (3.0, 3.0)])
def test_a_simulated_microscope_publishes_lines_by_real_time(given: float | None, every_s: float | None) -> None:
    driver = Simulator(live_lines_s=given)
    driver.clock = ExperimentClock.starting_now(speed=240.0)
    live = LiveLines(driver)
    live.begin(0)
    assert live.due_s == every_s


def test_lines_are_read_during_a_scan_if_a_fast_clock_waits_for_their_receiver(tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=1200.0).waiting_in(tmp_path / "time")
    driver = Simulator()
    driver.clock = clock
    live = LiveLines(driver)
    began_ns = clock.now_ns()
    live.begin(began_ns, lasts_s=0.33)  # of 396 s
    assert live.due_s == pytest.approx(began_ns / NS_PER_S + 600.0, abs=1.0)
    assert live.awaited_s is None
    with clock.late(Publication.LINES):
        live.begin(clock.now_ns(), lasts_s=0.33)
        assert live.awaited_s is not None
        assert live.awaited_s - clock.now_s() < 24.1  # 16 times in 396 s


def test_result_of_a_scan_that_the_next_followed_at_once_is_published_during_that(make_bench: Any, scan: Any) -> None:
    bench = make_bench()
    bench.heard()
    bench.microscope.state = ScopeState.SCANNING  # at the panel, which repeats it
    bench.look()
    assert bench.heard() == ["SCANNING"]
    bench.microscope.files["a"] = [scan()]
    bench.look(4.0)
    bench.look(4.0)
    assert bench.heard() == [], "the scan may be ending just now"
    bench.look(4.0)
    assert bench.heard() == ["Scan2d", "FREE", "SCANNING"]
    assert bench.ask(ControlRequest.ACTION, names.STOP_SCAN).ok
    bench.look()
    assert bench.heard() == ["INTERRUPTED", "FREE"]
