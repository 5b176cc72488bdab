"""Text of `afspm status` on a running experiment."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from declared_messages import forget_afterwards
from google.protobuf.wrappers_pb2 import DoubleValue
from published_schemas import require_valid
from rich.console import Console

from afspm import model, wire
from afspm.basics.clock import utc_time
from afspm.basics.formatting import day_and_time
from afspm.cli.status_text import RunDescription, StatusText, bar
from afspm.model import ControlMode, ControlState, ProcessCondition, ScopeState
from afspm.model.events import LogLines
from afspm.model.planned_work import PlannedWork
from afspm.night.overview import Overview

S = 1_000_000_000
START = 1_700_000_000 * S
ABOUT = RunDescription("night", "runs/night-1", simulated=True, began_ns=START, speed=60.0)
REGION = model.Region((0.0, 0.0), (1e-6, 1e-6))


def process(name: str, condition: ProcessCondition, **more: object) -> model.ProcessState:
    return model.ProcessState(name, "component", condition, START, **more)  # type: ignore[arg-type]


def iso(time_ns: int) -> str:
    return utc_time(time_ns).isoformat()


@pytest.fixture
def night() -> Overview:
    overview = Overview()
    for after_s, message, thing in (
        (0, "ScopeStateMsg", model.ScopeStatus(ScopeState.FREE)),
        (1, "ControlState", ControlState(ControlMode.AUTOMATED, "series")),
        (2, "ScanParameters2d", model.ScanParameters(REGION, (128, 64))),
        (3, "ScopeStateMsg", model.ScopeStatus(ScopeState.SCANNING)),
        (103, "ScopeStateMsg", model.ScopeStatus(ScopeState.FREE)),
        (110, "ScopeStateMsg", model.ScopeStatus(ScopeState.SCANNING)),
        (120, "Progress", model.Progress(START + 120 * S, "series", 1, 5, 480.0)),
        (121, "ProcessStates", model.ProcessStates(START, "lab", (
            process("series", ProcessCondition.BUSY, step_age_s=12.0),
            process("judge", ProcessCondition.GIVEN_UP, last_exit="exit code 1"),
            process("grid", ProcessCondition.ENDED, last_exit="done"),
        ))),
        (122, "JournalEntries", model.JournalEntries((
            model.JournalEntry(START + 122 * S, "request", "judge", "scan-speed = 1 m/s", 9, "at most 1e-5 m/s"),
            model.JournalEntry(
                START + 123 * S, "control", "judge", "flagged", event=model.ControlEvent.PROBLEM_FLAGGED, problem=1
            ),
        ))),
        (123, "ControlState", ControlState(ControlMode.AUTOMATED, "series", (1,))),
        (124, "LogLines", LogLines((model.LogLine(START + 124 * S, "judge", "ERROR", "lost the tip [/x]"),))),
    ):  # fmt: skip
        overview.take(message, thing, START + after_s * S)
    return overview


def shown(overview: Overview, about: RunDescription = ABOUT, width: int = 140, silent_s: float = 0.0) -> str:
    console = Console(file=io.StringIO(), width=width, highlight=False, markup=False)
    console.print(StatusText(overview, about, START + 160 * S).screen(silent_s=silent_s))
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


@pytest.mark.parametrize(
    "said",
    [
        "SIMULATED",
        "running for 2 min 40 s, 60 x real time",
        "AUTOMATED, series is in control for 2 min 39 s",
        "tip-shape-changed for 37 s, flagged by judge",
        "scanning for 50 s",
        "50 % 50 s left (1 s real)",
        "1 x 1 µm, 64 x 128",
        "series: 1 of 5",
        "7 min 20 s left",
        "series (busy for 12 s)",
        "judge given up for 2 min 40 s (exit code 1)",
        "grid ended 2 min 40 s ago (done)",
        "judge: scan-speed = 1 m/s: at most 1e-5 m/s",
        "lost the tip [/x]",
    ],
)
def test_status_shows_control_microscope_and_problems(night: Overview, said: str) -> None:
    assert said in shown(night)


def test_status_of_a_replay_names_it(night: Overview) -> None:
    about = replace(ABOUT, replay_of="runs/night-0")
    assert "REPLAY" in shown(night, about)
    assert StatusText(night, about, START).as_json()["replay_of"] == "runs/night-0"
    assert "REPLAY" not in shown(night)


def test_overdue_progress_shows_no_remaining_time(night: Overview) -> None:
    night.take("Progress", model.Progress(START + 121 * S, "series", 1, 5, 10.0), START + 121 * S)
    assert "20 % longer than expected" in shown(night)
    assert "0 s left" not in shown(night).replace("50 s left", "")


def test_process_missing_from_the_states_is_not_shown_as_well(night: Overview) -> None:
    elsewhere = process("scheduler", ProcessCondition.ALIVE)
    for after_s in (121, 121 + 7 * 60):  # at 60 times real time
        now_ns = START + after_s * S
        night.take("ProcessStates", model.ProcessStates(now_ns, "other", (elsewhere,)), now_ns, "ProcessStates_other")
        is_gone = "series no report for 7 min 00 s" in shown(night)
        assert is_gone is (after_s > 121)
    assert "scheduler no report" not in shown(night)
    told: Any = StatusText(night, ABOUT, START + 600 * S).as_json()["processes"]
    assert {one["name"]: one["heard_of"] for one in told} == {
        "series": False, "judge": False, "grid": False, "scheduler": True,
    }  # fmt: skip


def test_nothing_is_cut_off_in_a_narrow_terminal(night: Overview) -> None:
    wide, narrow = shown(night, width=300), shown(night, width=30)
    assert max(map(len, narrow.splitlines())) <= 30
    assert "".join(narrow.split()) == "".join(wide.split())


def test_without_block_characters_bars_are_plain(night: Overview) -> None:
    about = RunDescription("night", "", fancy=False)
    assert shown(night, about).isascii()
    assert bar(0.5, fancy=False, width=4) == "[##..]"


def test_repeated_refusal_is_shown_once(night: Overview) -> None:
    for k in range(5):
        entry = model.JournalEntry(START + (130 + k) * S, "request", "series", "asks for control", 6, "flagged: …")
        night.take("JournalEntries", model.JournalEntries((entry,)), START + (130 + k) * S)
    assert shown(night).count("asks for control") == 1
    assert "series: asks for control (5 times): flagged: …" in shown(night)


def test_notes_are_listed_with_their_scan(night: Overview) -> None:
    scan_ns = START + 130 * S
    night.take("Scan2d", model.Scan(REGION, "Height", "m", np.zeros((4, 4)), scan_ns), scan_ns)
    for note in (
        model.Note(scan_ns, "terminal:Ada", "scratch [/x]", scan_ns),
        model.Note(scan_ns + S, "series", "dry"),
    ):
        night.take("Note", note, note.time_ns)
    text = shown(night)
    assert "terminal:Ada on scan 1: scratch [/x]" in text
    assert "series: dry" in text
    told: Any = StatusText(night, ABOUT, START + 160 * S).as_json()["notes"]
    assert [(one["who"], one["text"], one["scan"] is None) for one in told] == [
        ("terminal:Ada", "scratch [/x]", False), ("series", "dry", True),
    ]  # fmt: skip


def test_status_shows_silence(night: Overview) -> None:
    assert "no news for 30 s" in shown(night, silent_s=30.0)
    assert "no news" not in shown(night, silent_s=2.0)


def test_status_shows_since_when_mode_is_manual(night: Overview) -> None:
    night.take("ControlState", ControlState(ControlMode.MANUAL, None, (1,)), START + 130 * S)
    assert "MANUAL for 30 s" in shown(night)


def test_status_without_packets_shows_that_nothing_is_known() -> None:
    assert "not known yet" in shown(Overview())
    assert "has not reported yet" in shown(Overview())


def test_json_has_the_same_facts_as_the_text(night: Overview) -> None:
    told = json.loads(json.dumps(StatusText(night, ABOUT, START + 160 * S).as_json()))
    require_valid("status", told)
    assert (told["mode"], told["holder"], told["simulated"]) == ("AUTOMATED", "series", True)
    assert [(one["name"], one["by"]) for one in told["problems"]] == [("tip-shape-changed", "judge")]
    assert told["scan"] == {"part": 0.5, "remaining_s": 50.0}
    end = iso(START + 600 * S)
    assert told["progress"]["series"] == {"done": 1, "of": 5, "remaining_s": 440.0, "end": end}
    assert told["end"] is None, "no plans are known"
    assert [one["condition"] for one in told["processes"]] == ["BUSY", "GIVEN_UP", "ENDED"]
    assert told["refusals"][0]["reason"] == "at most 1e-5 m/s"
    assert told["log"][0]["text"] == "lost the tip [/x]"


def test_status_shows_the_end_of_the_experiment(night: Overview) -> None:
    about = replace(ABOUT, plans={"series": PlannedWork(scans=5, duration_s=500.0, ends_experiment=True), "note": None})
    end = day_and_time(START + 600 * S, seconds=False)  # of the reported pace, 440 s after the moment shown
    assert f"end about {end}, 7 min 20 s left (7 s real)" in " ".join(shown(night, about).split())
    found: Any = StatusText(night, about, START + 160 * S).as_json()["end"]
    assert found == {"time": iso(START + 600 * S), "remaining_s": 440.0}
    later: Any = StatusText(night, about, START + 700 * S).as_json()["end"]
    assert later["remaining_s"] == 0.0


def test_newest_relayed_message_of_each_component_is_shown(night: Overview, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_afterwards(monkeypatch)
    own = wire.declare(wire.MessageDeclaration(type=DoubleValue, relayed=True))
    for after_s, name, value in ((1, "level", 0.5), (2, "level", 0.25), (2, "other", 0.0)):
        night.take(own.name, DoubleValue(value=value), START + (200 + after_s) * S, f"{own.name}_{name}")
    assert "DoubleValue_level: 0.25" in " ".join(shown(night).split())
    found: Any = StatusText(night, ABOUT, START + 300 * S).as_json()["messages"]
    assert found == {
        "DoubleValue_level": {"time": iso(START + 202 * S), "content": 0.25},
        "DoubleValue_other": {"time": iso(START + 202 * S), "content": 0.0},
    }
