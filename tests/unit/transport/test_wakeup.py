"""Items from other threads are taken in bounded turns."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import pytest

from afspm.transport.polling import WakeUp


@pytest.fixture
def wake_up() -> Iterator[WakeUp[int]]:
    made: WakeUp[int] = WakeUp()
    yield made
    made.close()


def test_posted_items_are_taken_in_order_once(wake_up: WakeUp[int]) -> None:
    for i in range(5):
        wake_up.post(i)
    assert wake_up.take() == [0, 1, 2, 3, 4]
    assert wake_up.take() == []


def test_constant_posting_does_not_block_the_taker(wake_up: WakeUp[int]) -> None:
    most = 10_000

    class Refilled(deque[int]):
        """A queue that is never empty, as with a thread that posts all the time."""

        taken = 0

        def popleft(self) -> Any:
            self.taken += 1
            if self.taken < most:
                wake_up.post(self.taken)
            return super().popleft()

    wake_up._items = Refilled([0, 1, 2])
    assert wake_up.take() == [0, 1, 2]
    assert len(wake_up.take()) == 3  # what came meanwhile is there the next time
