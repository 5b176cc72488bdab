"""Files of the emulated Studio: .nhf of format 2, HDF5 with integers scaled to a range."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from afspm.basics import PlainMapping
from afspm.components import Array
from afspm.emulation import RETRACE, ScanActivity, SpectrumActivity

if TYPE_CHECKING:
    import h5py

_MISSING: Final = -(2**31)
_LARGEST: Final = 2**31 - 1
SegmentChannels = Mapping[str, tuple[str, Array]]
_SEGMENTS: Final = ("Forward", "Backward")
_BLOCKS: Final = "block_size"


def image(scan: ScanActivity, now_s: float, mode: str) -> bytes:
    """Encode the file of a scan; lines not scanned hold the fill value."""
    channels = scan.channels(scan.end_s if scan.stopped_s is not None else None)
    (rows, columns), region = scan.shape, scan.region
    width, height = region.size_m
    facts = {
        "group_type": "image_line_based",
        "image_scan_direction": "up" if scan.upwards else "down",
        "image_line_rate": 1.0 / scan.line_s,
        "image_points_per_line": np.uint32(columns),
        "image_number_of_lines": np.uint32(rows),
        "image_size_x": width,
        "image_size_y": height,
        "scanner_offset_x": region.center_m[0],
        "scanner_offset_y": region.center_m[1],
        "scanner_rotation": float(np.degrees(region.angle_rad)),
    }
    frame = {
        "rect_axis_size": np.array([rows, columns], np.uint32),
        "rect_axis_range": np.array([height, width]),
        "rect_rotation": float(np.degrees(region.angle_rad)),
    }
    forward = {name: data for name, data in channels.items() if not name.endswith(RETRACE)}
    backward = {name.removesuffix(RETRACE): data for name, data in channels.items() if name.endswith(RETRACE)}
    return _file({**facts, "measurement_mode": mode}, frame, [forward, backward], now_s)


def curves(spectra: Sequence[SpectrumActivity], shape: tuple[int, int], now_s: float, mode: str) -> bytes:
    """Encode the file of force curves: one segment for the approach, one for the retract.

    The axes of a segment are a line for each curve (! segment-axes).

    Args:
        spectra: the curves.
        shape: shape of the grid, (rows, columns).
    """
    facts = {
        "group_type": "spectroscopy",
        "measurement_mode": mode,
        "grid_number_of_rows": np.uint32(shape[0]),
        "grid_number_of_columns": np.uint32(shape[1]),
    }
    axes = {"rect_axis_size": np.array([len(spectra), len(spectra[0].values)], np.uint32)}
    ways = zip(*(spectrum.both_ways() for spectrum in spectra), strict=True)
    segments = [
        {name: (unit, np.concatenate([one[name][1] for one in way])) for name, (unit, _) in way[0].items()}
        for way in ways
    ]
    return _file(facts, axes, segments, now_s, blocks=[len(spectrum.values) for spectrum in spectra])


def _file(
    facts: PlainMapping,
    axes: PlainMapping,
    segments: Sequence[SegmentChannels],
    now_s: float,
    *,
    blocks: Sequence[int] = (),
) -> bytes:
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        written = datetime.fromtimestamp(now_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        file.attrs.update(nsf_file_version_major=np.uint32(2), nsf_file_version_minor=np.uint32(0), created=written)
        group = file.create_group("group_0000")
        group.attrs.update(facts)
        group.attrs.update(measurement_name="SIMULATED", created=written, modified=written)
        for number, (name, channels) in enumerate(zip(_SEGMENTS, segments, strict=True)):
            segment = group.create_group(f"segment_{number:04d}")
            segment.attrs.update(axes)
            segment.attrs["segment_name"] = name
            for index, (signal, (unit, values)) in enumerate(channels.items()):
                _add(segment, f"dataset_{index:04d}", signal, unit, values)
            if blocks:
                _add_blocks(segment, blocks)
        file.create_group("group_0001").attrs["group_type"] = "calibration"
    return content.getvalue()


def _add(segment: h5py.Group, name: str, signal: str, unit: str, values: Array) -> None:
    # Real files have integers over a range about zero, and NSFopen relies on this range.
    largest = float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values))) or 1.0
    integers = np.where(np.isfinite(values), np.rint(values / largest * _LARGEST), _MISSING).astype(np.int32)
    dataset = segment.create_dataset(name, data=integers.ravel(), fillvalue=_MISSING)
    dataset.attrs.update(
        signal_name=signal,
        signal_unit=unit,
        signal_calibration_unit=unit,
        signal_calibration_min=-largest,
        signal_calibration_max=largest,
        dataset_element_type="int32",
        dataset_block_size_source=_BLOCKS,
    )


def _add_blocks(segment: h5py.Group, sizes: Sequence[int]) -> None:
    dataset = segment.create_dataset("dataset_blocks", data=np.array(sizes, np.uint32))
    dataset.attrs["dataset_block_size_id"] = _BLOCKS
