"""Whether a run goes on, has ended or was cut off is known without asking it."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import pytest

from afspm.record import run_lock
from afspm.record.run_lock import cut_off_message, describe_state, lock_run, resume_command


def folder_of(tmp_path: Path, **facts: Any) -> Path:
    folder = tmp_path / "night 1"
    (folder / "state").mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"name": "night", **facts}), encoding="utf-8")
    with lock_run(folder):
        pass
    return folder


def test_a_run_is_cut_off_if_nobody_runs_it_and_it_has_not_ended(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    assert cut_off_message(folder) == f"it was cut off; {resume_command(folder)} goes on with it"
    with lock_run(folder):
        assert cut_off_message(folder) == ""
    assert cut_off_message(folder), "who ran it is gone"


def test_to_look_does_not_hold_up_who_wants_to_go_on(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    for _ in range(3):
        assert cut_off_message(folder)
        with lock_run(folder):
            pass


def test_a_replay_is_not_to_be_resumed(tmp_path: Path) -> None:
    assert cut_off_message(folder_of(tmp_path, replay_of="runs/other")) == "this replay was cut off"


@pytest.mark.parametrize("ended", ["the experiment has ended", "Ctrl-C"])
def test_what_has_ended_was_not_cut_off(tmp_path: Path, ended: str) -> None:
    assert cut_off_message(folder_of(tmp_path, ended=ended)) == ""


def test_of_what_nobody_ran_here_that_is_not_said(tmp_path: Path) -> None:
    assert cut_off_message(tmp_path) == ""
    folder = folder_of(tmp_path)
    (folder / "state" / "running").unlink()
    assert cut_off_message(folder) == ""
    assert describe_state(folder) == "it goes on, or was cut off"


def test_how_it_is_with_a_run_is_told_in_words(tmp_path: Path) -> None:
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
def test_the_command_that_resumes_can_be_typed_as_it_is_told(
    monkeypatch: pytest.MonkeyPatch, system: str, folder: str, said: str
) -> None:
    monkeypatch.setattr(run_lock.sys, "platform", system)
    path = PureWindowsPath(folder) if system == "win32" else PurePosixPath(folder)
    assert resume_command(path) == said
