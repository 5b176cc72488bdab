"""How much is measured: everything, or each row once in its shortest form (`python -m benchmarks --short`).

The short form shows that a row still works. Its figures mean nothing.
"""

from __future__ import annotations

import os
from typing import TypeVar

T = TypeVar("T")

VARIABLE = "AFSPM_BENCHMARK"
SHORT = "short"


def effort(full: T, short: T) -> T:
    """Return `full`, or `short` where only the working of the rows is tried."""
    return short if os.environ.get(VARIABLE) == SHORT else full
