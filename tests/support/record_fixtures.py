"""A record to write into."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from record_lab import ABOUT, Night

from afspm.record.store import RecordStore


@pytest.fixture
def night() -> Night:
    return Night()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[RecordStore]:
    opened = RecordStore(tmp_path, ABOUT)
    yield opened
    opened.close()
