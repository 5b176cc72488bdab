"""Durations, lengths and times as text."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta, timezone

import pytest

from afspm.basics import formatting

NS_PER_S = 1_000_000_000
EVENING = round(datetime(2026, 11, 20, 22, 4, 31, tzinfo=UTC).timestamp()) * NS_PER_S
HOUR_NS = 3600 * NS_PER_S


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        (-3.0, "0 s"),
        (0.2, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (200, "3 min 20 s"),
        (599, "9 min 59 s"),
        (725, "12 min"),
        (1200, "20 min"),
        (3590, "1 h 00 min"),
        (7500, "2 h 05 min"),
        (12_000, "3 h 20 min"),
        (2 * 86400 - 20, "2 d 0 h"),
        (3 * 86400, "3 d 0 h"),
    ],
)
def test_durations_have_digits_that_suit_their_size(seconds: float, told: str) -> None:
    assert formatting.duration_text(seconds) == told


@pytest.mark.parametrize(
    ("values_m", "told"),
    [
        ((0.0, 0.0), "0, 0 nm"),
        ((5e-7, 2.5e-7), "500, 250 nm"),
        ((1.5e-4, -2e-7), "150, -0.2 µm"),
        ((9.96e-7,), "0.996 µm"),
        ((-2e-3,), "-2 mm"),
        ((3e-12,), "3 pm"),
    ],
)
def test_lengths_are_in_the_unit_of_the_largest(values_m: tuple[float, ...], told: str) -> None:
    assert formatting.lengths_text(values_m) == told


def test_areas_and_places_and_the_same_for_pages() -> None:
    assert formatting.area_text((2e-6, 1e-6)) == "2 x 1 µm"
    assert formatting.position_text((1.2e-6, -5e-7)) == "(1.2, -0.5) µm"
    assert formatting.typeset("2 x 1 µm at (1.2, -0.5) µm") == "2 × 1 µm at (1.2, −0.5) µm"


def test_times_are_those_of_the_zone_that_is_given_and_utc_is_named() -> None:
    there = timezone(timedelta(hours=9))
    assert formatting.time_of_day(EVENING, UTC) == "22:04:31"
    assert formatting.time_of_day(EVENING, there, seconds=False) == "07:04"
    assert formatting.day_and_time(EVENING, UTC) == "2026-11-20 22:04:31 UTC"
    assert formatting.day_and_time(EVENING, there) == "2026-11-21 07:04:31"
    assert formatting.day(EVENING, there) == "2026-11-21"
    here = datetime.fromtimestamp(EVENING / NS_PER_S, UTC).astimezone()
    assert formatting.day_and_time(EVENING) == f"{here:%Y-%m-%d %H:%M:%S}"


def test_period_shows_the_day_of_its_end_if_it_differs() -> None:
    assert formatting.period_text(EVENING, EVENING + HOUR_NS, UTC) == "2026-11-20 22:04 to 23:04 UTC"
    assert formatting.period_text(EVENING, EVENING + 3 * HOUR_NS, UTC) == "2026-11-20 22:04 to 2026-11-21 01:04 UTC"


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(1.234e-8, "m", "12.34 nm"), (0.0, "m", "0 m"), (9.9999e-7, "m", "1 µm"), (-3.0, "V", "-3 V"), (5.0, "", "5"),
     (0.001, "counts", "0.001 counts"), (float("nan"), "m", "–"), (None, "m", "–"), (2e-6, "m/s", "2 µm/s")],
)  # fmt: skip
def test_quantities_read_well(value: float | None, unit: str, text: str) -> None:
    assert formatting.quantity(value, unit) == text


# spectra F12: a map of the area of force curves had "J, 1e-17"
def test_energy_has_a_prefix() -> None:
    assert formatting.scale(3e-17, "J") == (pytest.approx(1e18), "aJ")


def test_the_prefix_and_the_factor_belong_together() -> None:
    factor, unit = formatting.scale(3e-7, "m")
    assert (3e-7 * factor, unit) == (pytest.approx(300.0), "nm")


@pytest.mark.parametrize(
    ("start", "end", "offsets"),
    [
        # summer time ends at 01:00 UTC, and begins at that time half a year later
        ("2026-10-24T20:00", "2026-10-25T06:00", [("2026-10-24T20:00", 7200), ("2026-10-25T01:00", 3600)]),
        ("2026-10-20T20:00", "2026-10-26T06:00", [("2026-10-20T20:00", 7200), ("2026-10-25T01:00", 3600)]),
        ("2027-03-27T20:00", "2027-03-28T06:00", [("2027-03-27T20:00", 3600), ("2027-03-28T01:00", 7200)]),
        ("2026-10-25T20:00", "2026-10-26T06:00", [("2026-10-25T20:00", 3600)]),
        ("2026-10-25T00:00", "2026-10-25T00:00", [("2026-10-25T00:00", 7200)]),
    ],
)
def test_offsets_of_a_period_begin_at_the_changes_of_the_clock(
    start: str, end: str, offsets: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not hasattr(time, "tzset"):
        pytest.skip("this system has one zone")

    def ns(text: str) -> int:
        return round(datetime.fromisoformat(f"{text}+00:00").timestamp()) * 10**9

    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        found = formatting.zone_offsets_s(ns(start), ns(end))
    finally:
        monkeypatch.undo()
        time.tzset()
    assert found == [(ns(since), float(offset_s)) for since, offset_s in offsets]
