"""Peers see complete sequences of states, at any time of looking and any behaviour of the controller."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from afspm.model import ScopeState, ScopeStatus
from afspm.model.state import MEASURING
from afspm.translator.sequence import DiscardResults, LogError, PublishResults, PublishStatus, StatusSequence

SEEN = [state for state in ScopeState if state is not ScopeState.UNDEFINED]
LOOKS = st.tuples(st.sampled_from(SEEN), st.booleans(), st.floats(0.0, 20.0), st.booleans())
ASKED = st.one_of(st.just("stop"), st.sampled_from([ScopeState.SCANNING, ScopeState.SPEC, ScopeState.MOVING]))


@given(st.lists(st.one_of(LOOKS, ASKED), max_size=30))
def test_a_measurement_ends_with_its_results_or_as_interrupted_and_with_nothing_else(events: list[object]) -> None:
    sequence = StatusSequence(ScopeStatus(ScopeState.FREE), result_timeout_s=10.0)
    now_s, said = 0.0, ScopeState.FREE
    delivered = False
    for event in events:
        if isinstance(event, tuple):
            state, results, after_s, of_another = event
            now_s += after_s
            steps = sequence.observe(ScopeStatus(state), results, now_s, of_another=of_another)
        elif event == "stop":
            steps = sequence.interrupt() if said in MEASURING else []
        else:
            assert isinstance(event, ScopeState)
            steps = sequence.begin(event) if said is ScopeState.FREE else []
        for step in steps:
            if isinstance(step, PublishResults):
                assert said in MEASURING, "results come while something is being measured"
                delivered = True
            elif isinstance(step, PublishStatus):
                assert step.status.state is not said or step.status.paused is not None, "said twice"
                if said in MEASURING and step.status.state not in MEASURING:
                    assert delivered or step.status.state is ScopeState.INTERRUPTED
                said, delivered = step.status.state, False
            else:
                assert isinstance(step, DiscardResults | LogError)
        assert said is sequence.published.state


@given(st.lists(LOOKS, max_size=20))
def test_controller_at_rest_is_published_as_free(looks: list[tuple[ScopeState, bool, float, bool]]) -> None:
    sequence = StatusSequence(ScopeStatus(ScopeState.UNDEFINED), result_timeout_s=10.0)
    now_s = 0.0
    for state, results, after_s, of_another in looks:
        now_s += after_s
        sequence.observe(ScopeStatus(state), results, now_s, of_another=of_another)
    for _ in range(3):
        now_s += 11.0
        sequence.observe(ScopeStatus(ScopeState.FREE), False, now_s)
    assert sequence.published.state is ScopeState.FREE


def test_deadline_exists_while_a_result_is_awaited() -> None:
    sequence = StatusSequence(ScopeStatus(ScopeState.SCANNING), result_timeout_s=10.0)
    assert sequence.deadline_s() is None
    assert sequence.observe(ScopeStatus(ScopeState.FREE), False, 5.0) == []
    assert sequence.deadline_s() == 15.0


def test_measurement_begun_at_the_panel_after_an_interruption_is_published_separately() -> None:
    sequence = StatusSequence(ScopeStatus(ScopeState.SPEC), result_timeout_s=10.0)
    broken_off, scanning = ScopeStatus(ScopeState.INTERRUPTED), ScopeStatus(ScopeState.SCANNING)
    assert sequence.observe(broken_off, False, 1.0) == [PublishStatus(broken_off)]
    assert sequence.observe(ScopeStatus(ScopeState.SPEC), False, 2.0) == [], "it has not stopped yet"
    assert sequence.observe(scanning, False, 3.0) == [DiscardResults(), PublishStatus(scanning)]


def test_scan_begun_at_the_panel_after_a_stopped_curve_is_not_its_result() -> None:
    # results M2: the curve ended with the pictures of a scan
    sequence, seen = StatusSequence(ScopeStatus(ScopeState.SPEC), result_timeout_s=10.0), []
    for status in (ScopeStatus(ScopeState.SCANNING), ScopeStatus(ScopeState.FREE)):
        steps = sequence.observe(status, status.state is ScopeState.FREE, 1.0, of_another=True)
        seen += [step.status.state.name if isinstance(step, PublishStatus) else type(step).__name__ for step in steps]
    assert seen == ["INTERRUPTED", "FREE", "SCANNING", "PublishResults", "FREE"]


def test_measurement_followed_at_once_by_another_is_published_separately() -> None:
    scanning, free = ScopeStatus(ScopeState.SCANNING), ScopeStatus(ScopeState.FREE)
    for is_whole, end in (
        (True, [PublishResults(), PublishStatus(free)]),
        (False, [PublishStatus(ScopeStatus(ScopeState.INTERRUPTED)), DiscardResults(), PublishStatus(free)]),
    ):
        sequence = StatusSequence(scanning, result_timeout_s=10.0)
        assert sequence.follow(is_whole=is_whole) == end
        assert sequence.observe(scanning, False, 1.0) == [PublishStatus(scanning)]
    at_rest = StatusSequence(free, result_timeout_s=10.0)
    assert at_rest.follow(is_whole=True) == []
