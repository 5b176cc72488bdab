"""Planned work as lines of `afspm check`."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from afspm.cli.experiment_file import estimate_lines
from afspm.experiment import load
from afspm.model.planned_work import PlannedWork

NIGHT = """
[microscope]
component = true
class = "Simulator"
{speed}
[scheduler]
component = true
class = "Scheduler"
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
scans = 3
{parameters}
"""
DEFAULT = "scan-speed is the simulator's default, 2 µm/s"


@pytest.mark.parametrize(
    ("speed", "parameters", "why"),
    [
        ("", "", DEFAULT),
        ('initial = { scan-speed = "4 um/s" }', "", ""),
        ("", 'parameters = { scan-speed = "4 um/s" }', ""),
    ],
)
def test_default_speed_of_the_simulator_is_named(tmp_path: Path, speed: str, parameters: str, why: str) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(NIGHT.format(speed=speed, parameters=parameters), encoding="utf-8")
    work = load(file).planned_work()["series"]
    assert work is not None
    assert work.duration_s == pytest.approx(3 * 2 * 128 * 1e-6 / (4e-6 if not why else 2e-6))
    assert work.why == why


# users A: "no estimate for tiles" was not understood
def test_component_without_planned_work_is_named_with_the_reason() -> None:
    (line,) = estimate_lines({"tiles": None}, 600.0, datetime(2026, 3, 14, 12, 0, tzinfo=UTC))
    assert line == "how long tiles works is not known: its class does not plan its work"


def test_line_of_the_end_names_the_parts_left_out() -> None:
    works = {"series": PlannedWork(scans=3, duration_s=600.0, ends_experiment=True)}
    now = datetime(2026, 3, 14, 12, 0, tzinfo=UTC)
    real, fast = (list(estimate_lines(works, speed, now))[-1] for speed in (1.0, 600.0))
    assert "(10 min), without repairs, rescans and waiting for control" in real
    assert "computing" not in real
    assert "(10 min, 1 s real)" in fast
    assert fast.endswith("; at 600 x also without computing, about 0.1 s real a scan")
