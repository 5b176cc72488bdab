"""When a component stops being woken up for each packet."""

from __future__ import annotations

from afspm.transport.flood import FAST_PER_S, TOO_FAST_PER_S, Flood


def told(gaps_s: list[float]) -> list[bool]:
    """Whether it is a flood after each of so many packets."""
    flood, now_s, said = Flood(), 100.0, []
    for gap_s in gaps_s:
        now_s += gap_s
        flood.came(1, now_s)
        said.append(flood.is_on)
    return said


def test_the_channels_of_a_scan_are_no_flood_nor_are_live_lines() -> None:
    assert not any(told([10.0, 1e-4, 1e-4, 1e-4, 1e-4] * 20))
    assert not any(told([0.01] * 1000))
    assert not any(told([1.0 / (0.9 * FAST_PER_S)] * 1000))


def test_a_flood_is_one_soon_and_until_it_is_over() -> None:
    fast = [1.0 / (1.5 * FAST_PER_S)] * 200
    said = told([*fast, 1.0])
    assert said[:10] == [False] * 10
    assert all(said[60:-1])
    assert not said[-1]


def test_where_there_is_always_something_nobody_rests() -> None:
    assert not any(told([1.0 / (1.5 * TOO_FAST_PER_S)] * 1000))


def test_packets_that_come_together_count_each() -> None:
    flood = Flood()
    for step in range(100):
        flood.came(8, step * 5e-3)
    assert flood.is_on
