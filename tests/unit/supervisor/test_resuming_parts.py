"""Of an experiment of several parts, each is resumed with the processes that it had."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.experiment import Role, load
from afspm.experiment.experiment import load_expanded
from afspm.supervisor.run import ONLY, WITHOUT, Options, dry_run, to_resume

PARTS = """
[clock]
speed = 60.0

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "tcp://127.0.0.1:29001"
router = "tcp://127.0.0.1:29002"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]

[metadata]
component = true
class = "Metadata"

[notify]
command = ["python", "call.py"]
"""


@pytest.mark.parametrize(
    "options",
    [
        Options(),
        Options(only=("microscope", "scheduler")),
        Options(only=("series", "metadata")),
        Options(without=("series",)),
        Options(without=("microscope", "scheduler")),
    ],
)
def test_a_part_is_resumed_with_what_it_had(options: Options, tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(PARTS, encoding="utf-8")
    experiment = load(tmp_path / "night.toml")
    starts = dry_run(experiment, options)
    names = [start.launch.name for start in starts]
    has_scheduler = Role.SCHEDULER in {start.role for start in starts}
    assert {"recorder", "notifier"} & set(names) == ({"recorder", "notifier"} if has_scheduler else set())
    facts = to_resume(experiment, starts, options)
    (tmp_path / "experiment.toml").write_text(experiment.expanded(), encoding="utf-8")
    expanded = load_expanded(tmp_path / "experiment.toml", [tmp_path])
    for _ in range(2):  # and once more
        again = Options(only=facts[ONLY], without=facts[WITHOUT])  # type: ignore[arg-type]
        starts = dry_run(expanded, again)
        assert sorted(start.launch.name for start in starts) == sorted(names)
        facts = to_resume(expanded, starts, again)
