"""No request that is sent begins a forbidden state, whoever sends it and whatever the microscope does meanwhile."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.simulation.forbidden_bench import SCENARIOS, ForbiddenBench, case

TOTAL = Counter[str]()


@settings(max_examples=120, deadline=None)
@given(st.integers(0, 10**9))
def test_no_request_begins_a_forbidden_state(seed: int) -> None:
    rules, steps = case(seed)
    bench = ForbiddenBench(rules)
    bench.run(steps)
    TOTAL.update(bench.counts)


@pytest.mark.parametrize("name", SCENARIOS)
def test_careless_order_of_events_begins_no_forbidden_state(name: str) -> None:
    rules, steps = SCENARIOS[name]
    ForbiddenBench(rules).run(steps)


def test_random_cases_execute_and_refuse() -> None:
    """Requests are executed, orders are carried out, and others are refused for each reason."""
    if not TOTAL:  # this test runs alone
        test_no_request_begins_a_forbidden_state()
    assert min(TOTAL[what] for what in ("executed", "ordered", "forbidden", "unknown")) > 20, TOTAL
