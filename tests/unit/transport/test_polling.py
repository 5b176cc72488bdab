"""How long is waited."""

from __future__ import annotations

import math

import pytest

from afspm.transport.polling import milliseconds, poller
from afspm.transport.wakeup import WakeUp


@pytest.mark.parametrize("timeout_s", [3e6, 1e30, math.inf])
def test_a_deadline_beyond_what_a_poller_can_wait_for_is_waited_for_in_parts(timeout_s: float) -> None:
    wake_up: WakeUp[str] = WakeUp()
    wake_up.post("come")
    _, woken = poller(wake_up).wait(milliseconds(timeout_s))
    assert woken
    assert wake_up.take() == ["come"]
    wake_up.close()


def test_no_deadline_is_none_and_a_part_of_a_millisecond_is_one() -> None:
    assert (milliseconds(None), milliseconds(0.0001), milliseconds(-1.0)) == (None, 1, 0)
