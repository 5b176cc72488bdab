"""Locks on files."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.basics.file_lock import lock, locked


def test_a_file_that_stays_open_is_locked_for_as_long_as_the_block_lasts(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"once")
    with path.open("r+b") as mine, path.open("r+b") as another:
        with locked(mine), pytest.raises(OSError):  # noqa: PT011  (Wine gives it no number)
            lock(another)
        lock(another)
