"""The extent of measurements: everything, or each row once in its shortest form (`python -m benchmarks --short`).

The short form shows that a row still works. Its figures mean nothing.
"""

from __future__ import annotations

import os
from typing import TypeVar

T = TypeVar("T")

VARIABLE = "AFSPM_BENCHMARK"
SHORT = "short"


def effort(full: T, short: T) -> T:
    """Return `full`, or `short` in a test of the rows."""
    return short if os.environ.get(VARIABLE) == SHORT else full
