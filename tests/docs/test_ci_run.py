"""`.ci/run` with a stand-in for `make`: when the tests of the page run, and the verdict of the target in turn."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAKE = '#!/bin/sh\necho "made $* ($AFSPM_LACKING)"\ntest "$1" != chaos || exit $CHAOS\n'
PYTHON = """#!/bin/sh
case "$1" in
  tools/targets.py) echo chaos NIGHTS=4 ;;
  tools/page_sources.py) exit $CHANGED ;;
  tools/bootstrap.py) exit $NO_BROWSER ;;
esac
"""

pytestmark = pytest.mark.skipif(
    sys.platform == "win32" or shutil.which("timeout") is None, reason="a script for bash and coreutils"
)


def run(folder: Path, *, changed: int = 0, no_browser: int = 0, chaos: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the script in a folder where programs only say what they were called with."""
    (folder / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", folder / ".ci")
    for name, text in (("bin/make", MAKE), ("bin/python3", PYTHON), (".venv/bin/python", PYTHON)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
        (folder / name).chmod(0o755)
    answers = {"CHANGED": str(changed), "NO_BROWSER": str(no_browser), "CHAOS": str(chaos)}
    path = f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, **answers, "PATH": path, "AFSPM_LACKING": ""}
    return subprocess.run(
        [folder / ".ci" / "run"], env=environment, capture_output=True, encoding="utf-8", check=False, cwd=folder
    )


def test_target_in_turn_runs_last_and_may_lack_something(tmp_path: Path) -> None:
    done = run(tmp_path)
    made = [line for line in done.stdout.splitlines() if line.startswith("made")]
    assert done.returncode == 0, done.stdout + done.stderr
    assert (made[0], made[-1]) == ("made check ()", "made chaos NIGHTS=4 (passes)")
    assert "made test-ui ()" not in made


def test_target_in_turn_that_takes_too_long_is_no_verdict(tmp_path: Path) -> None:
    done = run(tmp_path, chaos=124)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "No verdict: make chaos NIGHTS=4 was ended after 20 minutes" in done.stdout


def test_target_in_turn_that_fails_fails_the_run(tmp_path: Path) -> None:
    assert run(tmp_path, chaos=2).returncode != 0


def test_page_is_tried_after_a_change_where_there_is_a_browser(tmp_path: Path) -> None:
    (tmp_path / "with").mkdir()
    assert "made test-ui ()" in run(tmp_path / "with", changed=1).stdout
    (tmp_path / "without").mkdir()
    done = run(tmp_path / "without", changed=1, no_browser=1)
    assert done.returncode == 0
    assert "made test-ui ()" not in done.stdout
    assert "Not tried: the tests of the page" in done.stdout
