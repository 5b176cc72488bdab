from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from runtime_lab import SOURCE, Lab, LabPort  # noqa: E402

from afspm.runtime.link import Link  # noqa: E402
from afspm.runtime.scope import Scope  # noqa: E402


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def scope(lab: Lab) -> Scope:
    return Scope(Link(LabPort(lab), lab.name, source=SOURCE))
