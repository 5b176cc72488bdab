"""Events are kept in order, bounded, and reported as missed where they are not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from afspm.model import (
    ControlMode,
    ControlState,
    LogLine,
    ProblemNames,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Region,
    Scan,
    ScopeState,
    ScopeStatus,
)
from afspm.model.events import LogLines
from afspm.plugins.web.gateway.events import MOST_BYTES, MOST_EVENTS, EventHistory, fill
from afspm.plugins.web.gateway.models import event_kinds
from afspm.record import JOURNAL_FILE

ALL = frozenset(event_kinds())


def history(*times_ns: int) -> EventHistory:
    made = EventHistory(ProblemNames())
    for time_ns in times_ns:
        made.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), time_ns)
    return made


def times(made: EventHistory, after_ns: int) -> list[int]:
    return [event.time_ns for event in made.after(after_ns, ALL, 1000).events]


def test_a_client_continues_after_its_last_event() -> None:
    made = history(10, 20, 30)
    assert times(made, 20) == [30]
    assert times(made, 15) == [20, 30]
    assert times(made, -1) == [10, 20, 30]
    assert times(made, 30) == []


def test_replayed_messages_are_no_new_events() -> None:
    made = history(10, 20, 10, 20, 30)
    assert times(made, -1) == [10, 20, 30]


def test_only_the_requested_kinds_of_events_are_returned() -> None:
    made = history(10)
    made.take("ControlState", ControlState(ControlMode.MANUAL, None, (1,)), 20)
    batch = made.after(-1, {"control"}, 1000)
    assert [event.kind for event in batch.events] == ["control"]
    told = json.loads(batch.events[0].text)["data"]
    assert told == {"mode": "MANUAL", "holder": None, "problems": ["tip-shape-changed"]}
    made.take("ScopeStateMsg", ScopeStatus(ScopeState.SCANNING), 30)
    batch = made.after(20, {"control"}, 1000)
    assert (batch.events, batch.newest_ns) == ((), 30)


def test_events_that_left_the_memory_are_reported_as_missed() -> None:
    made = history(*range(1, MOST_EVENTS + 10))
    oldest = made.after(-1, ALL, 1)
    assert oldest.missed_until_ns == oldest.events[0].time_ns - 1
    assert made.after(MOST_EVENTS, ALL, 1).missed_until_ns is None


def test_long_events_take_bounded_memory() -> None:
    made = EventHistory(ProblemNames())
    for time_ns in range(1, 40):
        made.take("LogLines", LogLines((LogLine(time_ns, "x", "INFO", "x" * 1_000_000),)), time_ns)
    kept = made.after(-1, ALL, 1000)
    assert kept.missed_until_ns is not None
    assert sum(len(event.text) for event in kept.events) <= MOST_BYTES


def test_processes_are_an_event_only_when_more_than_the_age_of_a_step_has_changed() -> None:
    made = EventHistory(ProblemNames())

    def take(time_ns: int, supervisor: str, condition: ProcessCondition, age_s: float) -> None:
        state = ProcessState("series", "component", condition, 1, age_s)
        made.take("ProcessStates", ProcessStates(time_ns, supervisor, (state,)), time_ns)

    for time_ns in range(10, 1000, 2):
        take(time_ns, "here", ProcessCondition.ALIVE, time_ns / 7)
        take(time_ns + 1, "there", ProcessCondition.BUSY, time_ns / 7)
    take(1001, "here", ProcessCondition.ENDED, 0.0)
    assert times(made, -1) == [10, 11, 1001]


def test_times_are_texts_and_values_are_left_out() -> None:
    made = EventHistory(ProblemNames())
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.full((2, 3), np.nan), 2**60)
    made.take("Scan2d", scan, 2**60 + 1)
    made.take("LogLines", LogLines((LogLine(2**60, "x", "INFO", "said"),)), 2**60 + 2)
    first, second = (json.loads(event.text)["data"] for event in made.after(-1, ALL, 10).events)
    assert (first["id"], first["shape"]) == (str(2**60), [2, 3])
    assert "values" not in first
    assert second["lines"][0]["time_ns"] == str(2**60)


def test_a_past_from_the_cache_alone_is_reported_as_incomplete() -> None:
    made = history(10, 20)
    made.incomplete_before(15)
    assert made.after(5, ALL, 10).missed_until_ns == 15
    assert made.after(15, ALL, 10).missed_until_ns is None


def test_damaged_journal_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / JOURNAL_FILE).write_bytes(b"damaged")
    fill(EventHistory(ProblemNames()), tmp_path, None, 100)
    (line,) = caplog.messages
    assert line.startswith("older events are not served: "), line
