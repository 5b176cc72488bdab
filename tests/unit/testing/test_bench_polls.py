"""A bench that skips idle polls of the microscope: the same packets as with all polls."""

from __future__ import annotations

import random
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from rotation import rotated

from afspm import Component, ControlMode, wire
from afspm.basics.errors import ConfigError, Refused
from afspm.components.planned_scans import ScanSeries
from afspm.model import names
from afspm.simulation.simulator import Simulator
from afspm.testing import Bench
from afspm.testing.components.bench_microscope import POLLS, Polls, PollWasNotIdle
from afspm.translator.observer import Observer

SIZE = (1e-6, 1e-6)
REPAIR = """
[microscope]
component = true
class = "Simulator"
surface = { kind = "particles" }
initial = { scan-speed = "4 um/s" }
[scheduler]
component = true
class = "Scheduler"
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "5 min"
scans = 6
[tip_classifier]
component = true
class = "TipClassifier"
[tip_corrector]
component = true
class = "TipCorrector"
workshop_center = ["8 um", "0 um"]
test_center = ["0 um", "4 um"]
"""
BLINK = {"x-blink": {"set": {"tip-bias-voltage": "1 V"}, "for": "3 s"}}
RESTLESS = """
from afspm.simulation.simulator import Simulator

class Restless(Simulator):
    def get(self, vendor):
        if vendor == "zctrl-pgain" and self.clock.now_s() > self.memory["start_s"] + 100.1:
            return 0.25
        return super().get(vendor)
"""
HALF_AN_HOUR_S = 1800.0

Polled = Callable[[Polls], Bench]
"""Returns a bench with these polls, after its night."""


class Treatments(Component):
    """Sets, pulses and takes spectra between the scans."""

    period_s = 170.0

    def on_tick(self) -> None:
        ticks = self.memory["ticks"] = self.memory.get("ticks", 0) + 1
        with self.scope.control():
            if ticks % 3 == 0:
                self.scope.set("zctrl-setpoint", 0.1 * ticks)
                self.scope.action("x-blink")
            elif ticks % 3 == 1:
                self.scope.spectrum((1e-7 * ticks, 0.0))
            else:
                self.scope.action(names.PULSE)


def polled(folder: Path, polls: Polls, component: Component | None = None, **microscope: object) -> Bench:
    series = ScanSeries(SIZE, pixels=(8, 8), every=300.0, scans=4)
    others = {"treatments": component} if component else {}
    return Bench(series, others=others, microscope=microscope, folder=new(folder), polls=polls)


def new(folder: Path) -> Path:
    """Return an empty folder, the same for both nights: scans are published with the paths of their files."""
    made = folder / "night"
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    return made


def published(bench: Bench) -> Sequence[tuple[str, int | None, bytes]]:
    return [(packet.envelope, packet.time_ns, bytes(packet.payload)) for packet in bench.packets]


def messages(bench: Bench) -> set[str]:
    return {packet.envelope.partition("_")[0] for packet in bench.packets}


def same_both_ways(night: Polled) -> Bench:
    """Check that a night has the same packets with all polls and without the idle ones; return the latter."""
    every, needed = night("all"), night("needed")
    # first the envelopes: a difference of payloads in bytes can't be read
    assert [packet.envelope for packet in needed.packets] == [packet.envelope for packet in every.packets]
    assert published(needed) == published(every)
    assert needed.packets
    return needed


def test_series_with_a_repaired_tip_is_the_same_with_few_polls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks: Counter[str] = Counter()
    look = Observer.look

    def night(polls: Polls) -> Bench:
        file = tmp_path / "experiment.toml"
        file.write_text(REPAIR, encoding="utf-8")
        bench = Bench.of(file, component="series", folder=new(tmp_path), polls=polls)
        bench.at("12 min", bench.change_tip, "double")
        monkeypatch.setattr(Observer, "look", lambda self: (looks.update([polls]), look(self)))
        bench.run(until="60 min")
        return bench

    bench = same_both_ways(night)
    assert bench.is_done
    assert bench.components["tip_corrector"].memory
    assert not bench.problems
    assert looks["needed"] < 0.1 * looks["all"], looks


