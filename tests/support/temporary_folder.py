"""A temporary folder of one test, in place of the one that all programs of the computer share."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest


def use_temporary_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process and its children put temporary files into `folder` until the end of the test."""
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
