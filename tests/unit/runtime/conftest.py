from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from runtime_lab import SOURCE, Lab, LabPort

from afspm.runtime.link import Link
from afspm.runtime.scope import Scope


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def scope(lab: Lab) -> Scope:
    return Scope(Link(LabPort(lab), lab.name, source=SOURCE))
