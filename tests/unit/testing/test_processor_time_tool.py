"""`make test` says what it took in processor time, whichever process took it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
TOOL = ROOT / "tools" / "processor_time.py"
SPENDING = "import time\nwhile time.process_time() < 1: pass"
"""A program that takes a second of processor time, however busy the computer is."""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the Makefile's, which is not run there")


def run(code: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(TOOL), *options, sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, encoding="utf-8", check=False)


def spent_s(text: str) -> int:
    found = re.match(r"processor time: (\d+) s ", text)
    assert found is not None, text
    return int(found[1])


def test_time_of_a_grandchild_counts() -> None:
    done = run(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {SPENDING!r}])", "--fail-above=1000")
    assert done.returncode == 0
    assert spent_s(done.stdout) >= 1
    assert "calibration loop: " in done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux gives orphans another parent than init")
def test_time_of_an_orphan_counts() -> None:
    middle = (
        f"from subprocess import *; import sys; print(Popen([sys.executable, '-c', {SPENDING!r}], stdout=DEVNULL).pid)"
    )
    # a process is there until its new parent has asked for its end
    code = (
        "import psutil, subprocess, sys, time\n"
        f"orphan = int(subprocess.check_output([sys.executable, '-c', {middle!r}]))\n"
        "while psutil.pid_exists(orphan): time.sleep(0.01)"
    )
    assert spent_s(run(code).stdout) >= 1


def test_exit_code_of_the_command_is_kept() -> None:
    assert run("raise SystemExit(3)", "--fail-above=1000").returncode == 3


def test_command_that_takes_too_long_fails_with_a_remedy() -> None:
    done = run("pass", "--fail-above=0.000001")
    assert done.returncode == 1
    assert "times the limit of 360 s; `make test-times` lists" in done.stdout


def test_table_lists_folders_and_the_most_expensive_test(tmp_path: Path) -> None:
    for folder, spent in (("cheap", 0), ("dear", 1)):
        (tmp_path / folder).mkdir()
        loop = f"end = process_time() + {spent}\n    while process_time() < end: pass"
        text = f"from time import process_time\n\ndef test_{folder}():\n    {loop}\n"
        (tmp_path / folder / f"test_{folder}.py").write_text(text, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    options = ["-p", "xdist", "-p", "time_per_test", "--processor-times", "-n", "1", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options],
        cwd=ROOT / "tests" / "support",
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert re.search(r"^ +\d+\.\d  dear\n", done.stdout, re.MULTILINE), done.stdout
    assert re.search(r"most expensive of them:\n +\d+\.\d  dear/test_dear\.py::test_dear\n", done.stdout), done.stdout
