"""Joining a run: the choice of the run, and the clean-up after a failure."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import afspm
from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import ConfigError, FileError
from afspm.basics.launch import Launch, Sockets
from afspm.client import connect
from afspm.client.connect import GUEST, find_run, guest_facts
from afspm.transport.port import CaughtUp, ControlConnected, Incoming

PUBLISHER = "tcp://127.0.0.1:1"


class Port:
    """A port that brings the same events each time, or is interrupted."""

    def __init__(self, *brings: Incoming) -> None:
        self.clock: Clock = ExperimentClock.real()
        self.is_closed = False
        self._brings = brings

    def send(self, frames: Sequence[bytes]) -> None:
        pass

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        if not self._brings:
            raise KeyboardInterrupt
        return list(self._brings)

    def wakeup_fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.is_closed = True


def run_folder(runs: Path, name: str, origin_s: float = 0.0) -> Path:
    folder = runs / name
    (folder / "state").mkdir(parents=True)
    launch = Launch("scheduler", sockets=Sockets(subscribe=(PUBLISHER,), control="tcp://127.0.0.1:2"))
    facts = {"name": "night", "clock": {"origin_s": origin_s}, GUEST: guest_facts(launch)}
    (folder / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    return folder


@pytest.fixture
def joins(monkeypatch: pytest.MonkeyPatch) -> Callable[[Port], Port]:
    """Let clients join through a port of the test."""

    def through(port: Port) -> Port:
        monkeypatch.setattr(connect, "open_port", lambda launch, clock: port)
        return port

    return through


def test_refusal_of_a_folder_without_runs_says_how_to_start_one(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="there is no run here") as refused:
        afspm.connect(tmp_path)
    assert "afspm run experiment.toml" in refused.value.hint


@pytest.mark.parametrize("damaged", ["{", "[]", ""])
def test_an_old_run_that_is_damaged_does_not_hide_the_newest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damaged: str
) -> None:
    monkeypatch.chdir(tmp_path)
    runs = tmp_path / "runs"
    run_folder(runs, "night-1", 1.0)
    run_folder(runs, "night-2", 2.0)
    (runs / "night-0").mkdir()
    (runs / "night-0" / "run.json").write_text(damaged, encoding="utf-8")
    file = tmp_path / "night.toml"
    file.write_text("", encoding="utf-8")
    assert find_run(file).name == "night-2"


def test_run_is_found_by_a_file_with_a_byte_order_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run_folder(tmp_path / "runs", "night-1")
    file = tmp_path / "other.toml"
    file.write_text('name = "night"\n', encoding="utf-8-sig")
    assert find_run(file).name == "night-1"


def test_interrupt_while_joining_leaves_no_connection(tmp_path: Path, joins: Callable[[Port], Port]) -> None:
    port = joins(Port())
    with pytest.raises(KeyboardInterrupt):
        afspm.connect(run_folder(tmp_path, "night"))
    assert port.is_closed


def test_unreadable_results_leave_no_connection(tmp_path: Path, joins: Callable[[Port], Port]) -> None:
    port, folder = joins(Port(ControlConnected(), CaughtUp(PUBLISHER))), run_folder(tmp_path, "night")
    (folder / "state" / "notebook.scope.json").write_text("nonsense", encoding="utf-8")
    with pytest.raises(FileError):
        afspm.connect(folder)
    assert port.is_closed


def test_module_that_a_run_folder_names_is_imported_only_if_the_caller_names_it(
    tmp_path: Path,
    joins: Callable[[Port], Port],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The folder, and the module with it, may come from another person."""
    folder = run_folder(tmp_path, "night")
    (tmp_path / "beside_the_run.py").write_text("raise SystemExit('it was run')\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    facts = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    facts[GUEST]["messages"] = ["beside_the_run"]
    (folder / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    joins(Port(ControlConnected(), CaughtUp(PUBLISHER)))
    caplog.set_level("WARNING")
    connect.join(folder, "terminal:ada")  # a command such as `afspm end` reads no messages
    assert "beside_the_run" not in caplog.text
    afspm.connect(folder)
    assert "messages of beside_the_run are not read" in caplog.text
    with pytest.raises(ConfigError, match="it was run"):
        afspm.connect(folder, messages=["beside_the_run"])


@pytest.mark.parametrize("name", ["", "a/b", "../x", "notebook:2", "two\nlines", "x" * 200])
def test_name_that_no_file_can_have_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="can't be the name of a program"):
        afspm.connect(run_folder(tmp_path, "night"), name)
