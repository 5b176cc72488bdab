"""How much a peer may send that nobody takes, or that it does not finish."""

from __future__ import annotations

import pytest

from afspm.transport.connections import MOST_UNREAD_BYTES, UNFINISHED_BYTES, UNFINISHED_S, Unread


def test_what_is_taken_waits_no_more_however_much_it_is() -> None:
    peer = Unread(0.0)
    for step in range(1, 100):
        assert not peer.is_too_much(step * MOST_UNREAD_BYTES, 0.1 * step, settled=True)


def test_more_than_may_wait_is_too_much_at_once() -> None:
    peer = Unread(0.0)
    assert not peer.is_too_much(MOST_UNREAD_BYTES, 0.1, settled=False)
    assert peer.is_too_much(MOST_UNREAD_BYTES + 100, 0.2, settled=False)


@pytest.mark.parametrize(("received", "too_much"), [(2 * UNFINISHED_BYTES, True), (UNFINISHED_BYTES // 2, False)])
def test_a_message_that_is_large_has_to_be_finished_in_time(received: int, too_much: bool) -> None:
    peer = Unread(0.0)
    assert not peer.is_too_much(received, 0.1, settled=False)
    assert not peer.is_too_much(received, UNFINISHED_S, settled=False)
    assert peer.is_too_much(received, UNFINISHED_S + 0.2, settled=False) is too_much


def test_heartbeats_of_a_night_are_no_unfinished_message() -> None:
    peer = Unread(0.0)
    for second in range(2, 12 * 3600, 2):
        assert not peer.is_too_much(second * 20, float(second), settled=False)
