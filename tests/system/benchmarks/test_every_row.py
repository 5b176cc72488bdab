"""Every row of the benchmark works: each is measured once, in its shortest form."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.__main__ import _measured
from benchmarks.rows import Failure, Row

ROOT = Path(__file__).parents[3]


def test_every_row_is_measured(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--short"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    measured = json.loads((tmp_path / "build" / "bench.json").read_text(encoding="utf-8"))
    assert [row for row in measured if "error" in row] == [], run.stderr
    assert run.returncode in (0, 1), run.stderr  # a target may be missed: nothing is measured long enough
    assert len(measured) > 50


def test_a_measurement_that_fails_is_a_row_and_keeps_those_before_it(capsys: pytest.CaptureFixture[str]) -> None:
    def breaks() -> object:
        yield Row("first", "s", 1.0, None, 2.0)
        raise AttributeError("no attribute '_exchange'")

    found = list(_measured("breaks", breaks, {}))  # type: ignore[arg-type]
    assert found == [
        Row("first", "s", 1.0, None, 2.0),
        Failure("breaks", "AttributeError: no attribute '_exchange'"),
    ]
    assert "Traceback" in capsys.readouterr().err
