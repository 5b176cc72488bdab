"""The syncs of this process, recorded as the guaranteed state of a folder."""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from typing import Any

import pytest

LOSSY = Path(__file__).parent / "lossy_disk" / "sitecustomize.py"


def lossy_disk(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the `Shadow` of a folder, which records the syncs of this process until the end of the test."""
    lossy = runpy.run_path(str(LOSSY))
    for name in ("fsync", "fdatasync", "unlink", "remove", "replace", "rename"):
        monkeypatch.setattr(os, name, getattr(os, name))  # to be as they were after the test
    shadow = lossy["Shadow"](str(folder))
    lossy["watch"](shadow)
    return shadow
