"""Acts of a person between and in the requests of a run: no wrong result is complete, and no act is invented.

A handful of cases; `make acts` carries out hundreds.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.plugins.acts_at_wire_moments import MAKERS, Case, acts_of, carried_out, is_bad, shown

CASES = range(4)
each_maker = pytest.mark.parametrize("maker", MAKERS)


@pytest.fixture(autouse=True)
def needs_interpreters(maker: str) -> None:
    for name, package in (("park", "quickjs"), ("nanosurf", "lupa")):
        if maker == name:
            pytest.importorskip(package, reason=f"the emulated program needs it: pip install afspm[{name}]")


@each_maker
@pytest.mark.parametrize("number", CASES)
def test_act_at_a_wire_moment_leaves_no_wrong_complete_result(maker: str, number: int, tmp_path: Path) -> None:
    found = carried_out(Case.of(maker, number), tmp_path)
    assert not is_bad(found), shown(found)


@each_maker
def test_run_without_a_person_has_no_acts_and_no_repeats(maker: str, tmp_path: Path) -> None:
    found = carried_out(Case.of(maker, len(acts_of(maker)) - 1).without_a_person(), tmp_path)
    assert not is_bad(found), shown(found)
    assert found.results == found.case.measurements
    # a killed translator may lose the measurement that lasts as long as its command
    assert found.repeats <= bool(found.case.killed_share)


@each_maker
def test_cases_have_each_act_and_each_plan(maker: str) -> None:
    cases = [Case.of(maker, number) for number in range(6 * len(acts_of(maker)))]
    assert {one.act for one in cases} == set(acts_of(maker))
    assert {one.plan for one in cases} == {"curves", "scans", "sweep"}
    assert {one.moment.kind for one in cases} == {"request", "wire", "running", "kill"}
    assert any(one.killed_share for one in cases)
