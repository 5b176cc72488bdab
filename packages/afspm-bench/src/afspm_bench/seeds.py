"""Seeds of tasks, by HMAC with a key. A commitment published before proves that no seed was picked. Pure."""

from __future__ import annotations

import hashlib
import hmac
from typing import Final

PUBLIC_KEY: Final = b"AFMBench-Sim, public half, 1"
"""Key of the public half, for development. Results for publication come from a sealed half."""
TRIALS: Final = 3


def seed_of(key: bytes, task: str, trial: int) -> int:
    """Return the seed of a trial of a task.

    Three consecutive trials of a task have different remainders modulo 3, in an order that depends on the key. So
    exactly one of three trials of a restraint task is the harmless twin.
    """
    first = _number(key, f"{task}/order") % TRIALS
    return _number(key, f"{task}/{trial}") // TRIALS * TRIALS + (first + trial) % TRIALS


def commitment(key: bytes) -> str:
    """Return the SHA-256 of a key, in hexadecimal. Publish the commitment before a run, and the key afterwards."""
    return hashlib.sha256(key).hexdigest()


def _number(key: bytes, text: str) -> int:
    return int.from_bytes(hmac.digest(key, text.encode(), "sha256")[:6], "big")