def test_person_at_the_panel_is_seen_by_the_same_polls(tmp_path: Path) -> None:
    panel = [
        {"at_s": 100.0, "set": {"zctrl-pgain": 0.25}},  # on the time of a poll
        {"at_s": 150.1, "set": {"scan-size-x": "700 nm"}},
        {"at_s": 200.1, "action": names.START_SCAN},
        {"at_s": 301.9, "set": {"zctrl-igain": 12.0}},  # during a scan of the series
        {"at_s": 605.03, "action": names.STOP_SCAN},
        {"at_s": 700.2, "action": names.START_SPEC},
        {"at_s": 800.0, "set": {"probe-pos-x": "2 um"}},
        {"at_s": 1450.7, "action": names.RETRACT},
        {"at_s": 1451.2, "action": names.ENGAGE},
    ]

    def night(polls: Polls) -> Bench:
        bench = polled(tmp_path, polls, panel=panel)
        bench.run(until=HALF_AN_HOUR_S)
        return bench

    bench = same_both_ways(night)
    assert {"ZCtrlParameters", "ScanParameters2d", "Spec1d", "ProbePosition"} <= messages(bench)


def test_faults_of_the_microscope_are_seen_by_the_same_polls(tmp_path: Path) -> None:
    faults = [
        {"kind": "late-file", "at_s": 0.0, "duration_s": 4.3},
        {"kind": "half-file", "at_s": 300.0, "duration_s": 3.1},
        {"kind": "restart", "at_s": 450.1, "duration_s": 30.0},
        {"kind": "stopped", "at_s": 500.0},
        {"kind": "no-file", "at_s": 700.0},
        {"kind": "scan-refused", "at_s": 900.0},
        {"kind": "error", "at_s": 1000.0},
        {"kind": "restart", "at_s": 1502.0, "duration_s": 2.0},
    ]

    def night(polls: Polls) -> Bench:
        bench = polled(tmp_path, polls, faults=faults)
        bench.run(until=HALF_AN_HOUR_S)
        return bench

    same_both_ways(night)


@pytest.mark.parametrize("name", ["", "scheduler", "translator"])
def test_killed_processes_and_lost_connections_give_the_same(tmp_path: Path, name: str) -> None:
    def night(polls: Polls) -> Bench:
        bench = polled(tmp_path, polls)
        bench.at(302.0, bench.kill, name)
        bench.at(450.25, bench.lose_connection, "10 s")
        bench.at("8 min", bench.kill, name)
        bench.run(until=620.0)
        bench.kill(name)  # between two runs
        bench.flag("tip-shape-changed")
        bench.run(until=900.1)
        bench.clear("tip-shape-changed")
        bench.set_mode(ControlMode.MANUAL)
        bench.run(until=1000.0)
        bench.set_mode(ControlMode.AUTOMATED)
        bench.run(until=HALF_AN_HOUR_S)
        return bench

    assert same_both_ways(night).is_done


def test_settings_spectra_and_treatments_are_seen_by_the_same_polls(tmp_path: Path) -> None:

    def night(polls: Polls) -> Bench:
        bench = polled(tmp_path, polls, Treatments(), actions=BLINK)
        bench.run(until=HALF_AN_HOUR_S)
        return bench

    bench = same_both_ways(night)
    assert bench.components["treatments"].memory["ticks"] >= 6
    assert "Spec1d" in messages(bench)


