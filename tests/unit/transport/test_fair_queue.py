"""In which order requests are handled, and how many may wait."""

from __future__ import annotations

from afspm.transport.fair_queue import FairQueue
from afspm.transport.router import PeerAsked, PeerConnected, PeerDisconnected


def asked(connection: int, name: str, what: str) -> PeerAsked:
    return PeerAsked(connection, name, None, [what.encode()])


def taken(queue: FairQueue, most: int = 100, holder: str | None = None) -> list[str]:
    return [
        event.frames[0].decode() if isinstance(event, PeerAsked) else type(event).__name__
        for event in queue.take(most, holder)
    ]


def test_each_client_has_its_turn_and_its_own_requests_stay_in_order() -> None:
    queue = FairQueue()
    assert not queue.put([*(asked(1, "Flood", f"f{n}") for n in range(5)), asked(2, "A", "a0"), asked(2, "A", "a1")])
    assert taken(queue, 4) == ["f0", "a0", "f1", "a1"]
    assert taken(queue) == ["f2", "f3", "f4"]
    assert not queue


def test_the_component_in_control_comes_before_all_others() -> None:
    queue = FairQueue()
    queue.put([asked(n, f"Flood {n}", f"f{n}") for n in range(50)])
    queue.put([asked(99, "Holder", "h0"), asked(99, "Holder", "h1")])
    assert taken(queue, 3, "Holder") == ["h0", "h1", "f0"]


def test_what_a_client_said_before_it_went_is_handled_before_its_end_and_before_its_next_life() -> None:
    queue = FairQueue()
    queue.put([PeerConnected(1), asked(1, "A", "a0"), asked(2, "B", "b0"), asked(1, "A", "a1")])
    queue.put([PeerDisconnected(1), PeerConnected(3), asked(3, "A", "a2")])
    assert taken(queue) == ["PeerConnected", "a0", "a1", "PeerDisconnected", "PeerConnected", "b0", "a2"]


def test_what_is_more_than_may_wait_of_one_is_given_back_and_others_have_room() -> None:
    queue = FairQueue(most_requests=2, most_bytes=100)
    assert queue.put([asked(1, "A", f"a{n}") for n in range(4)]) == [asked(1, "A", "a2"), asked(1, "A", "a3")]
    large = asked(2, "B", "b" * 90)
    assert queue.put([large, large, asked(3, "C", "c")]) == [large]
    assert len(taken(queue)) == 4
    assert not queue.put([large])
