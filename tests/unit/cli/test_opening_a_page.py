"""`afspm dashboard` prints at once what it opens, since its page takes seconds to load."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.plugins.web import commands as command


def test_the_run_is_named_before_the_page_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "run.json").write_text('{"name": "night", "ended": "stopped"}', encoding="utf-8")
    said: list[str] = []
    monkeypatch.setattr(command, "_serve_recorded", lambda *_: said.append(capsys.readouterr().out))
    command.dashboard(tmp_path)
    assert said == [f"opening the page of {tmp_path.name} …\n"]
