"""The verdict of the drift benchmark, and the values that it keeps."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from benchmarks.drift import __main__ as bench
from benchmarks.drift.parts import Report
from benchmarks.rows import Row

WRONG = Row("real: accepted but wrong", "pairs", 1.0, None, 0.0)
SHARE = Row("real: accepted", "%", 90.0, None, 98.0, "high")


def judged(rows: list[Row], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: str) -> int:
    part = SimpleNamespace(jobs=lambda plan: [], report=lambda plan, results: Report([], rows))
    monkeypatch.setattr(bench, "importlib", SimpleNamespace(import_module=lambda name: part))
    monkeypatch.setattr(bench, "done", lambda jobs, processes: {})
    monkeypatch.setattr(bench, "RESULT", tmp_path / "bench-drift.json")
    monkeypatch.setattr(bench, "LANDED", tmp_path / "landed.json")
    return bench.main(["--parts", "accuracy", "--estimators", "least-squares", *arguments])


def test_an_eighth_of_the_pairs_judges_only_targets_of_no_pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert judged([SHARE], monkeypatch, tmp_path) == 1
    assert judged([SHARE], monkeypatch, tmp_path, "--quick") == 0
    assert judged([SHARE, WRONG], monkeypatch, tmp_path, "--quick") == 1


def test_a_landed_run_stands_beside_the_next(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    judged([SHARE], monkeypatch, tmp_path, "--land")
    assert json.loads((tmp_path / "landed.json").read_text(encoding="utf-8")) == {"real: accepted": 90.0}
    judged([Row("real: accepted", "%", 95.0, None, 98.0, "high")], monkeypatch, tmp_path)
    assert "95" in (line := capsys.readouterr().out.splitlines()[-2])
    assert "90" in line


def test_an_eighth_of_the_pairs_is_not_landed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        judged([SHARE], monkeypatch, tmp_path, "--quick", "--land")
    assert not (tmp_path / "landed.json").exists()
