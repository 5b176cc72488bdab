"""RecordPlayback: each item when it is due, none twice and none missing."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

from afspm.night.packets import RecordPlayback


@dataclass
class Recorded:
    time_ns: int | None


def times(things: object) -> list[int | None]:
    return [one.time_ns for one in things]  # type: ignore[attr-defined]


def test_items_are_yielded_when_due() -> None:
    playback = RecordPlayback([Recorded(10), Recorded(20), Recorded(20), Recorded(30)])
    assert (playback.next_ns, times(playback.due(9))) == (10, [])
    assert times(playback.due(20)) == [10, 20, 20]
    assert playback.next_ns == 30
    assert times(playback.due(100)) == [30]
    assert playback.next_ns is None


def test_caller_that_stops_early_loses_no_item_and_gets_none_twice() -> None:
    playback = RecordPlayback([Recorded(None), *map(Recorded, range(1, 10))])
    assert times(islice(playback.due(100), 4)) == [None, 1, 2, 3]
    assert times(playback.due(100)) == [4, 5, 6, 7, 8, 9]


def test_nothing_recorded_has_no_next_time() -> None:
    assert RecordPlayback[Recorded](()).next_ns is None
