"""Off-line analysis of drift in recorded scans, by a tracker and by registration with the first scan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from afspm.basics import FileError, InvalidValue
from afspm.components import Array
from afspm.model import Frame, Region, RegistrationOutcome
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.plugins.drift.track.record import DriftRecord
from afspm.plugins.drift.track.shear import delay_per_length_s_m, row_delay_s
from afspm.plugins.drift.track.tracking import Tracker, Update


def followed(scans: Sequence[DriftScan], tracker: Tracker) -> Iterator[Update]:
    """Yield the tracker's update for each scan; scans must be in order of time."""
    for scan in scans:
        yield tracker.add(scan)


def against_first(record: DriftRecord, scans: Sequence[DriftScan], pairs: Sequence[Registration]) -> DriftRecord:
    """Return a record of the displacement from the first scan to each later scan, by registration of the pair alone.

    A registration holds for the times at which both scans passed the centre of the overlap. The drift between these
    times and the middles of the scans is subtracted, with the tracker's rates.

    Args:
        record: drift record of the tracker.
        pairs: registrations of the first scan with each later scan.
    """
    drift, covariance = [np.zeros(2)], [np.zeros((2, 2))]
    rate_m_s = record.rate_then_m_s
    for k, (scan, pair) in enumerate(zip(scans[1:], pairs, strict=True), start=1):
        early = rate_m_s[0] * (row_delay_s(scans[0], pair.center_m) or 0.0)
        late = rate_m_s[k] * (row_delay_s(scan, pair.center_m + pair.displacement_m) or 0.0)
        drift.append(pair.displacement_m - (late - early))
        covariance.append(pair.covariance_m2)
    return replace(
        record,
        drift_m=np.array(drift),
        covariance_m2=np.array(covariance),
        matched=np.array([True, *(pair.accepted for pair in pairs)]),
        reasons=("", *(pair.reason for pair in pairs)),
        outcomes=(RegistrationOutcome.REGISTERED, *(pair.outcome for pair in pairs)),
        failures=(0, *(int(bool(pair.failure)) for pair in pairs)),
    )


def spread_pairs(record: DriftRecord, apart_s: float, count: int) -> list[tuple[int, int]]:
    """Return at most `count` index pairs of matched scans about `apart_s` apart, with starts spread over the run.

    In a run shorter than `apart_s`, the pairs join scans from its beginning and its end. Empty with fewer than two
    matched scans.
    """
    good = np.flatnonzero(record.matched)
    if len(good) < 2:
        return []
    time_s = record.time_s[good]
    apart_s = min(apart_s, float(time_s[-1] - time_s[0]))
    starts = np.flatnonzero(time_s <= time_s[-1] - 0.95 * apart_s)
    chosen = dict.fromkeys(np.linspace(0, len(starts) - 1, count).round().astype(int).tolist())
    ends = [int(np.argmin(np.abs(time_s - time_s[start] - apart_s))) for start in starts[list(chosen)]]
    return [(int(good[start]), int(good[end])) for start, end in zip(starts[list(chosen)], ends, strict=True)]


@dataclass(frozen=True, eq=False)
class Stack:
    """Aligned images of one area of the sample.

    Attributes:
        values: [scan, y, x]; NaN where nothing was measured.
        region: region of all images, in sample coordinates, which are tip coordinates at zero drift.
        time_s: (n,) middle of each scan.
        keys: the names of the scans.
    """

    values: Array
    region: Region
    time_s: Array
    keys: tuple[str, ...]

    def write(self, path: Path, *, channel: str = "values", unit: str = "") -> None:
        """Write a classic NetCDF file, which xarray opens with its coordinates.

        Raises:
            FileError: the file can't be written.
        """
        from scipy.io import netcdf_file

        (left, low), (width, height) = self.region.top_left_m, self.region.size_m
        _, ny, nx = self.values.shape
        axes = {
            "time": (self.time_s, "s"),
            "y": (np.linspace(low, low + height, ny), "m"),
            "x": (np.linspace(left, left + width, nx), "m"),
        }
        try:
            with netcdf_file(path, "w", version=2) as file:
                about = {"frame": "sample", "angle_rad": self.region.angle_rad, "scans": "\n".join(self.keys)}
                for name, value in about.items():
                    setattr(file, name, value)
                for name, (positions, of) in axes.items():
                    file.createDimension(name, len(positions))
                    _variable(file, name, (name,), positions, of)
                _variable(file, channel.replace("/", "_"), tuple(axes), self.values, unit)
        except OSError as error:
            raise FileError(f"can't be written: {error}", where=str(path)) from error


