"""`afspm run`: an experiment from its file to its folder, and how to stop it."""

from __future__ import annotations

import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest
from systems import can_interrupt, interrupt, wait_until_gone
from tests.system.experiment.experiment_lab import Run, lasting, require_each_once, require_recorded_once

import afspm
from afspm.basics.errors import ExperimentEnded
from afspm.record.run_json import latest_run
from afspm.supervisor.ports import FreePorts


def test_an_experiment_ends_by_itself_and_leaves_its_folder(run: Run, tmp_path: Path) -> None:
    one = run()
    assert one.end() == 0, one.output
    require_each_once(one, 4)
    folder = one.folder
    assert latest_run(tmp_path / "runs") == folder
    assert "the experiment has ended" in one.output
    assert f"everything is in {folder}" in one.output
    log = (folder / "log.txt").read_text(encoding="utf-8")
    assert "scheduler" in log
    assert "[clock]" in (folder / "experiment.toml").read_text(encoding="utf-8")
    assert one.facts()["guest"]["sockets"]["control"] == one.facts()["processes"]["scheduler"]["serve"]
    assert not (folder / "report.html").exists()  # --no-report
    assert (folder / "journal.sqlite").is_file()


def test_file_with_errors_starts_nothing_and_prints_them(run: Run, tmp_path: Path) -> None:
    one = run(more="[another]\ncomponent = true\nclass = 'ScanSerie'\n")
    assert one.end() == 1
    one.wait_for(r"experiment.toml:\d+: error", "'ScanSerie'")
    one.wait_for("did you mean 'ScanSeries'")
    assert not (tmp_path / "runs").exists()


def test_unknown_process_name_starts_nothing_and_is_printed(run: Run, tmp_path: Path) -> None:
    one = run("--without", "witnes")
    assert one.end() == 1
    one.wait_for("witness")
    assert not (tmp_path / "runs").exists()


def test_dry_run_lists_the_processes_to_start(run: Run, tmp_path: Path) -> None:
    one = run("--dry-run", "--without", "witness,series")
    assert one.end() == 0
    assert [line.split(" ")[0] for line in one.lines if "(" in line] == ["microscope", "scheduler", "recorder"]
    assert not (tmp_path / "runs").exists()


def test_problem_in_end_on_ends_the_experiment(run: Run) -> None:
    one = run(more='[control]\nend_on = ["tip-shape-changed"]\n', scans=1000)
    one.wait_for("scan 1 of 1000")
    with afspm.connect(one.folder, "person") as scope, suppress(ExperimentEnded):  # which may come before the answer
        scope.flag("tip-shape-changed")
    assert one.end() == 0
    one.wait_for("person flagged tip-shape-changed; person ended the experiment")


def test_part_of_an_experiment_can_be_left_out(run: Run) -> None:
    one = run("--without", "witness", over="[series]\nend_when_done = true\n")
    assert one.end() == 0
    one.wait_for("ran: microscope, scheduler, series, recorder$")


@pytest.mark.skipif(sys.platform == "win32", reason="inter-process sockets are files")
def test_an_experiment_runs_on_inter_process_sockets(run: Run, tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="afspm-") as folder:  # tmp_path may be longer than a socket's name may
        at = f"ipc://{folder}"
        over = f"""
            [microscope]
            publisher = "{at}/microscope"
            control_server = "{at}/asked"
            [scheduler]
            pubsubcache = "{at}/scheduler"
            router = "{at}/router"
            """
        one = run(over=over + lasting(tmp_path), scans=1000)
        one.wait_for("series is in control")
        assert {file.name for file in Path(folder).iterdir() if file.is_socket()} >= {"scheduler", "router"}
        require_each_once(one, one.end_lasting())
        assert one.facts()["processes"]["scheduler"]["serve"] == f"{at}/router"


def test_an_experiment_can_be_started_in_two_parts(run: Run) -> None:
    """As on two computers: each part by a supervisor of its own, the addresses between them in the file."""
    ports = FreePorts()
    over = f"""
        [scheduler]
        pubsubcache = "{ports.address()}"
        router = "{ports.address()}"
        """
    decides = run("--only", "series,witness", over=over)
    acts = run("--without", "series,witness", over=over)
    assert decides.end() == 0, decides.output + acts.output
    assert acts.end() == 0, acts.output
    decides.wait_for("ran: series, witness$")
    acts.wait_for("ran: microscope, scheduler, recorder$")
    saved = sorted(file.name for file in (acts.folder / "scans").glob("scan-*.nc"))
    assert len(saved) == 4
    require_recorded_once(acts.folder, {channel for channel, _, _ in decides.witnessed()}, saved, acts.output)
    assert set(decides.witnessed().values()) == {1}
    assert decides.facts()["clock"] == acts.facts()["clock"], "each part has a time of its own"


def test_overlay_wins_and_modules_beside_the_file_win_over_the_working_directory(run: Run, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("witness", "queue"):  # one of the experiment's, one that Python itself needs
        (elsewhere / f"{name}.py").write_text("raise RuntimeError('the wrong one')\n", encoding="utf-8")
    one = run(over="[series]\nscans = 1\n[witness]\nscans = 1\n", where=elsewhere)
    assert one.end() == 0, one.output
    require_each_once(one, 1)


@can_interrupt
def test_ctrl_c_ends_all_cleanly(run: Run) -> None:
    """The benchmarks measure how long that takes."""
    one = run(scans=1000)
    one.wait_for("scan 1 of 1000")
    interrupt(one.process)
    assert one.end() == 130, one.output
    for name in ("microscope", "scheduler", "series", "witness"):
        one.wait_for(f" {name} ", "ended as it was asked to")  # by itself: nothing had to be killed


@can_interrupt
def test_components_know_the_channels_after_ctrl_c(run: Run, tmp_path: Path) -> None:
    # DriftPictures drew nothing of a run that a person stopped
    log = "self.log.info('%d roles', len(self.scope.channels.names))"
    code = f"import afspm\n\nclass Last(afspm.Component):\n    def on_end(self):\n        {log}\n"
    (tmp_path / "last.py").write_text(code, encoding="utf-8")
    one = run(scans=1000, more="[last]\ncomponent = true\nclass = 'last.Last'\n")
    one.wait_for("scan 1 of 1000")
    interrupt(one.process)
    assert one.end() == 130, one.output
    one.wait_for(" last ", r"[1-9]\d* roles")


def test_a_killed_supervisor_leaves_no_process_behind(run: Run) -> None:
    code = "import os, threading; print('pid', os.getpid(), flush=True); threading.Event().wait()"
    more = f"[foreign]\ncomponent = true\nheartbeats = false\ncommand = ['python', '-c', {code!r}]\n"
    one = run(scans=1000, more=more)
    one.wait_for("scan 1 of 1000")
    names = ("microscope", "scheduler", "series", "witness", "foreign")
    pids = {name: one.pid(name) for name in names}
    pids["command of foreign"] = int(one.wait_for(" foreign ", "pid ").rsplit(" ", 1)[1])
    one.process.kill()
    wait_until_gone(pids)
