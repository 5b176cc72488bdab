"""`benchmarks.hops` counts all processes of the bench."""

from __future__ import annotations

from benchmarks import hops


def test_counted_ways_lead_through_client_scheduler_and_translator() -> None:
    ways = hops.measured()
    assert len(ways) == 2
    for name, way in ways.items():
        # results house 2: threads of component and translator were started before the profiler was there
        assert {"client", "scheduler", "translator"} <= set(way.modules), name