@pytest.mark.parametrize("seed", rotated(range(8), 4))
def test_nights_at_random_are_the_same(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)

    def moment() -> float:
        # often exactly at a poll
        return chance.choice((round(chance.uniform(1.0, 1100.0) * 4) / 4, chance.uniform(1.0, 1100.0)))

    acts: list[dict[str, object]] = [{"action": names.STOP_SCAN}, {"action": names.START_SCAN}]
    acts += [{"set": {"zctrl-pgain": gain}} for gain in (0.2, 0.3, 0.4)]
    panel = [{"at_s": moment(), **chance.choice(acts)} for _ in range(6)]
    kinds = ("late-file", "half-file", "no-file", "restart", "stopped", "withdrawn", "error", "scan-refused")
    faults = [
        {"kind": chance.choice(kinds), "at_s": moment(), "duration_s": chance.choice((0.1, 1.0, 12.0))}
        for _ in range(3)
    ]
    kills = [(moment(), chance.choice(("", "scheduler", "translator"))) for _ in range(3)]
    cuts = [(moment(), chance.choice((0.0, 3.0))) for _ in range(2)]

    def night(polls: Polls) -> Bench:
        bench = polled(tmp_path, polls, Treatments(), panel=panel, faults=faults, live_lines_s=lines_s, actions=BLINK)
        for when, name in kills:
            bench.at(when, bench.kill, name)
        for when, for_s in cuts:
            bench.at(when, bench.lose_connection, for_s)
        try:
            bench.run(until=1200.0)
            ends.append("")
        except Refused as error:  # a scan after the tip was withdrawn at the panel
            ends.append(str(error))
        return bench

    lines_s = chance.choice((0.0, 0.5, 2.3))
    ends: list[str] = []
    same_both_ways(night)
    assert ends[0] == ends[1]


def test_change_that_the_translator_misses_is_missed_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bench that told the translator of a change would find nothing wrong."""
    read = Observer._read
    monkeypatch.setattr(Observer, "_read", lambda self: self.values or read(self))

    def night(polls: Polls) -> Bench:
        bench = polled(tmp_path, polls, panel=[{"at_s": 100.1, "set": {"zctrl-pgain": 0.25}}])
        bench.run(until="3 min")
        return bench

    bench = same_both_ways(night)
    gains = [wire.decode("ZCtrlParameters", one.payload) for one in bench.packets if one.envelope == "ZCtrlParameters"]
    assert gains
    assert not any(one.proportional_gain == 0.25 for one in gains)


@pytest.mark.parametrize("forgotten", ["panel", "faults", "lines"])
def test_poll_that_is_no_idle_one_ends_a_checked_night(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forgotten: str
) -> None:
    """A night with all polls finds that a bench would skip too many."""
    if forgotten == "lines":
        monkeypatch.setattr(Observer, "idle_until_s", lambda self: float("inf"))
    else:
        monkeypatch.setattr(Simulator, "next_event_s", lambda self: self.next_change_s() or float("inf"))
    acts: dict[str, dict[str, Any]] = {
        "panel": {"panel": [{"at_s": 100.1, "set": {"zctrl-pgain": 0.25}}]},
        "faults": {"faults": [{"kind": "restart", "at_s": 100.0, "duration_s": 5.0}]},
        "lines": {"live_lines_s": 2.0},
    }
    bench = polled(tmp_path, "checked", **acts[forgotten])
    with pytest.raises(PollWasNotIdle):
        bench.run(until="3 min")


def test_class_derived_from_the_simulated_microscope_is_polled_at_all_times(tmp_path: Path) -> None:
    """Its answers may change without an event of the simulator."""
    tmp_path.joinpath("restless.py").write_text(RESTLESS, encoding="utf-8")
    file = tmp_path / "experiment.toml"
    file.write_text(REPAIR.replace('"Simulator"', '"restless.Restless"'), encoding="utf-8")

    def night(polls: Polls) -> Bench:
        bench = Bench.of(file, component="series", folder=new(tmp_path), polls=polls)
        bench.run(until="3 min")
        return bench

    bench = same_both_ways(night)
    gains = [wire.decode("ZCtrlParameters", one.payload) for one in bench.packets if one.envelope == "ZCtrlParameters"]
    assert gains[-1].proportional_gain == 0.25


def test_polls_are_chosen_by_the_environment_and_a_typo_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = ScanSeries(SIZE, pixels=(8, 8), scans=1)
    monkeypatch.setenv(POLLS, "every")
    with pytest.raises(ConfigError, match="every"):
        Bench(series, folder=tmp_path)
    monkeypatch.setenv(POLLS, "all")
    Bench(series, folder=tmp_path).run(until="1 min")
