"""Selects the part of a large set of cases for this commit; `AFSPM_CASES=all` selects all of them, once a night.

Different commits try different parts, and the same commit always the same part. With `pytest --in-turn` it selects so
among the tests of the files in `IN_TURN`.
"""

from __future__ import annotations

import os
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Final, TypeVar

import pytest

T = TypeVar("T")
ALL = os.environ.get("AFSPM_CASES") == "all"
IN_TURN: Final = {
    # one fault more of an emulator, of a translator, or of what a person answers
    "tests/plugins/gxsm/test_gxsm_faults.py": 4,
    "tests/system/commissioning/test_commissioning.py": 6,
    "tests/system/translators/test_broken_translators.py": 4,
    # the same with one maker more
    "tests/plugins/line_watch/test_makers_lines.py": 4,
    "tests/plugins/test_panel_table.py": 5,
    "tests/system/experiment/test_ledger_of_runs.py": 2,
    "tests/system/experiment/test_limits_when_sent.py": 3,
    "tests/system/experiment/test_lost_controller.py": 5,
    "tests/system/microscopes/test_every_microscope.py": 3,
    "tests/system/translators/test_strangers.py": 3,
    # whole runs and trials of what simulated nights, or the bench, try at each commit
    "tests/system/bench/test_bench.py": 4,
    "tests/system/experiment/test_at_the_panel.py": 2,
    "tests/system/experiment/test_drift_compensation.py": 4,
    "tests/system/experiment/test_idle_end.py": 3,
    "tests/system/experiment/test_late.py": 3,
    "tests/system/experiment/test_left_in_danger.py": 3,
    "tests/system/experiment/test_samples_run.py": 4,
    "tests/system/experiment/test_survey_runs.py": 4,
    "tests/system/experiment/test_sweep_runs.py": 2,
    "tests/system/record/test_resume.py": 3,
    # many pairs of scans
    "tests/plugins/drift/test_least_squares_small_overlaps.py": 3,
    "tests/plugins/drift/test_trackers_similarity.py": 3,
}
"""Of these files `make test-slow` tries one test in as many at each commit: they took half of its time.

None of their tests needs what another one of the file has done."""


@cache
def commit_number() -> int:
    """Return a number that differs from commit to commit; 0 without a commit."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "--short=12", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            encoding="ascii",
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return 0
    return int(done.stdout, 16)


def rotated(cases: Sequence[T], parts: int) -> list[T]:
    """Return every `parts`-th of the cases, with a start that depends on the commit."""
    return list(cases) if ALL else list(cases)[commit_number() % parts :: parts]


def in_turn(tests: Iterable[str], number: int) -> set[str]:
    """Return the tests, by their node ids, that the commit of this number tries."""
    files = defaultdict[str, list[str]](list)
    for test in tests:
        files[test.partition("::")[0]].append(test)
    parts = {file: IN_TURN.get(file, 1) for file in files}
    return {test for file, all_ in files.items() for test in all_[number % parts[file] :: parts[file]]}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--in-turn", action="store_true", help="a part of the tests of some files, another at each commit")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("in_turn") and not ALL:
        chosen = in_turn((item.nodeid for item in items), commit_number())
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in chosen])
        items[:] = [item for item in items if item.nodeid in chosen]
