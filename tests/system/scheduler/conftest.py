"""Rigs shared by the tests of the scheduler's process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from scheduler_rig import Rig

from afspm.transport import keys


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


@pytest.fixture
def locked_rig(tmp_path: Path) -> Iterator[Rig]:
    """A rig with keys: scheduler, translator, Experiment and Visitor."""
    keys.generate(tmp_path / "keys", ["scheduler", "translator", "Experiment", "Visitor"])
    made = Rig(tmp_path, tmp_path / "keys")
    yield made
    made.close()
