"""What a simulated run knows of its drift, for judging afterwards: from the `truth.jsonl` that the simulator leaves."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from afspm.errors import AfspmError, FileError
from afspm.simulation import World

Array = NDArray[np.float64]

TRUTH_FILE = "truth.jsonl"


def true_drift(run_dir: Path) -> Callable[[Array], Array] | None:
    """The displacement (n, 2) of the sample at experiment times (n,), in tip coordinates; None where nobody knows it.

    Raises:
        FileError: there is such a file, but it is not one of a simulated run.
    """
    path = run_dir / TRUTH_FILE
    if not path.exists():
        return None
    try:
        start = _start(path)
        world = World.from_settings(start["settings"], int(start["seed"]), float(start["time_s"]))
    except (OSError, KeyError, ValueError, AfspmError) as error:
        raise FileError(f"does not say what was simulated: {error}", where=str(path)) from error
    return lambda time_s: world.drift_m(time_s)[..., :2]


def _start(path: Path) -> dict[str, Any]:
    """The entry of the moment when the simulated microscope was switched on."""
    with path.open(encoding="utf-8") as file:
        for line in file:
            entry: dict[str, Any] = json.loads(line)
            if entry["event"] == "start":
                return entry
    raise ValueError("it has no beginning")
