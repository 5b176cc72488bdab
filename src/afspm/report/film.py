"""Scans of one place as a film aligned on the sample: `run.film()`, and `afspm export --to gif` or `mp4`.

Theory of operation. Scans of nearly the same size and angle show one place if their centres differ by at most half the
size along each axis after the recorded drift is subtracted. The region of the first scan is the window of the film.
Lines of each scan are levelled, and its values are sampled at the window's pixels in sample coordinates; pixels outside
a scan stay NaN. All frames have one contrast: a range that contains the robust range of each frame.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from afspm.basics import typeset_length
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import FileError, InvalidValue
from afspm.basics.formatting import day_and_time, duration_text, quantity
from afspm.drawing import PALETTES, round_length_m
from afspm.drawing.palette import colour_map
from afspm.drawing.raster import ValueRange, indices, shared_range
from afspm.model import Frame, Region, Scan
from afspm.model.arrays import Array
from afspm.model.geometry import XY
from afspm.model.line_levelling import flattened
from afspm.night.tables import ScanRow

if TYPE_CHECKING:
    from PIL import Image, ImageDraw

    from afspm.night import DriftPoint

_log = logging.getLogger("afspm.record")
FORMATS: Final = (".gif", ".mp4")
WIDTH_PX: Final = 480
FRAMES_PER_S: Final = 8.0
_MOST_OFFSET: Final = 0.5
"""Largest offset of scans of one place along each axis, as a share of their size."""
_SIZE_TOLERANCE: Final = 0.05
_TURN_TOLERANCE_RAD: Final = math.radians(1.0)
_FONT_PX: Final = 15
_MARGIN_PX: Final = 10
_UNMEASURED_RGB: Final = (128, 128, 128)


class RecordedScans(Protocol):
    """The part of a `Run` that a film needs."""

    @property
    def name(self) -> str: ...
    @property
    def simulated(self) -> bool: ...
    @property
    def frame(self) -> Frame: ...
    @property
    def drift(self) -> Sequence[DriftPoint]: ...
    @property
    def scans(self) -> Sequence[ScanRow]: ...
    def scan(self, which: ScanRow) -> Mapping[str, Scan]: ...


@dataclass(frozen=True)
class Film:
    """Scans of one place, aligned on the sample.

    Attributes:
        frames: levelled values, shape (scans, rows, columns), [y, x] ascending; NaN where a scan does not reach.
        channel, unit: channel and unit of the values.
        numbers, times_ns: number and end of each scan.
        window: the region of each frame: the region of the first scan, after subtraction of its recorded drift.
        drift_m: the subtracted displacement of the sample since the first scan, (x, y) in m, shape (scans, 2);
            zeros without recorded drift.
        aligned_by: "sample coordinates", "recorded drift", or "" if the scans are as they were measured.
        name: the name of the experiment; simulated: whether the microscope was simulated.
    """

    frames: Array
    channel: str
    unit: str
    numbers: tuple[int, ...]
    times_ns: tuple[int, ...]
    window: Region
    drift_m: Array
    aligned_by: str
    name: str = ""
    simulated: bool = False

    @property
    def range(self) -> ValueRange:
        """The values at the ends of the colour map, the same for all frames."""
        return shared_range(self.frames)

    def images(self, width_px: int = WIDTH_PX) -> Iterator[Image.Image]:
        """Yield a picture for each frame, with scale bar, clock, channel and range. Width and height are even."""
        from PIL import Image

        span = self.range
        colours = np.vstack([colour_map(PALETTES[0]), np.array(_UNMEASURED_RGB, np.uint8)[np.newaxis]])
        width = width_px - width_px % 2
        height = 2 * max(1, round(width * self.window.size_m[1] / self.window.size_m[0] / 2.0))
        for index, values in enumerate(self.frames):
            levels = indices(values, span)[::-1]
            picture = Image.fromarray(np.ascontiguousarray(colours[levels])).resize(
                (width, height), Image.Resampling.NEAREST
            )
            self._label(picture, index, span)
            yield picture

    def save(self, path: str | Path, frames_per_s: float = FRAMES_PER_S, width_px: int = WIDTH_PX) -> Path:
        """Write a film as .gif, or as .mp4 (needs the extra `film`).

        Raises:
            InvalidValue: another ending, or `frames_per_s` not above 0 and at most 60.
            FileError: the film can't be written, or the extra is missing.
        """
        path = Path(path)
        if path.suffix not in FORMATS:
            raise InvalidValue(f"a film can't be written as {path.suffix!r}", hint=f"one of {', '.join(FORMATS)}")
        if not 0.0 < frames_per_s <= 60.0:
            raise InvalidValue(f"{frames_per_s:g} frames a second can't be shown", hint="above 0, at most 60")
        partial = path.with_suffix(f".part{path.suffix}")
        try:
            write = _write_gif if path.suffix == ".gif" else _write_mp4
            write(partial, list(self.images(width_px)), frames_per_s)
            partial.replace(path)
        except OSError as error:
            raise FileError(f"can't be written: {error}", where=str(path)) from error
        finally:
            partial.unlink(missing_ok=True)
        return path

    def _label(self, picture: Image.Image, index: int, span: ValueRange) -> None:
        from PIL import ImageDraw

        draw = ImageDraw.Draw(picture)
        width, height = picture.size
        after_s = (self.times_ns[index] - self.times_ns[0]) / NS_PER_S
        clock = f"+{duration_text(after_s)}" if index else "start"
        when = day_and_time(self.times_ns[index], UTC, seconds=False)
        _write(draw, (_MARGIN_PX, _MARGIN_PX), f"{clock}   {when}", "la")
        _write(draw, (width - _MARGIN_PX, _MARGIN_PX), f"scan {self.numbers[index]}", "ra")
        bar_m = round_length_m(self.window.size_m[0] / 3.0)
        bar_px = round(bar_m / self.window.size_m[0] * width)
        low = height - _MARGIN_PX
        draw.rectangle((_MARGIN_PX, low - 5, _MARGIN_PX + bar_px, low), fill="white", outline="black")
        _write(draw, (_MARGIN_PX, low - 9), typeset_length(bar_m), "ld")
        # heights after levelling have no zero: only their span has a meaning
        shown = f"{self.channel}, {quantity(span.high - span.low, self.unit, 3)} dark to bright"
        _write(draw, (width - _MARGIN_PX, low), f"SIMULATED, {shown}" if self.simulated else shown, "rd")


def film_of_run(run: RecordedScans, rows: Sequence[ScanRow] | None = None, channel: str | None = None) -> Film:
    """Return the film of `run.film`, whose arguments and errors are these."""
    drift = recorded_drift(run)
    if rows is None:
        groups = places(run.scans, drift)
        if not groups:
            raise InvalidValue("a film needs two scans of one place, and there are none")
        rows = groups[0]
    return film_of(run, rows, channel, drift)


def film_of(
    run: RecordedScans, rows: Sequence[ScanRow], channel: str | None = None, drift: Mapping[int, XY] | None = None
) -> Film:
    """Return the film of scans of one place; a scan with a missing or damaged file is left out and logged.

    Args:
        rows: the scans, in the order of the film; of interrupted scans, the measured lines are shown.
        channel: the shown channel, by name or role; None: the first channel of the first scan.
        drift: the result of `recorded_drift`; None: read from the run.

    Raises:
        InvalidValue: fewer than two readable scans, not of one place, or a scan without the channel.
    """
    if len(rows) < 2:
        raise InvalidValue(f"a film needs two scans of one place, not {len(rows)}")
    drift = recorded_drift(run) if drift is None else drift
    places = [_place(row, drift) for row in rows]
    for row, place in zip(rows, places, strict=True):
        if not _is_same_place(places[0], place):
            raise InvalidValue(f"scans {rows[0].number} and {row.number} are of different places", hint="choose others")
    read = [_scan(run, row, channel or rows[0].channels[0][0]) for row in rows]
    scans = [scan for scan in read if scan is not None]
    if len(scans) < 2:
        raise InvalidValue(f"a film needs two scans of one place, and of {len(read)} only {len(scans)} can be read")
    places = [place for place, scan in zip(places, read, strict=True) if scan is not None]
    rows = [row for row, scan in zip(rows, read, strict=True) if scan is not None]
    taken = [np.asarray(scan.values, dtype=np.float64) for scan in scans]
    window, (height, width) = places[0], taken[0].shape
    pixels_m = window.pixels_m((height, width))
    frames = np.stack([_sampled(flattened(one), place, pixels_m) for one, place in zip(taken, places, strict=True)])
    moved = np.array([_drift_at(row, drift) for row in rows]) if drift else np.zeros((len(rows), 2))
    return Film(
        frames=frames,
        channel=scans[0].channel,
        unit=scans[0].unit,
        numbers=tuple(row.number for row in rows),
        times_ns=tuple(row.time_ns for row in rows),
        window=window,
        drift_m=moved - moved[0],
        aligned_by=_aligned_by(rows[0], drift),
        name=run.name,
        simulated=run.simulated,
    )


def places(rows: Sequence[ScanRow], drift: Mapping[int, XY]) -> list[list[ScanRow]]:
    """Return the scans of each place that was scanned at least twice with the same channels, the most scans first."""
    groups: list[tuple[Region, list[ScanRow]]] = []
    for row in rows:
        if row.region is None or not row.file:
            continue
        place = _place(row, drift)
        same = (
            group for window, group in groups if _is_same_place(window, place) and group[0].channels == row.channels
        )
        group = next(same, None)
        if group is None:
            groups.append((place, [row]))
        else:
            group.append(row)
    return sorted((group for _, group in groups if len(group) > 1), key=len, reverse=True)


def recorded_drift(run: RecordedScans) -> Mapping[int, XY]:
    """Return the displacement of the sample (x, y) in m, in tip coordinates, by the time of the scan.

    Scans at which the position of the sample was lost are left out.
    Zero for scans with places in sample coordinates.
    Empty if all places are in sample coordinates, or if no drift was recorded.
    """
    points = [point for point in run.drift if not point.lost]
    # a run may have begun without correction (`correct_after`)
    corrected = {point.time_ns for point in points if point.correcting and run.frame is Frame.SAMPLE}
    if len(corrected) == len(points):
        return {}
    return {point.time_ns: (0.0, 0.0) if point.time_ns in corrected else point.translation_m for point in points}


def _drift_at(row: ScanRow, drift: Mapping[int, XY]) -> XY:
    return drift[min(drift, key=lambda time_ns: abs(time_ns - row.time_ns))]


def _place(row: ScanRow, drift: Mapping[int, XY]) -> Region:
    if row.region is None:
        raise InvalidValue(f"scan {row.number} was interrupted before anything of it was seen")
    if not drift:
        return row.region
    (x, y), (moved_x, moved_y) = row.region.center_m, _drift_at(row, drift)
    return row.region.moved_to((x - moved_x, y - moved_y))


def _is_same_place(first: Region, second: Region) -> bool:
    by = first.compared(second)
    is_alike = by.size <= _SIZE_TOLERANCE and abs(by.turned_rad) <= _TURN_TOLERANCE_RAD
    return is_alike and by.apart <= _MOST_OFFSET


def _scan(run: RecordedScans, row: ScanRow, channel: str) -> Scan | None:
    try:
        scans = run.scan(row)
    except FileError as error:
        _log.warning("scan %d is missing in the film: %s", row.number, error)
        return None
    if channel not in scans:
        raise InvalidValue(f"scan {row.number} has no channel {channel!r}", hint=f"there are {', '.join(scans)}")
    return scans[channel]


def _sampled(values: Array, place: Region, pixels_m: tuple[Array, Array]) -> Array:
    # NaN outside the scan, and beside its unmeasured pixels
    from scipy.ndimage import map_coordinates

    rows, columns = values.shape
    at = place.pixel_at(*pixels_m, (rows, columns))
    # a hundredth of a pixel beyond the border is rounding, not another place
    near = [np.where(np.abs(axis - axis.round()) < 1e-2, axis.round(), axis) for axis in at]
    return np.asarray(map_coordinates(values, near, order=1, cval=np.nan), dtype=np.float64)


def _aligned_by(row: ScanRow, drift: Mapping[int, XY]) -> str:
    if row.region is not None and row.region.frame is Frame.SAMPLE:
        return "sample coordinates"
    return "recorded drift" if drift else ""


def _write(draw: ImageDraw.ImageDraw, at: tuple[float, float], text: str, anchor: str) -> None:
    from PIL import ImageFont

    draw.text(
        at,
        text,
        fill="white",
        anchor=anchor,
        font=ImageFont.load_default(_FONT_PX),
        stroke_width=2,
        stroke_fill="black",
    )


def _write_gif(path: Path, images: Sequence[Image.Image], frames_per_s: float) -> None:
    first, *others = (image.quantize(128) for image in images)
    first.save(path, save_all=True, append_images=others, duration=round(1000.0 / frames_per_s), loop=0, optimize=False)


def _write_mp4(path: Path, images: Sequence[Image.Image], frames_per_s: float) -> None:
    try:
        import av
    except ImportError as error:
        raise FileError(
            "writing .mp4 needs PyAV, which is not installed",
            where=str(path),
            hint='pip install "afspm[film]", or write a .gif',
        ) from error
    from fractions import Fraction

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(frames_per_s).limit_denominator(1000))
        # every player reads this; sharp edges of text need a low factor
        stream.width, stream.height = images[0].size
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "18"}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(image), format="rgb24")))
        container.mux(stream.encode())
