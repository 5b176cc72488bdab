"""A real run that keeps its requests, over kills, replayed; and run again to its end."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from tests.system.experiment.conftest import afspm_run, run  # noqa: F401
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.basics.errors import ConfigError
from afspm_lab.what_if.closed_loop import rerun

pytestmark = pytest.mark.slow
KEEPS = "[record]\nrequests = true\n"


def test_recorded_run_with_kills_repeats_its_record(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one: AfspmRun = run(more=KEEPS, scans=3)
    one.wait_for("scan 1 of 3")
    one.kill("series")
    one.kill("scheduler")
    assert one.end() in (0, 3), one.output
    folder = one.folder
    monkeypatch.syspath_prepend(str(tmp_path))  # the witness
    result = afspm.what_if(folder)
    assert result.first is None, result.first
    assert not result.unread
    assert result.simulated
    assert "microscope" in result.left_out
    assert "series" not in result.left_out
    rows = {row.name: row for row in result.table()}
    assert rows["series"].same > 5
    assert rows["scheduler"].same > 50
    for log in (folder / "requests").iterdir():
        for line in log.read_text(encoding="utf-8").splitlines():
            kind, *rest = json.loads(line) if line else ("",)
            if kind == "life":
                launch = rest[0].get("launch", rest[0])
                assert launch["keys"] is None
                assert launch["beat_token"] == ""

    changed = tmp_path / "changed.toml"
    changed.write_text("[series]\nscans = 2\n", encoding="utf-8")
    fewer = afspm.what_if(folder, changed)
    assert fewer.first is not None
    assert fewer.first.component == "series"
    assert afspm.what_if(folder, {"series": {"size": ["2 um", "2 um"]}}, only=["series"]).differs
    with pytest.raises(ConfigError, match="series"):
        afspm.what_if(folder, {"series": {"size": ["2 um", "2 V"]}})
    untried = tmp_path / "untried.toml"
    for text in ("[microscope]\nseed = 12\n", "[elsewhere]\nscans = 2\n"):  # nothing of it is in a replay
        untried.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match="nothing that this file changes can be tried"):
            afspm.what_if(folder, untried)
    untried.write_text("[series]\nscans = 2\n[elsewhere]\nscans = 2\n", encoding="utf-8")
    assert afspm.what_if(folder, untried).untried == {"elsewhere": "is no process of the experiment"}
    untried.write_text("[serie]\nscans = 2\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"did you mean \[series\]"):
        afspm.what_if(folder, untried)
    outcomes = rerun(folder, changed, runs=tmp_path / "again", terminal=sys.stderr)
    assert outcomes.rows["whole scans"] == ("3", "2")
    assert afspm.open_run(outcomes.folder).simulated
