"""MyComponent, tested without a microscope: `pip install "afspm[testing]"`, then run `pytest` in this folder."""

from __future__ import annotations

from my_component import MyComponent

from afspm.components.planned_scans import ScanSeries
from afspm.testing import Bench


def test_my_component_notes_every_scan_once_also_after_a_kill() -> None:
    series = ScanSeries((1e-6, 1e-6), pixels=(16, 16), every=600.0, scans=3)
    bench = Bench(MyComponent(channel="height"), others={"series": series}, microscope={"surface": "steps"})
    bench.at("15 min", bench.kill)
    bench.run(until="1 h")
    assert len(bench.scans) == 3
    assert len(bench.memory["rms_nm"]) == 3
