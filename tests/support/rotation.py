"""Selects the part of a large set of cases for this commit; `AFSPM_CASES=all` selects all of them, once a night.

Different commits try different parts, and the same commit always the same part.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
ALL = os.environ.get("AFSPM_CASES") == "all"


@cache
def commit_number() -> int:
    """Return a number that differs from commit to commit; 0 without a commit."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "--short=12", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            encoding="ascii",
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return 0
    return int(done.stdout, 16)


def rotated(cases: Sequence[T], parts: int) -> list[T]:
    """Return every `parts`-th of the cases, with a start that depends on the commit."""
    return list(cases) if ALL else list(cases)[commit_number() % parts :: parts]
