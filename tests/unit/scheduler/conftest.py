from __future__ import annotations

import pytest
from tests.unit.scheduler.logic_lab import Lab


@pytest.fixture
def lab() -> Lab:
    """A core with a connected translator."""
    made = Lab()
    made.translator()
    return made
