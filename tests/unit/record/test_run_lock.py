"""The state of a run, read from its lock without a request: running, ended or cut off."""

from __future__ import annotations

import json
import sys
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import pytest

from afspm.basics.errors import FileError
from afspm.record.run_lock import cut_off_message, describe_state, lock_run, resume_command


def folder_of(tmp_path: Path, **facts: Any) -> Path:
    folder = tmp_path / "night 1"
    (folder / "state").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"name": "night", **facts}), encoding="utf-8")
    with lock_run(folder):
        pass
    return folder


def test_unlocked_run_without_an_end_is_cut_off(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    assert cut_off_message(folder) == f"it was cut off; {resume_command(folder)} goes on with it"
    with lock_run(folder):
        assert cut_off_message(folder) == ""
    assert cut_off_message(folder), "who ran it is gone"


@pytest.mark.parametrize(
    ("facts", "said"),
    [({}, "this run is still going on"), ({"ended": "stopped"}, "has ended, and its report is still being written")],
)
def test_refused_resume_knows_the_run_from_its_report(tmp_path: Path, facts: dict[str, str], said: str) -> None:
    # spectra F12: "still going on" for half a minute after the end
    folder = folder_of(tmp_path, **facts)
    with lock_run(folder), pytest.raises(FileError, match=said), lock_run(folder):
        pass


def test_state_query_does_not_block_a_resume(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    for _ in range(3):
        assert cut_off_message(folder)
        with lock_run(folder):
            pass


def test_cut_off_replay_offers_no_resume(tmp_path: Path) -> None:
    assert cut_off_message(folder_of(tmp_path, replay_of="runs/other")) == "this replay was cut off"


@pytest.mark.parametrize("ended", ["the experiment has ended", "Ctrl-C"])
def test_ended_run_is_not_cut_off(tmp_path: Path, ended: str) -> None:
    assert cut_off_message(folder_of(tmp_path, ended=ended)) == ""


def test_run_without_a_lock_is_not_called_cut_off(tmp_path: Path) -> None:
    assert cut_off_message(tmp_path) == ""
    folder = folder_of(tmp_path)
    (folder / "state" / "running").unlink()
    assert cut_off_message(folder) == ""
    assert describe_state(folder) == "it goes on, or was cut off"


def test_state_of_a_run_is_described_in_words(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    assert describe_state(folder) == cut_off_message(folder)
    with lock_run(folder):
        assert describe_state(folder) == "it goes on"
    (folder / "run.json").write_text(json.dumps({"ended": "Ctrl-C"}), encoding="utf-8")
    assert describe_state(folder) == "Ctrl-C"


@pytest.mark.parametrize(
    ("system", "folder", "said"),
    [
        ("linux", "runs/my night", "`afspm run --resume 'runs/my night'`"),
        ("win32", r"C:\runs\night", r"`afspm run --resume C:\runs\night`"),
        ("win32", r"C:\my runs\night", r'`afspm run --resume "C:\my runs\night"`'),
    ],
)
def test_resume_command_is_quoted_for_the_shell(
    monkeypatch: pytest.MonkeyPatch, system: str, folder: str, said: str
) -> None:
    monkeypatch.setattr(sys, "platform", system)
    path = PureWindowsPath(folder) if system == "win32" else PurePosixPath(folder)
    assert resume_command(path) == said
