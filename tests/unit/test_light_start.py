"""Processes and commands start without the packages that they don't use, which saves half of their start time."""

from __future__ import annotations

import subprocess
import sys

import pytest

ARRAYS = ("numpy", "scipy", "h5py")
LOOK_UP = ("importlib.metadata", "email", "zipfile")
"""The metadata of installed packages, read where a name is looked up, and the modules that it brings."""


@pytest.mark.parametrize(
    ("module", "unused"),
    [
        ("afspm.scheduler", (*ARRAYS, *LOOK_UP)),
        ("afspm.scheduler.scheduler", (*ARRAYS, *LOOK_UP, "zmq", "afspm.scheduler.events", "afspm.storage")),
        ("afspm.supervisor.run", ARRAYS),
        ("afspm.supervisor.reporter", ARRAYS),
        ("afspm.supervisor.host", (*ARRAYS, *LOOK_UP, "zmq", "google.protobuf", "afspm.model", "logging")),
        ("afspm.supervisor.hosting", (*ARRAYS, *LOOK_UP)),
        ("afspm.client.component", (*ARRAYS, *LOOK_UP)),
        ("afspm.client.connect", (*ARRAYS, *LOOK_UP)),
        ("afspm.components.planned_scans", (*ARRAYS, *LOOK_UP)),
        ("afspm.components.metadata", (*ARRAYS, *LOOK_UP)),
        ("afspm.components.notifier", (*ARRAYS, *LOOK_UP)),
        ("afspm.cli.app", (*ARRAYS, "zmq", "google.protobuf")),
        ("afspm.cli.status", (*ARRAYS, "zmq", "google.protobuf")),
        ("afspm.cli.follower", (*ARRAYS, "afspm.client.scope")),
        ("afspm.simulation.simulator", ("scipy", "h5py", "importlib.metadata")),
        ("afspm.components.recording", ("scipy", "h5py", "importlib.metadata")),
        ("afspm.components.tip_corrector", ("scipy", "h5py", "importlib.metadata")),
    ],
)
def test_packages_are_loaded_only_by_processes_that_use_them(module: str, unused: tuple[str, ...]) -> None:
    script = f"import sys, {module}; print(*[one for one in {unused!r} if one in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    assert ran.stdout.split() == []


def test_help_is_shown_without_rich_and_pydantic() -> None:
    command = [sys.executable, "-X", "importtime", "-m", "afspm", "--help"]
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    imported = {line.split("|")[-1].strip() for line in ran.stderr.splitlines()}
    assert "typer" in imported
    assert not imported & {"rich", "pydantic", *ARRAYS, "zmq"}
