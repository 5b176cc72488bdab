"""The benchmark remembers: rows stand beside the landed ratios, missing programs are named, commits are compared."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from benchmarks import __main__ as program
from benchmarks import compare, landed
from benchmarks.rows import MEASUREMENTS, Measurement, Missing, NotMeasured, Row

BOOTSTRAP = """
import pathlib, sys
python = pathlib.Path(".venv/bin/python")
python.parent.mkdir(parents=True, exist_ok=True)
if not python.exists():
    python.write_text(f'#!/bin/sh\\nexec {sys.executable} "$@"\\n')
    python.chmod(0o755)
"""
BENCH = """
import json, pathlib, sys
pathlib.Path("build").mkdir(exist_ok=True)
rows = [{{"name": name, "unit": "s", "ratio": {ratio}}} for name in sys.argv[1:]] + [{{"name": "broken", "error": "x"}}]
pathlib.Path("build/bench.json").write_text(json.dumps(rows))
sys.exit(3)
"""


Measure = Callable[..., int]


@pytest.fixture
def measure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Measure:
    """Run the benchmark with measurements of the test alone, a landed file and a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, **measurements: Measurement) -> int:
        return program.main([*arguments], (), measurements, tmp_path / "landed.json")

    return run


def fast() -> Iterator[Row]:
    yield Row("round trip", "µs", 300.0, 100.0, 4.0)
    yield Row("idle", "%", 1.0, None, 2.0)


def blind() -> Iterator[Row]:
    raise NotMeasured("no chromium is found", "apt install chromium")
    yield Row("never", "s", 1.0, None, 1.0)


def test_landed_ratio_stands_beside_the_next_run(
    measure: Measure, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert measure("--land", fast=fast) == 0
    assert json.loads((tmp_path / "landed.json").read_text(encoding="utf-8")) == {"fast": {"round trip": 3.0}}
    capsys.readouterr()
    assert measure(fast=fast) == 0
    header, row, idle = (line.split() for line in capsys.readouterr().out.splitlines())
    assert header == ["ours", "bare", "ratio", "landed", "target"]
    assert row == ["round", "trip", "[µs]", "300", "100", "3.00", "3.00", "<=", "4"]
    assert idle == ["idle", "[%]", "1", "1.00", "<=", "2"]  # an absolute value of another computer says nothing


def test_landing_some_measurements_keeps_the_others(measure: Measure, tmp_path: Path) -> None:
    (tmp_path / "landed.json").write_text('{"slow": {"way": 2.0}, "fast": {"gone": 1.0}}', encoding="utf-8")
    measure("--land", "fast", fast=fast)
    assert landed.read(tmp_path / "landed.json") == {"fast": {"round trip": 3.0}, "slow": {"way": 2.0}}


def test_missing_program_is_named_with_its_rows_and_the_others_go_on(
    measure: Measure, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "landed.json").write_text('{"blind": {"a scan on the page": 2.0}}', encoding="utf-8")

    def unpackaged() -> Iterator[Row]:
        importlib.import_module("no_such_package_anywhere")
        yield Row("never", "s", 1.0, None, 1.0)

    assert measure("--land", blind=blind, unpackaged=unpackaged, fast=fast) == 0
    out = capsys.readouterr().out
    assert "NOT MEASURED: no chromium is found; apt install chromium\n  a scan on the page\n" in out
    assert "not measured: unpackaged: no_such_package_anywhere is not installed; run `python tools/bootstrap.py" in out
    assert "round trip [µs]" in out
    assert landed.read(tmp_path / "landed.json") == {"blind": {"a scan on the page": 2.0}, "fast": {"round trip": 3.0}}
    written = json.loads(Path("build/bench.json").read_text(encoding="utf-8"))
    assert (
        written[0] == Missing("blind", "no chromium is found; apt install chromium", ("a scan on the page",)).to_json()
    )


def test_landed_rows_are_of_measurements_that_exist() -> None:
    assert program.main(["no such measurement"]) == 2  # after all are registered
    assert landed.read().keys() <= MEASUREMENTS.keys()


@pytest.mark.skipif(sys.platform == "win32", reason="the environment of the test is a shell script")
def test_commits_are_measured_in_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def git(*arguments: str) -> None:
        author = {f"GIT_{who}_{what}": "a@b.c" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
        subprocess.run(["git", *arguments], cwd=tmp_path, env={**os.environ, **author}, check=True, capture_output=True)

    git("init", "-q")
    for ratio in (2.0, 3.0):
        for name, text in {
            "tools/bootstrap.py": BOOTSTRAP,
            "benchmarks/__main__.py": BENCH.format(ratio=ratio),
        }.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text, encoding="utf-8")
        git("add", "tools", "benchmarks")
        git("commit", "-q", "-m", "test: measure")
    assert compare.main(["HEAD~1", "--pairs", "3", "round"], tmp_path) == 0
    header, row = (line.split() for line in capsys.readouterr().out.splitlines())
    assert header[2:] == ["quotient", "of", "3", "pairs", "(range)"]
    assert row == ["round", "[s]", "2", "3", "x", "1.500", "(1.500", "to", "1.500)"]
    with pytest.raises(SystemExit, match="there is no commit 'nonsense'"):
        compare.main(["nonsense"], tmp_path)
