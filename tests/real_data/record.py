"""Facts of each file of a real microscope as afspm reads it: shapes, units, geometry, times, sums, and the file's hash.

`make real-data-record` writes them to record.json, to be looked through before they are committed; `make real-data`
compares.
"""

from __future__ import annotations

import hashlib
import json
import sys
from datetime import UTC
from pathlib import Path
from typing import Any, Final

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))

from benchmarks.data_folder import DATA  # noqa: E402  (its folder is put on the path first)

import afspm  # noqa: E402
from afspm.storage.formats import suffixes  # noqa: E402

RECORD: Final = Path(__file__).with_name("record.json")
ARRAYS: Final = (".npy", ".npz")
NOT_RECORDED: Final = (".md",)


def recorded() -> dict[str, dict[str, Any]]:
    """Return the committed facts, by the file's path in the folder."""
    found: dict[str, dict[str, Any]] = json.loads(RECORD.read_text(encoding="utf-8"))
    return found


def present() -> list[str]:
    """Return the files in the folder."""
    paths = (path for path in DATA.rglob("*") if path.is_file() and path.suffix not in NOT_RECORDED)
    return sorted(path.relative_to(DATA).as_posix() for path in paths)


def facts(name: str) -> dict[str, Any]:
    """Return the facts of one file; the hash alone where afspm reads no such file."""
    path = DATA / name
    found: dict[str, Any] = {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    if path.suffix in suffixes():
        content = afspm.read(path, zone=UTC)
        found |= {"controller": content.controller, "upwards": content.upwards}
        found |= {"start_ns": content.start_ns, "end_ns": content.end_ns}
        found["scans"] = [
            {
                "channel": scan.channel,
                "center_m": [float(value) for value in scan.region.center_m],
                "size_m": [float(value) for value in scan.region.size_m],
                "angle_rad": float(scan.region.angle_rad),
                "unit": scan.unit,
                **_numbers(scan.values),
            }
            for scan in content.scans
        ]
        found["spectra"] = [
            {
                "kind": curve.kind,
                "position_m": None if curve.position_m is None else [float(value) for value in curve.position_m],
                "names": list(curve.names),
                "units": list(curve.units),
                **_numbers(curve.values),
            }
            for curve in content.spectra
        ]
    elif path.suffix in ARRAYS:
        loaded = np.load(path)
        arrays = {"": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
        found["arrays"] = {key: _numbers(values) for key, values in arrays.items() if values.dtype.kind in "fiu"}
    return found


def _numbers(values: np.ndarray) -> dict[str, Any]:
    # the sum with each place's own weight, too: an image that is turned or mirrored has the same plain sum
    known = np.where(np.isfinite(values), values, 0.0).astype(np.float64)
    weights = np.arange(1.0, known.size + 1.0).reshape(known.shape) / known.size
    return {
        "shape": list(values.shape),
        "missing": int(values.size - np.isfinite(values).sum()),
        "sum": float(known.sum()),
        "weighted_sum": float((known * weights).sum()),
        "sum_of_sizes": float(np.abs(known).sum()),
    }


if __name__ == "__main__":
    RECORD.write_text(json.dumps({name: facts(name) for name in present()}, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(f"{RECORD}: {len(present())} files of {DATA}; look through `git diff` before you commit it\n")
