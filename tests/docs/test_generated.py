"""The parts of the documentation that follow from the code are up to date."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("tool", ["tools/docs.py", "tools/drawings.py"])
def test_generated_docs_are_current(tool: str) -> None:
    done = subprocess.run(
        [sys.executable, tool, "--check"], cwd=ROOT, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, f"run `python {tool}`: stale are\n{done.stdout}{done.stderr}"
