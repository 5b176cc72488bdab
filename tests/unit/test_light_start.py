"""Processes that only pass scans on start without numpy, which saves half of their start time."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "module",
    [
        "afspm.scheduler",
        "afspm.supervisor.run",
        "afspm.supervisor.reporter",
        "afspm.supervisor.host",
        "afspm.client.connect",
        "afspm.components.planned_scans",
        "afspm.components.metadata",
        "afspm.components.notifier",
        "afspm.cli.app",
        "afspm.cli.status",
    ],
)
def test_numpy_is_loaded_only_by_processes_that_use_values(module: str) -> None:
    script = f"import sys, {module}; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
