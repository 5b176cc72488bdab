"""Files of real microscopes are read as they were when their record was made."""

from __future__ import annotations

from typing import Any

import pytest
from benchmarks.data_folder import DATA
from tests.real_data.record import facts, present, recorded


def same(found: Any, expected: Any, size: float = 0.0) -> bool:
    """Compare facts; sums to the last digits, which depend on the order of summing."""
    if isinstance(expected, dict):
        size = expected.get("sum_of_sizes", size)
        return found.keys() == expected.keys() and all(same(found[key], expected[key], size) for key in expected)
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(same, found, expected))
    if isinstance(expected, float):
        return bool(found == pytest.approx(expected, rel=1e-12, abs=1e-12 * size))
    return bool(found == expected)


@pytest.mark.parametrize("name", recorded())
def test_real_file_has_its_recorded_facts(name: str) -> None:
    assert (DATA / name).is_file(), f"{name} is missing in {DATA}"
    found, expected = facts(name), recorded()[name]
    assert found["sha256"] == expected["sha256"], "another file has this name"
    assert same(found, expected), f"{found} is not {expected}; `make real-data-record` writes what is read now"


def test_every_real_file_has_a_record() -> None:
    assert set(present()) - recorded().keys() == set(), "`make real-data-record` adds them"


def test_changed_value_unit_or_place_is_found() -> None:
    """The comparison itself: each leaf of the record matters."""
    (channel,) = (one for one in recorded()["nanonis/ProbeFlow_nanonis.sxm"]["scans"] if one["channel"] == "Z Forward")
    for key, value in channel.items():
        changed = [2 * one for one in value] if isinstance(value, list) else value * 2
        if value:
            assert not same({**channel, key: changed}, channel), key
