from __future__ import annotations

import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
from watched_disk import lossy_disk

from afspm.basics.errors import FileError
from afspm.record.run_json import latest_run
from afspm.supervisor import run_folder

STARTED = datetime(2026, 11, 20, 22, 15, 3, tzinfo=UTC)


def test_the_folder_is_named_after_experiment_and_time(tmp_path: Path) -> None:
    folder = run_folder.create(tmp_path / "runs", "tip repair", STARTED)
    assert folder == (tmp_path / "runs" / "tip-repair-20261120-221503").resolve()
    assert (folder / "state").is_dir()


def test_two_runs_of_one_second_do_not_share_a_folder(tmp_path: Path) -> None:
    first = run_folder.create(tmp_path, "night", STARTED)
    second = run_folder.create(tmp_path, "night", STARTED)
    assert first != second
    assert latest_run(tmp_path) == second
    if sys.platform != "win32":  # where most persons may make no links
        assert (tmp_path / "latest").resolve() == second


def test_file_names_the_newest_run_if_links_can_not_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError("a required privilege is not held by the client")

    monkeypatch.setattr(Path, "symlink_to", refused)
    newest = run_folder.create(tmp_path, "night", STARTED)
    assert latest_run(tmp_path) == newest
    assert sorted(path.name for path in tmp_path.iterdir()) == ["latest.txt", newest.name]


@pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
def test_run_folder_outlives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """faults 17: a folder with synced files is lost with them if its own name is not synced."""
    (tmp_path / "runs").mkdir()
    disk = lossy_disk(tmp_path / "runs", monkeypatch)
    folder = run_folder.create(tmp_path / "runs", "night", STARTED)
    run_folder.write_run(folder, {"name": "night"})
    disk.copy(tmp_path / "after")
    assert json.loads((tmp_path / "after" / folder.name / "run.json").read_text(encoding="utf-8")) == {"name": "night"}


def test_a_name_cannot_lead_out_of_the_folder(tmp_path: Path) -> None:
    folder = run_folder.create(tmp_path / "runs", "../../elsewhere", STARTED)
    assert folder.parent == (tmp_path / "runs").resolve()


def test_error_names_a_folder_that_can_not_be_made(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(FileError, match="--runs"):
        run_folder.create(tmp_path / "runs", "night", STARTED)


def test_run_json_is_replaced_as_a_whole(tmp_path: Path) -> None:
    run_folder.write_run(tmp_path, {"name": "night"})
    run_folder.write_run(tmp_path, {"name": "µ"})
    assert json.loads((tmp_path / "run.json").read_text(encoding="utf-8")) == {"name": "µ"}
    assert [file.name for file in tmp_path.iterdir()] == ["run.json"]


def test_run_json_is_on_the_disk_before_its_final_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there: list[bool] = []
    real = os.fsync

    def synced(descriptor: int) -> None:
        there.append((tmp_path / "run.json").exists())
        real(descriptor)

    monkeypatch.setattr(os, "fsync", synced)
    run_folder.write_run(tmp_path, {"name": "night"})
    assert there == ([False] if sys.platform == "win32" else [False, True]), "the file, then its name"
    assert (tmp_path / "run.json").exists()
