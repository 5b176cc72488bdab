"""SS_FREE is kept back for peers that look at the last state alone, and what comes after it with it."""

from __future__ import annotations

import pytest

from afspm import wire
from afspm.model import Packet, ScopeState, ScopeStatus
from afspm.transport.state_delay import DELAY_S, StateDelay

OTHER = Packet("JournalEntries", b"", 9)


def told(state: ScopeState) -> Packet:
    return Packet(*wire.encode(ScopeStatus(state)), 1)


FREE = told(ScopeState.FREE)


@pytest.mark.parametrize("passing", [ScopeState.MOVING, ScopeState.INTERRUPTED])
def test_free_after_a_passing_state_waits_and_so_does_what_follows(passing: ScopeState) -> None:
    hold = StateDelay()
    assert hold.take(told(passing), 1.0, wanted=True) == [told(passing)]
    assert hold.take(OTHER, 1.0, wanted=True) == [OTHER]
    assert hold.take(FREE, 1.01, wanted=True) == []
    assert hold.take(OTHER, 1.02, wanted=True) == []
    assert hold.due_s == 1.0 + DELAY_S
    assert hold.release(1.09) == []
    assert hold.release(1.11) == [FREE, OTHER]
    assert (hold.release(9.0), hold.due_s) == ([], None)


def test_all_goes_out_at_the_end() -> None:
    hold = StateDelay()
    hold.take(told(ScopeState.MOVING), 1.0, wanted=True)
    hold.take(FREE, 1.0, wanted=True)
    assert hold.release() == [FREE]


@pytest.mark.parametrize(
    ("before", "later_s", "wanted"),
    [(ScopeState.SCANNING, 0.0, True), (ScopeState.MOVING, DELAY_S, True), (ScopeState.MOVING, 0.0, False)],
)
def test_nothing_waits_without_need(before: ScopeState, later_s: float, wanted: bool) -> None:
    hold = StateDelay()
    hold.take(told(before), 1.0, wanted=wanted)
    assert hold.take(FREE, 1.0 + later_s, wanted=wanted) == [FREE]


def test_a_state_that_cannot_be_read_is_no_state() -> None:
    hold = StateDelay()
    hold.take(told(ScopeState.MOVING), 1.0, wanted=True)
    broken = Packet("ScopeStateMsg", b"\xff", 2)
    assert hold.take(broken, 1.0, wanted=True) == [broken]
