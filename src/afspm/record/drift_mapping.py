"""Displacement of the sample and its uncertainty, from the fields of a `DriftMapping` message."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from afspm.model.registration_outcome import RegistrationOutcome

if TYPE_CHECKING:
    from afspm.model.arrays import Array
    from afspm.wire.messages import DriftMapping


def drift_at(matrix: Array, center_m: Sequence[float]) -> Array:
    """Return x_tip - x_sample in m, shape (2,): the displacement of the sample at `center_m` (tip coordinates, m)."""
    import numpy as np

    at = np.asarray(center_m, dtype=np.float64)
    drift: Array = at - (matrix[:2, :2] @ at + matrix[:2, 2])
    return drift


def drift_knowledge(message: DriftMapping) -> tuple[RegistrationOutcome, float | None]:
    """Return how a scan's position is known, and its largest standard deviation in m (None: unknown)."""
    outcome = RegistrationOutcome.of(message.outcome, matched=message.matched)
    if len(message.covariance) != 4:
        return outcome, None
    import numpy as np

    largest = float(np.linalg.eigvalsh(np.array(message.covariance).reshape(2, 2))[-1])
    return outcome, math.sqrt(max(largest, 0.0))
