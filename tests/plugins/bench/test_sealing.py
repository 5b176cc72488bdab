"""A sealed process reads nothing in the sealed folder, under any name."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from afspm.plugins.bench import sealing

pytestmark = pytest.mark.skipif(not sealing.is_available(), reason="no Landlock on this computer")
SPY = """
import os, subprocess, sys
from pathlib import Path
for name in sys.argv[1:]:
    try:
        print("read", Path(name).read_text().strip())
    except OSError:
        print("denied")
"""


def sealed(folder: Path, kept: list[Path], *command: str) -> list[str]:
    start = [sys.executable, "-m", "afspm.plugins.bench.sealing", str(folder), *map(str, kept), "--", *command]
    done = subprocess.run(start, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "sealed"
    (folder / "state").mkdir(parents=True)
    (folder / "truth.jsonl").write_text("seed 7")
    (folder / "state" / "clock").write_text("time")
    (tmp_path / "beside.txt").write_text("public")
    (tmp_path / "link").symlink_to(folder / "truth.jsonl")
    (tmp_path / "newest").symlink_to(tmp_path)  # like pytest's own "pytest-current"
    return folder


def test_sealed_process_reads_only_outside_and_kept_files(folder: Path, tmp_path: Path) -> None:
    names = [
        folder / "truth.jsonl", tmp_path / "link", Path(f"/proc/{os.getpid()}/root/{folder}/truth.jsonl"),
        folder / "state" / "clock", tmp_path / "beside.txt",
    ]  # fmt: skip
    found = sealed(folder, [folder / "state" / "clock"], sys.executable, "-c", SPY, *map(str, names))
    assert found == ["denied", "denied", "denied", "read time", "read public"]


def test_children_of_a_sealed_process_are_sealed(folder: Path) -> None:
    child = (
        f"import subprocess, sys; sys.exit(subprocess.run(['cat', {str(folder / 'truth.jsonl')!r}]).returncode == 0)"
    )
    assert sealed(folder, [], sys.executable, "-c", child) == []


def test_unsealed_process_reads_the_file(folder: Path) -> None:
    # the other tests would prove nothing if the file could not be read anyway
    spy = [sys.executable, "-c", SPY, str(folder / "truth.jsonl")]
    assert subprocess.run(spy, capture_output=True, text=True, check=True).stdout == "read seed 7\n"
