from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from client_lab import SOURCE, Lab, LabPort

from afspm.client.experiment_link import ExperimentLink
from afspm.client.scope import Scope


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def scope(lab: Lab) -> Scope:
    return Scope(ExperimentLink(LabPort(lab), lab.name, source=SOURCE))
