"""A translator obeys one scheduler, and refuses others."""

from __future__ import annotations

import pytest

from afspm.model.fencing import Epoch, SchedulerFence

OURS, THEIRS = "0123456789abcdef", "fedcba9876543210"


def there() -> bool:
    return True


def gone() -> bool:
    return False


def test_epoch_is_decoded_from_its_frame_and_from_nothing_else() -> None:
    for epoch in (Epoch(OURS, 17), Epoch(OURS, 17, simulated=True)):
        assert Epoch.decode(epoch.encode()) == epoch
    for frame in (b"", b"17", b"run:", b"run:x", b":17:0", b"run:17:2", b"\xff" * 1000):
        assert Epoch.decode(frame) is None


def test_translator_of_a_run_obeys_no_scheduler_of_another_run() -> None:
    allegiance = SchedulerFence(OURS, simulated=False)
    assert "another scheduler" in allegiance.refusal(Epoch(THEIRS, 1), "", gone)
    assert allegiance.refusal(Epoch(OURS, 1), "", gone) == ""
    assert allegiance.refusal(Epoch(THEIRS, 2), "", gone) != ""


def test_restarted_scheduler_is_obeyed_and_its_former_process_is_not() -> None:
    allegiance = SchedulerFence(OURS, simulated=False)
    assert allegiance.refusal(Epoch(OURS, 1), "", there) == ""
    assert allegiance.refusal(Epoch(OURS, 2), "", there) == ""
    assert allegiance.refusal(Epoch(OURS, 1), "", there) != ""


@pytest.mark.parametrize("second", [Epoch(THEIRS, 1), None])
def test_without_a_run_the_first_scheduler_is_obeyed_while_connected(second: Epoch | None) -> None:
    allegiance = SchedulerFence("", simulated=False)
    assert allegiance.refusal(Epoch(OURS, 1), "", there) == ""
    assert allegiance.refusal(second, "", there) != ""
    assert allegiance.refusal(Epoch(OURS, 1), "", there) == ""
    assert allegiance.refusal(second, "", gone) == ""


def test_scheduler_without_an_epoch_is_obeyed_unless_another_has_one() -> None:
    allegiance = SchedulerFence(OURS, simulated=False)
    assert allegiance.refusal(None, "", there) == ""
    assert allegiance.refusal(None, "", there) == ""


def test_component_of_the_run_may_send_requests_itself() -> None:
    allegiance = SchedulerFence("", simulated=False)
    assert allegiance.refusal(Epoch(OURS, 5), "", there) == ""
    assert allegiance.refusal(None, OURS, there) == ""
    assert allegiance.refusal(None, THEIRS, there) != ""
    assert allegiance.refusal(Epoch(OURS, 5), "", there) == "", "what it asked changed nothing"


def test_simulated_experiment_commands_no_real_microscope() -> None:
    """A translator without a run obeys any scheduler but one of a simulated experiment, for which no tip can break."""
    for allegiance in (SchedulerFence("", simulated=False), SchedulerFence(OURS, simulated=False)):
        assert "not" in allegiance.refusal(Epoch(OURS, 1, simulated=True), "", gone)
        assert allegiance.refusal(Epoch(OURS, 1), "", gone) == ""
    assert SchedulerFence(OURS, simulated=True).refusal(Epoch(OURS, 1, simulated=True), "", gone) == ""
