"""The true drift of a simulated run, from the simulator's file `truth.jsonl`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from afspm.basics import AfspmError, FileError, Plain, from_json
from afspm.components import Array
from afspm.emulation import World
from afspm.plugins.drift.registration import DriftScan

TRUTH_FILE = "truth.jsonl"


def true_drift(run_dir: Path, scans: Sequence[DriftScan]) -> Array | None:
    """Return the sample's true displacement since the first scan, at each scan's centre, (n, 2), in m; None if unknown.

    The result includes displacement by rotation and expansion of the sample. The drift that the controller itself
    compensates is subtracted, since tip coordinates move with the compensation; the compensated drift is interpolated
    between the starts and ends of scans. The result is None without the file or without scans, and after a restart of
    an emulated controller.

    Raises:
        FileError: the file can't be read, or does not describe a simulated run.
    """
    # the simulated microscope writes it into the run's folder, an emulated controller into its own
    path = next(iter((*run_dir.glob(TRUTH_FILE), *sorted(run_dir.glob(f"*/{TRUTH_FILE}")))), None)
    if path is None or not scans:
        return None
    try:
        starts, followed = _read(path)
        if len(starts) > 1:  # an emulated controller that was restarted has begun with another sample
            return None
        (start,) = starts
        world = World.from_settings(start["settings"], int(start["seed"]), float(start["time_s"]))
    except (OSError, KeyError, ValueError, AfspmError) as error:
        raise FileError(f"does not say what was simulated: {error}", where=str(path)) from error
    time_s = np.array([scan.mid_s for scan in scans])
    tip_m = np.array([scan.region.center_m for scan in scans])
    followed_m = np.stack([np.interp(time_s, followed[:, 0], followed[:, axis]) for axis in (1, 2)], axis=-1)
    on_sample_m = world.sample.to_sample(tip_m + followed_m, time_s)
    at_first_m: Array = world.sample.to_tip(on_sample_m, time_s[0]) - followed_m[0]
    return tip_m - at_first_m


def _read(path: Path) -> tuple[list[Plain], Array]:
    # the entries of starts, and the drift that the controller compensated by then, (n, 3): time, x, y
    starts: list[Plain] = []
    followed: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0)]
    with path.open(encoding="utf-8") as file:
        for line in file:
            try:
                entry: Plain = from_json(line)
            except ValueError:
                continue  # a line cut off by a kill
            if entry["event"] == "start":
                starts.append(entry)
            scan = entry.get("scan")
            if isinstance(scan, dict) and "compensated_start_m" in scan:
                followed += [(scan[f"{at}_s"], *scan[f"compensated_{at}_m"][:2]) for at in ("start", "end")]
    if not starts:
        raise ValueError("the entry of the simulator's start is missing")
    return starts, np.array(sorted(followed), dtype=np.float64)
