"""A translator obeys one scheduler, and says no to others."""

from __future__ import annotations

import pytest

from afspm.model.fencing import Epoch, SchedulerFence

OURS, THEIRS = "0123456789abcdef", "fedcba9876543210"


def there() -> bool:
    return True


def gone() -> bool:
    return False


def test_an_epoch_comes_back_from_its_frame_and_nothing_else_is_one() -> None:
    for epoch in (Epoch(OURS, 17), Epoch(OURS, 17, simulated=True)):
        assert Epoch.decode(epoch.encode()) == epoch
    for frame in (b"", b"17", b"run:", b"run:x", b":17:0", b"run:17:2", b"\xff" * 1000):
        assert Epoch.decode(frame) is None


def test_a_translator_of_a_run_obeys_no_scheduler_of_another_not_even_the_first() -> None:
    allegiance = SchedulerFence(OURS, simulated=False)
    assert "another scheduler" in allegiance.refusal(Epoch(THEIRS, 1), "", gone)
    assert allegiance.refusal(Epoch(OURS, 1), "", gone) == ""
    assert allegiance.refusal(Epoch(THEIRS, 2), "", gone) != ""


def test_a_restarted_scheduler_is_obeyed_and_the_life_before_it_no_more() -> None:
    allegiance = SchedulerFence(OURS, simulated=False)
    assert allegiance.refusal(Epoch(OURS, 1), "", there) == ""
    assert allegiance.refusal(Epoch(OURS, 2), "", there) == ""
    assert allegiance.refusal(Epoch(OURS, 1), "", there) != ""


@pytest.mark.parametrize("second", [Epoch(THEIRS, 1), None])
def test_without_a_run_the_first_is_obeyed_while_it_is_connected(second: Epoch | None) -> None:
    allegiance = SchedulerFence("", simulated=False)
    assert allegiance.refusal(Epoch(OURS, 1), "", there) == ""
    assert allegiance.refusal(second, "", there) != ""
    assert allegiance.refusal(Epoch(OURS, 1), "", there) == ""
    assert allegiance.refusal(second, "", gone) == ""


def test_who_tells_no_epoch_is_obeyed_where_nobody_does() -> None:
    allegiance = SchedulerFence(OURS, simulated=False)
    assert allegiance.refusal(None, "", there) == ""
    assert allegiance.refusal(None, "", there) == ""


def test_a_component_of_the_run_may_ask_by_itself() -> None:
    allegiance = SchedulerFence("", simulated=False)
    assert allegiance.refusal(Epoch(OURS, 5), "", there) == ""
    assert allegiance.refusal(None, OURS, there) == ""
    assert allegiance.refusal(None, THEIRS, there) != ""
    assert allegiance.refusal(Epoch(OURS, 5), "", there) == "", "what it asked changed nothing"


def test_a_simulated_experiment_commands_no_microscope_that_is_not() -> None:
    """A translator of a real one that was started by itself obeys who comes, but not whoever thinks that nothing can
    break."""
    for allegiance in (SchedulerFence("", simulated=False), SchedulerFence(OURS, simulated=False)):
        assert "not" in allegiance.refusal(Epoch(OURS, 1, simulated=True), "", gone)
        assert allegiance.refusal(Epoch(OURS, 1), "", gone) == ""
    assert SchedulerFence(OURS, simulated=True).refusal(Epoch(OURS, 1, simulated=True), "", gone) == ""
