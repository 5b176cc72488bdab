"""A run on a computer that gives its processes too few files or threads."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

from afspm.basics import python_command
from afspm.basics.errors import NoThread
from afspm.experiment import load
from afspm.supervisor.run import RunOptions, run

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits are set with the shell, and differ elsewhere")
EXPERIMENT = Path(__file__).parents[3] / "experiments" / "scan_list" / "experiment.toml"


def _run(limit: str, runs: Path) -> subprocess.CompletedProcess[str]:
    command = [*python_command("afspm"), "run", str(EXPERIMENT), "--no-report", "--speed", "200", "--runs", str(runs)]
    return subprocess.run(
        ["sh", "-c", f'ulimit {limit}; exec "$@"', "sh", *command],
        check=False, capture_output=True, text=True, timeout=2 * DEADLINE_S, cwd=runs.parent,
    )  # fmt: skip


# faults 11
def test_run_with_too_few_files_is_refused_with_the_number_needed(tmp_path: Path) -> None:
    done = _run("-n 40", tmp_path / "runs")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "may open 40 files here, and this run of 5 processes needs 104" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_run_raises_a_limit_that_it_may_raise(tmp_path: Path) -> None:
    done = _run("-S -n 40", tmp_path / "runs")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "6 scans" in done.stdout


@pytest.mark.parametrize("kilobytes", [400_000, 700_000])
def test_run_with_too_little_memory_is_refused_in_one_line(tmp_path: Path, kilobytes: int) -> None:
    done = _run(f"-v {kilobytes}", tmp_path / "runs")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "MiB of addresses here, and a run needs 1536 MiB (raise the limit" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_run_without_a_thread_for_its_first_process_ends_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(thread: threading.Thread) -> None:
        if thread.name.endswith("-wait"):
            raise RuntimeError("can't start new thread")
        begin(thread)

    begin = threading.Thread.start
    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(NoThread, match="starts no thread for the output of"):
        run(load(EXPERIMENT), RunOptions(runs=tmp_path, report=False))
