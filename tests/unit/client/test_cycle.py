"""One scan, followed through the published packets."""

from __future__ import annotations

import pytest

from afspm.client.cycle import Cycle, CycleOutcome
from afspm.model import ScopeState

BUSY, FREE, INTERRUPTED, MOVING = ScopeState.SCANNING, ScopeState.FREE, ScopeState.INTERRUPTED, ScopeState.MOVING

CASES = [
    ("a scan", [BUSY, "a", "b", FREE], CycleOutcome.COMPLETED, ["a", "b"]),
    ("moving before it begins", [MOVING, FREE, BUSY, "a", FREE], CycleOutcome.COMPLETED, ["a"]),
    ("interrupted", [BUSY, INTERRUPTED, FREE], CycleOutcome.INTERRUPTED, []),
    ("free without a scan", [BUSY, FREE], CycleOutcome.VANISHED, []),
    ("not begun", [FREE, MOVING, FREE], None, []),
    ("an interruption of something before", [INTERRUPTED, FREE], None, []),
    ("still running", [BUSY, "a"], None, ["a"]),
    ("another's results before it begins", ["other", FREE, BUSY, "a", FREE], CycleOutcome.COMPLETED, ["a"]),
    ("its beginning was lost", ["a", "b", FREE], CycleOutcome.COMPLETED, ["a", "b"]),
    ("begun once more in the middle", [BUSY, "a", BUSY, "b", FREE], CycleOutcome.COMPLETED, ["b"]),
    ("what comes after the end", [BUSY, "a", FREE, BUSY, "b", FREE], CycleOutcome.COMPLETED, ["a"]),
    ("another was measured", [BUSY, "other", FREE], CycleOutcome.ANOTHER, []),
    ("another's result among ours", [BUSY, "other", "a", FREE], CycleOutcome.COMPLETED, ["a"]),
    ("another before it begins once more", [BUSY, "other", BUSY, FREE], CycleOutcome.VANISHED, []),
]


def follow(cycle: Cycle, happenings: list[ScopeState | str], first_ns: int = 1) -> Cycle:
    for time_ns, happening in enumerate(happenings, first_ns):
        if isinstance(happening, ScopeState):
            cycle.on_state(happening, time_ns)
        else:
            cycle.on_result(happening, time_ns)
    return cycle


@pytest.mark.parametrize(("name", "happenings", "outcome", "results"), CASES, ids=[case[0] for case in CASES])
def test_cycle_has_the_outcome_of_its_packets(
    name: str, happenings: list[ScopeState | str], outcome: CycleOutcome | None, results: list[str]
) -> None:
    cycle = follow(Cycle(BUSY, lambda result: result != "other", since_ns=0), happenings)
    assert (cycle.outcome, cycle.results) == (outcome, results)


def test_packets_that_are_not_newer_belong_to_an_earlier_measurement() -> None:
    cycle = follow(Cycle(BUSY, lambda _: True, since_ns=4), [BUSY, "old", FREE, "old"])
    assert not cycle.begun
    assert follow(cycle, ["new", FREE], first_ns=5).results == ["new"]


def test_packets_without_times_count_only_while_waiting() -> None:
    for resumed, outcome in ((False, CycleOutcome.COMPLETED), (True, None)):
        cycle = Cycle(BUSY, lambda _: True, since_ns=4, resumed=resumed)
        cycle.on_state(BUSY, None)
        cycle.on_result("a", None)
        cycle.on_state(FREE, None)
        assert cycle.outcome is outcome


def test_foreign_scan_during_a_restart_does_not_count() -> None:
    cycle = Cycle(BUSY, lambda result: result != "other", since_ns=0, resumed=True)
    follow(cycle, [BUSY, "other", FREE])
    assert cycle.outcome is CycleOutcome.ANOTHER
    assert cycle.other == "other"
