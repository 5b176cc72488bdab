"""`make real-data` fails where the files of real microscopes are not there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_missing_folder_of_real_files_fails_with_a_remedy(tmp_path: Path) -> None:
    missing = tmp_path / "data"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "tests/real_data/test_real_cuts.py"],
        cwd=ROOT,
        env={**os.environ, "AFSPM_DATA": str(missing)},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"{missing} is no folder: set AFSPM_DATA=" in done.stdout + done.stderr
