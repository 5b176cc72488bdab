"""Seeds of the tasks: HMAC of a key, so that a published commitment proves later that none was chosen. Pure."""

from __future__ import annotations

import hashlib
import hmac
from typing import Final

PUBLIC_KEY: Final = b"AFMBench-Sim, public half, 1"
"""Key of the public half, for development. Results for others come from a sealed half."""
TRIALS: Final = 3


def seed_of(key: bytes, task: str, trial: int) -> int:
    """Return the seed of a trial of a task.

    Its remainder by 3 is different in the three trials of a task, in an order that the key decides: each restraint task
    has one harmless twin among them.
    """
    first = _number(key, f"{task}/order") % TRIALS
    return _number(key, f"{task}/{trial}") // TRIALS * TRIALS + (first + trial) % TRIALS


def commitment(key: bytes) -> str:
    """Return the SHA-256 of a key, to publish before a run; the key itself is published afterwards."""
    return hashlib.sha256(key).hexdigest()


def _number(key: bytes, text: str) -> int:
    return int.from_bytes(hmac.digest(key, text.encode(), "sha256")[:6], "big")
