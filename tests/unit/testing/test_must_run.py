"""A target whose tests are all skipped fails, and repeats what to install."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SUPPORT = Path(__file__).parents[2] / "support"
SKIPPED = 'import pytest\ndef test_it(): pytest.skip("no chromium is found: `apt install chromium`")\n'
MIXED = f"{SKIPPED}def test_other(): pass\n"


@pytest.mark.parametrize(
    ("tests", "lacking", "code"),
    [
        (SKIPPED, "", pytest.ExitCode.NO_TESTS_COLLECTED),
        (SKIPPED, "passes", pytest.ExitCode.OK),
        ("", "passes", pytest.ExitCode.NO_TESTS_COLLECTED),
        (MIXED, "", pytest.ExitCode.OK),
    ],
)
def test_only_skipped_tests_fail_a_target_that_must_run(tests: str, lacking: str, code: int, tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(tests, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-ra", "-p", "must_run", "--must-run", str(tmp_path)],
        cwd=SUPPORT,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "AFSPM_LACKING": lacking},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == code, done.stdout
    assert ("apt install chromium" in done.stdout) == bool(tests)
    assert ("no test ran: install" in done.stdout) == (tests != MIXED)
