"""Scans and mappings as what survives a kill: JSON and numpy arrays, exact to the last bit."""

from __future__ import annotations

from collections.abc import Mapping as Table
from typing import Any

import numpy as np

from afspm.drift.registration import DriftScan
from afspm.errors import InvalidValue
from afspm.model import Frame, Region


def scan_to_dict(scan: DriftScan) -> dict[str, Any]:
    """A scan, its values as they are."""
    region = scan.region
    return {
        "values": scan.values,
        "center_m": list(region.center_m),
        "size_m": list(region.size_m),
        "angle_rad": region.angle_rad,
        "frame": region.frame.value,
        "start_s": scan.start_s,
        "end_s": scan.end_s,
        "upwards": scan.upwards,
        "key": scan.key,
    }


def scan_from_dict(table: Table[str, Any]) -> DriftScan:
    """What `scan_to_dict` made."""
    center_m, size_m = tuple(table["center_m"]), tuple(table["size_m"])
    return DriftScan(
        values=np.asarray(table["values"], dtype=np.float64),
        region=Region(center_m, size_m, table["angle_rad"], Frame(table["frame"])),
        start_s=table["start_s"],
        end_s=table["end_s"],
        upwards=table["upwards"],
        key=table["key"],
    )


def must_be(state: Table[str, Any], kind: str, version: int) -> None:
    """Refuse the state of something else.

    Raises:
        InvalidValue: it is not of that kind and version.
    """
    if (state.get("kind"), state.get("version")) != (kind, version):
        found = f"{state.get('kind')!r}, version {state.get('version')!r}"
        raise InvalidValue(f"a saved tracker of kind {found} instead of {kind!r}, version {version}")


def must_be_newer(scan: DriftScan, newest_s: float | None) -> None:
    """Refuse a scan out of its turn.

    Raises:
        InvalidValue: it is older than the newest one.
    """
    if newest_s is not None and scan.mid_s < newest_s:
        late = f"the middle of scan {scan.key!r} is at {scan.mid_s:g} s, and {newest_s:g} s was reached already"
        raise InvalidValue(late, hint="a tracker takes scans in the order of time")