def corrected(scans: Sequence[DriftScan], drift_m: Array, rate_m_s: Array | None = None) -> Stack:
    """Return the stack of drift-corrected scans, with the pixel size and angle of the first scan.

    The sample moves during a scan, so the place of a row on the sample depends on the time of the row. The rate
    corrects this shear in scans with a known slow-scan direction.

    Args:
        drift_m: (n, 2) displacement of the sample at the middle of each scan.
        rate_m_s: (n, 2) velocity of the sample during each scan; None: zero.

    Raises:
        InvalidValue: the scans have no common area, or different angles.
    """
    from scipy.ndimage import map_coordinates

    region, shape = common_area(scans, drift_m)
    x_m, y_m = region.pixels_m(shape)
    rates = np.zeros_like(drift_m) if rate_m_s is None else rate_m_s
    values = np.empty((len(scans), *shape))
    for k, scan in enumerate(scans):
        rows, columns = _pixels_at(scan, x_m + drift_m[k, 0], y_m + drift_m[k, 1], rates[k])
        # NaN would spread through the whole spline: holes are filled here, and marked again in the result
        measured = np.isfinite(scan.values)
        filled = np.where(measured, scan.values, np.median(scan.values[measured]) if measured.any() else 0.0)
        values[k] = map_coordinates(filled, [rows, columns], order=3, mode="nearest")
        if not measured.all():
            holes = map_coordinates((~measured).astype(float), [rows, columns], order=1, mode="nearest")
            values[k][holes > 0.0] = np.nan
    return Stack(values, region, np.array([scan.mid_s for scan in scans]), tuple(scan.key for scan in scans))


def common_area(scans: Sequence[DriftScan], drift_m: Array) -> tuple[Region, tuple[int, int]]:
    """Return the rectangle of the sample common to all scans, in sample coordinates, and its pixels (ny, nx).

    Raises:
        InvalidValue: the scans have no common rectangle, or different angles.
    """
    angle = scans[0].region.angle_rad
    if any(abs(math.remainder(scan.region.angle_rad - angle, math.tau)) > 1e-6 for scan in scans):
        raise InvalidValue("scans of different angles have no common rectangle", hint="choose scans of one angle")
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, sin], [-sin, cos]])  # into the axes of the frames
    centers = (np.array([scan.region.center_m for scan in scans]) - drift_m) @ turn.T
    half = np.array([scan.region.size_m for scan in scans]) / 2
    low, high = (centers - half).max(axis=0), (centers + half).min(axis=0)
    pixel = np.asarray(scans[0].pixel_m)
    counts = np.floor((high - low) / pixel + 1e-9).astype(int) + 1
    if counts.min() < 2:
        raise InvalidValue("the scans have no common area", hint="leave out scans that are far away")
    size = (counts - 1) * pixel
    center = ((low + high) / 2) @ turn
    region = Region((center[0], center[1]), (size[0], size[1]), angle, Frame.SAMPLE)
    return region, (int(counts[1]), int(counts[0]))


def _pixels_at(scan: DriftScan, x_m: Array, y_m: Array, rate_m_s: Array) -> tuple[Array, Array]:
    # Row and column at which a scan met a place of the sample that was at (x, y) under the tip at mid-scan. With u
    # along the rows and v across them, from the centre of the frame, the row at v is taken v / v_scan after the middle,
    # and meanwhile the sample moves with w: v = v_mid + w_v v / v_scan, which is linear in v.
    (ny, nx), (dx, dy) = scan.values.shape, scan.pixel_m
    cos, sin = math.cos(scan.region.angle_rad), math.sin(scan.region.angle_rad)
    x, y = x_m - scan.region.center_m[0], y_m - scan.region.center_m[1]
    u, v = x * cos + y * sin, y * cos - x * sin
    slowness = delay_per_length_s_m(scan)
    if slowness is not None:
        along, across = rate_m_s @ np.array([[cos, -sin], [sin, cos]])
        v = v / (1.0 - across * slowness)
        u = u + along * slowness * v
    rows: Array = v / dy + (ny - 1) / 2
    columns: Array = u / dx + (nx - 1) / 2
    return rows, columns


def _variable(file: object, name: str, axes: tuple[str, ...], values: Array, unit: str) -> None:
    made = file.createVariable(name, "d", axes)  # type: ignore[attr-defined]
    made[:] = values
    made.units = unit
