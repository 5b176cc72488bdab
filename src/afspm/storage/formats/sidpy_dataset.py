"""Scans to and from sidpy's Datasets, the format of the pycroscopy ecosystem.

sidpy's images are [x, y], afspm's are [y, x]. Install sidpy yourself; with its dependencies, sidpy takes a gigabyte.
"""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from afspm.basics.errors import InvalidValue
from afspm.model.caption import SettingInForce
from afspm.model.geometry import Frame, Region

if TYPE_CHECKING:
    import sidpy

    from afspm.model.scan import Scan

_OURS = "afspm"


def to_sidpy(scan: Scan) -> sidpy.Dataset:
    """Return the scan as a `sidpy.Dataset`; see `Scan.to_sidpy`."""
    import sidpy

    values = scan.values if scan.values.size else np.full(scan.shape, np.nan)
    made = sidpy.Dataset.from_array(np.ascontiguousarray(values.T), title=scan.channel)
    made.data_type, made.quantity, made.units = "image", scan.channel, scan.unit
    starts_sizes = zip(scan.region.top_left_m, scan.region.size_m, scan.shape[::-1], strict=True)
    for axis, (name, (start, size, count)) in enumerate(zip("xy", starts_sizes, strict=True)):
        along = np.linspace(start, start + size, count)
        made.set_dimension(axis, sidpy.Dimension(along, name, "length", "m", "spatial"))
    made.original_metadata[_OURS] = {
        "angle_rad": scan.region.angle_rad,
        "frame": scan.region.frame.value,
        "time": "" if scan.time is None else scan.time.isoformat(),
        "filename": scan.filename,
        "roles": list(scan.roles),
        "in_force": [asdict(one) for one in scan.in_force],
        "simulated": scan.simulated,
    }
    return made


def from_sidpy(dataset: sidpy.Dataset) -> Scan:
    """Return a sidpy image as a scan; see `Scan.from_sidpy`."""
    from afspm.basics import units
    from afspm.model.scan import Scan

    if len(dataset.shape) != 2:
        raise InvalidValue(
            f"a scan is an image, not a dataset of {len(dataset.shape)} dimensions", hint="one channel of it"
        )
    axes = [dataset.get_dimension_by_number(axis)[0] for axis in (0, 1)]
    low, size = [], []
    for axis in axes:
        along = np.asarray(axis.values, dtype=float) * units.convert(1.0, str(axis.units), "m")
        low.append(float(along.min()))
        size.append(float(np.ptp(along)))
    ours = dict(dataset.original_metadata.get(_OURS, {}))
    center = (low[0] + size[0] / 2, low[1] + size[1] / 2)
    region = Region(center, (size[0], size[1]), float(ours.get("angle_rad", 0.0)), Frame(ours.get("frame", "tip")))
    values = np.asarray(dataset, dtype=float).T
    for dimension, axis in enumerate(axes[::-1]):
        if len(axis.values) > 1 and axis.values[0] > axis.values[-1]:
            values = np.flip(values, dimension)
    time = ours.get("time")
    time_ns = round(datetime.fromisoformat(time).timestamp() * 1e9) if time else None
    return Scan(
        region,
        str(dataset.quantity),
        str(dataset.units),
        values,
        time_ns,
        str(ours.get("filename", "")),
        roles=tuple(ours.get("roles", ())),
        in_force=tuple(SettingInForce(**one) for one in ours.get("in_force", ())),
        simulated=bool(ours.get("simulated")),
    )
