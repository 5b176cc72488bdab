"""In a virtual environment our processes are Python itself: on Windows the python.exe there only starts another."""

from __future__ import annotations

import os
import subprocess
import venv
from pathlib import Path

import pytest
from systems import WINDOWS

import afspm

STARTS = """
import os, subprocess, sys
from afspm.basics.interpreter import python_command, python_environment
environment = {**os.environ, **python_environment()}
child = subprocess.Popen(python_command("tells"), env=environment, stdout=subprocess.PIPE, encoding="utf-8")
print(child.pid, sys.prefix)
print(child.communicate()[0])
"""
TELLS = "import os, sys; print(os.getpid(), sys.prefix)"


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """The Python of a new environment."""
    venv.create(tmp_path / "env", symlinks=not WINDOWS)
    return tmp_path / "env" / ("Scripts/python.exe" if WINDOWS else "bin/python")


def test_started_process_is_the_running_one_in_the_same_environment(python: Path, tmp_path: Path) -> None:
    (tmp_path / "tells.py").write_text(TELLS, encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), str(Path(afspm.__file__).parents[1])])
    told = subprocess.run(
        [python, "-c", STARTS],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        encoding="utf-8",
        check=True,
    )
    started, itself = told.stdout.split("\n")[:2]
    assert started == itself
    assert Path(itself.split(" ", 1)[1]) == tmp_path / "env"
