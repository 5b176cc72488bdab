"""The cache: which packets are kept, under which envelope and in which order, and their replay."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import Packet, PacketHeader
from afspm.scheduler.publishing.cache import TIME_STEP_NS, PacketCache
from afspm.scheduler.publishing.envelopes import CacheRule, Envelopes, default_envelope, size_text

NS = 10**9
NOW = 1_750_000_000 * NS


def scan(width_m: float = 2e-6, channel: str = "Height") -> PacketHeader:
    return PacketHeader("Scan2d", channel, (width_m, width_m))


def put(
    cache: PacketCache, header: PacketHeader, time_ns: int | None, payload: bytes = b"x", now_ns: int = NOW
) -> Packet | None:
    taken = cache.take(Packet(header.message, payload, time_ns), header, now_ns)
    return None if taken is None else taken[0]


def times(cache: PacketCache, prefix: str = "", since_ns: int = -1) -> list[int]:
    return [packet.time_ns or 0 for packet in cache.replay([prefix], since_ns)]


@pytest.mark.parametrize(
    ("width_m", "text"),
    [
        (2e-6, "2000.0"),
        (1e-9, "1.0"),
        (1.0e-7, "100.0"),
        (4.99e-8, "50.0"),
        (5e-9, "5.0"),
        (2e-7, "200.0"),
        (1e-3, "1000000.0"),
    ],
)
def test_sizes_of_a_nanometre_and_more_are_rounded_as_the_wire_format_says(width_m: float, text: str) -> None:
    assert size_text(width_m) == text


def test_sizes_below_a_nanometre_stay_apart() -> None:
    assert [size_text(width) for width in (2.5e-10, 3e-10, 9e-10)] == ["0.25", "0.3", "0.9"]


def test_lines_of_a_running_scan_are_published_and_not_cached() -> None:
    cache = PacketCache()
    put(cache, scan(), NOW)
    for number in range(1, 200):
        taken = cache.take(Packet("ScanLines", b"x", NOW + number), PacketHeader("ScanLines", "Height"), NOW + number)
        assert taken is not None
        assert (taken[0].envelope, taken[1]) == ("ScanLines", 0)
    assert len(cache) == 1
    assert times(cache, "ScanLines") == []
    assert [source_ns for source_ns, _ in cache.recent()] == [NOW]  # what is to keep its time after a kill is known


def test_default_envelopes_follow_the_wire_format() -> None:
    assert default_envelope(scan(2e-6, "Height Retrace")) == "Scan2d_2000.0_Height Retrace"
    assert default_envelope(scan(2e-6, "a_b_c")) == "Scan2d_2000.0_a_b_c"
    assert default_envelope(PacketHeader("Spec1d", kind="IV")) == "Spec1d_IV"
    assert default_envelope(PacketHeader("PeakList")) == "PeakList"
    assert default_envelope(PacketHeader("Scan2d")) == "Scan2d"


def test_wide_and_narrow_scans_can_be_kept_apart() -> None:
    rules = [
        CacheRule("Scan2d", above_m=1e-6, envelope="Scan2d_wide_{channel}", history=2),
        CacheRule("Scan2d", up_to_m=1e-6, envelope="Scan2d_narrow_{channel}", history=20),
    ]
    envelopes = Envelopes(rules)
    assert envelopes.of(scan(2e-6)) == ("Scan2d_wide_Height", 2)
    assert envelopes.of(scan(1e-6)) == ("Scan2d_narrow_Height", 20)
    assert envelopes.of(PacketHeader("ScopeStateMsg")) == ("ScopeStateMsg", 10)


def test_rule_may_set_only_the_history() -> None:
    assert Envelopes([CacheRule("Scan2d", channel="Height", history=99)]).of(scan()) == ("Scan2d_2000.0_Height", 99)
    assert Envelopes(history={"Peaks": 3}).of(PacketHeader("Peaks")) == ("Peaks", 3)


def test_a_mapping_of_the_user_s_own_names_the_envelope() -> None:
    assert Envelopes(mapping=lambda header: f"{header.message}_mine").of(scan()) == ("Scan2d_mine", 5)


@pytest.mark.parametrize("bad", ["", "Scan2d_a\0b", "KILL", None, 7, "wide_Height", "Scan2dwide"])
def test_a_mapping_that_gives_no_envelope_is_an_error(bad: object) -> None:
    with pytest.raises(ConfigError):
        Envelopes(mapping=lambda header: bad).of(scan())  # type: ignore[arg-type, return-value]


def test_a_mapping_that_fails_is_an_error_of_the_configuration() -> None:
    with pytest.raises(ConfigError, match="ZeroDivisionError"):
        Envelopes(mapping=lambda header: str(1 / 0)).of(scan())


@pytest.mark.parametrize(
    "rule",
    [
        {"history": 0},
        {"envelope": "Scan2d_{colour}"},
        {"envelope": "Scan2d_{"},
        {"above_m": 2e-6, "up_to_m": 1e-6},
        {"envelope": "wide_{channel}"},
        {"envelope": "Spec1d_{channel}"},
    ],
)
def test_a_rule_that_can_not_work_is_refused(rule: dict[str, object]) -> None:
    with pytest.raises(InvalidValue):
        CacheRule("Scan2d", **rule)  # type: ignore[arg-type]


def test_newest_packets_of_each_envelope_are_kept() -> None:
    cache = PacketCache(Envelopes(history={"Scan2d": 3}))
    for n in range(1, 11):
        put(cache, scan(channel="a"), n * NS)
    put(cache, scan(channel="b"), 11 * NS)
    assert times(cache) == [8 * NS, 9 * NS, 10 * NS, 11 * NS]


def test_a_replay_is_oldest_first_over_all_envelopes_by_prefix_and_since() -> None:
    cache = PacketCache()
    put(cache, scan(channel="a"), 1 * NS)
    put(cache, PacketHeader("ScopeStateMsg"), 2 * NS)
    put(cache, scan(channel="b"), 3 * NS)
    put(cache, scan(channel="a"), 4 * NS)
    assert times(cache) == [1 * NS, 2 * NS, 3 * NS, 4 * NS]
    assert times(cache, "Scan2d") == [1 * NS, 3 * NS, 4 * NS]
    assert times(cache, "Scan2d_2000.0_a", 1 * NS) == [4 * NS]
    assert times(cache, "Nothing") == []


def test_times_increase_though_the_translator_s_clock_goes_back() -> None:
    cache = PacketCache()
    given = [put(cache, scan(), t) for t in (100 * NS, 50 * NS, 50 * NS + 1, 200 * NS)]
    assert [p.time_ns for p in given if p] == [100 * NS, 100 * NS + TIME_STEP_NS, 100 * NS + 2 * TIME_STEP_NS, 200 * NS]


def test_time_far_ahead_is_replaced() -> None:
    packet = put(PacketCache(), scan(), NOW + 100 * 3600 * NS)
    assert packet is not None
    assert packet.time_ns == NOW


def test_packet_without_a_time_gets_the_present_time() -> None:
    packet = put(PacketCache(), scan(), None)
    assert packet is not None
    assert packet.time_ns == NOW


def test_duplicates_of_a_reconnecting_translator_are_dropped() -> None:
    cache = PacketCache()
    assert put(cache, scan(), 5 * NS) is not None
    assert put(cache, scan(), 5 * NS) is None
    assert len(cache) == 1


def test_beyond_the_bytes_history_goes_before_the_last_of_an_envelope() -> None:
    cache = PacketCache(max_bytes=4000)
    put(cache, PacketHeader("ScanParameters2d"), 1 * NS)
    for n in range(2, 12):
        put(cache, scan(), n * NS, b"x" * 700)
    assert times(cache, "ScanParameters2d") == [1 * NS]
    assert cache.size <= 4000
    assert times(cache, "Scan2d") == [9 * NS, 10 * NS, 11 * NS]


def test_a_flood_of_envelopes_is_bounded() -> None:
    cache = PacketCache(max_bytes=10_000)
    for n in range(5000):
        put(cache, scan(channel=str(n)), n * NS + NS)
    assert cache.size <= 10_000
    assert len(cache) < 40


def test_packet_larger_than_the_cache_is_published_and_not_kept() -> None:
    cache = PacketCache(max_bytes=1000)
    taken = cache.take(Packet("Scan2d", b"x" * 2000, NS), scan(), NOW)
    assert taken is not None
    assert taken[1] == 0
    assert len(cache) == 0


def test_restart_restores_the_cache_and_continues_after_it() -> None:
    cache = PacketCache()
    for n in range(1, 5):
        put(cache, scan(), n * NS)
    kept = list(cache)
    again = PacketCache()
    again.not_before(10 * NS)
    again.restore(kept)
    assert list(again) == kept
    assert put(again, scan(), 4 * NS) is None
    assert again.newest_source_ns == 4 * NS
    new = put(again, scan(), 5 * NS)
    assert new is not None
    assert new.time_ns == 10 * NS + TIME_STEP_NS


def test_packet_published_but_not_logged_keeps_its_first_time() -> None:
    cache = PacketCache()
    cache.not_before(10 * NS)
    first = put(cache, scan(), 5 * NS)
    again = PacketCache()
    again.not_before(20 * NS)
    again.remember(cache.recent())
    second = put(again, scan(), 5 * NS)
    assert first is not None
    assert second is not None
    assert first.time_ns == second.time_ns
    assert again.recent() == cache.recent()


packets = st.tuples(
    st.sampled_from(["Scan2d", "Spec1d", "ScopeStateMsg", "Other"]),
    st.sampled_from(["a", "b_c"]),
    st.one_of(st.none(), st.integers(0, 2 * NOW)),
    st.binary(max_size=300),
)


@given(st.lists(packets, max_size=60), st.integers(400, 3000))
def test_any_sequence_of_packets_is_kept_in_order_within_bounds(
    story: list[tuple[str, str, int | None, bytes]], limit: int
) -> None:
    cache, newest, last = PacketCache(max_bytes=limit), dict[str, int](), 0
    for message, channel, time_ns, payload in story:
        header = PacketHeader(message, channel, (1e-6, 1e-6), "IV")
        taken = cache.take(Packet(message, payload, time_ns), header, NOW)
        if taken is None:
            continue
        packet, kept = taken
        assert packet.time_ns is not None
        assert packet.time_ns > last
        last = packet.time_ns
        if kept:
            newest[packet.envelope] = last
        assert cache.size <= limit
        got = times(cache)
        assert got == sorted(set(got))
        assert cache.size == sum(len(p.payload) + 300 for p, *_ in cache)
        if kept:
            assert last in got


def test_packet_passed_over_is_not_published_after_a_restart() -> None:
    cache = PacketCache()
    passed, after = (
        Packet("ScopeStateMsg", b"FREE", 10 * TIME_STEP_NS),
        Packet("ScopeStateMsg", b"SCANNING", 20 * TIME_STEP_NS),
    )
    assert cache.pass_over(passed)
    assert not cache.pass_over(passed)
    assert cache.take(after, PacketHeader("ScopeStateMsg"), 0) is not None
    restarted = PacketCache()
    restarted.remember(cache.recent())
    assert restarted.take(passed, PacketHeader("ScopeStateMsg"), 0) is None
    again = restarted.take(after, PacketHeader("ScopeStateMsg"), 0)
    assert again is not None
    assert again[0] == after
