"""What the supervisor is to run: one process of an experiment, whatever its language."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from afspm.experiment import ProcessStart, Role
from afspm.launch import Launch

HOST = "afspm.process.host"
GUARD = "afspm.process.foreign"


@dataclass(frozen=True)
class Task:
    """One process to start, to watch, and to start again.

    Attributes:
        launch: the line for its standard input; the heartbeat's address is the supervisor's to add.
        command: the program and its arguments.
        role: what it is in the experiment; without scheduler or translator nothing can go on.
        folder: where to start it; None: where we are.
        environment: what it gets besides our own environment.
        hidden: what it does not get of that.
        beats: whether it sends heartbeats; what doesn't is only known by its exit.
    """

    launch: Launch
    command: tuple[str, ...]
    role: Role = Role.COMPONENT
    folder: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    beats: bool = True
    hidden: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.launch.name

    @property
    def essential(self) -> bool:
        """Whether the experiment can't go on without it."""
        return self.role is not Role.COMPONENT


def from_start(start: ProcessStart) -> Task:
    """A task of what the experiment file says: Python classes by our host, other languages by our guard."""
    # -P: modules are those beside the experiment file, and never what happens to lie where the run was started
    python = (sys.executable, "-P", "-m")
    ours = (*python, GUARD, "--", *start.command) if start.command else (*python, HOST)
    before = [*start.python_path, *filter(None, [os.environ.get("PYTHONPATH", "")])]
    return Task(
        launch=start.launch,
        command=ours,
        role=start.role,
        folder=start.folder if start.command else None,
        environment={"PYTHONPATH": os.pathsep.join(before)} if before else {},
        beats=start.beats,
        hidden=start.hidden,
    )
