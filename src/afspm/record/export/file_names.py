"""How the files of a measurement are called, whatever the format."""

from __future__ import annotations

import re
from pathlib import Path


def stem(file: str) -> str:
    """By the name of the file in the record."""
    return Path(file).stem


def plain(name: str) -> str:
    """A name as part of a file's name."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_") or "channel"
