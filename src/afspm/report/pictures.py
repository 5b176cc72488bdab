"""Thumbnails of scans, and the figures beside the report, from the files of a run."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from afspm.basics import entry_points
from afspm.basics.errors import AfspmError
from afspm.drawing import reduced
from afspm.drawing import shown_image as shown
from afspm.drawing.image_html import Shown
from afspm.drawing.raster import pooled_range
from afspm.model import TOPOGRAPHY, ControlMode, ControlState, ScanSet, names
from afspm.model.arrays import Array
from afspm.model.line_levelling import flattened
from afspm.night.bad_scans import bad_scans
from afspm.night.night_record import NightMark, NightRecord, Shot, Thumbnail, thumbnail
from afspm.night.run import Run
from afspm.night.tables import ScanRow
from afspm.night.treatment_ledger import treatments_once
from afspm.report.story import RunStory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 98
LARGEST_PX = 192
FIGURE_PX = 1400
_QUALITY = 80
NIGHT, OFFSET = "night.png", "drift_offset.png"
"""File names of figures drawn by components."""
OWN_NIGHT, _OWN_OFFSET = "report.png", "report_drift.png"
_DPI = 200
_TOPOGRAPHY = ("height", "topo", "z ", "z")
_log = logging.getLogger("afspm.report")


@dataclass(frozen=True)
class TopographyPicture:
    """A scan with images of its topography, which are None if no values can be read.

    Attributes:
        image: the levelled image in colour; None if the scan has no readable values.
        thumbnail: the image for the figure of the night; None if the scan has no readable values.
        is_bad: whether the image is drawn with a frame.
        changed_row: the first row with a changed tip, found in the lines of the running scan; None: no change found.
        unread: why the file of the scan can't be read; empty if it was read, or the scan has no file.
    """

    row: ScanRow
    channel: str = ""
    unit: str = ""
    image: Shown | None = None
    thumbnail: Thumbnail | None = None
    is_bad: bool = False
    changed_row: int | None = None
    unread: str = ""


@dataclass(frozen=True)
class FigurePicture:
    """A figure drawn by a component, as embedded in the page; `ratio` is its width divided by its height."""

    name: str
    image: bytes
    ratio: float


def of_scans(
    run: Run,
    rows: Sequence[ScanRow],
    bad_ns: Collection[int] = (),
    step: Callable[[str], None] = lambda _: None,
) -> list[TopographyPicture]:
    """Return the scans with pictures; `bad_ns`: times of the bad scans; `step`: called with a text before each scan."""
    changed = run.changed_rows()
    read = []
    for count, row in enumerate(rows, 1):
        step(f"reading scan {count} of {len(rows)}")
        read.append(_read(run, row))
    compared: dict[tuple[str, float], list[Array]] = {}
    for one, values in read:
        if one.thumbnail is not None and values is not None:
            compared.setdefault(one.thumbnail.kind, []).append(values)
    # scans of one size are compared: their colours mean the same heights
    spans = {kind: pooled_range(values) for kind, values in compared.items()}
    pictures = []
    for one, values in read:
        image = None
        if one.thumbnail is not None and values is not None:
            image = shown(values, LARGEST_PX, small=True, span=spans[one.thumbnail.kind])
        of_ns = one.row.time_ns
        pictures.append(replace(one, image=image, is_bad=of_ns in bad_ns, changed_row=changed.get(of_ns)))
    return pictures


def bad_ns(run: Run, story: RunStory) -> frozenset[int]:
    lanes = story.overview.timelines.problems.items()
    flagged_ns = {number: [span.start_ns for span in lane.spans] for number, lane in lanes}
    interrupted_ns = [row.time_ns for row in story.scans if row.interrupted]
    times_ns = [row.time_ns for row in story.scans]
    return bad_scans(times_ns, run.verdicts(), flagged_ns, interrupted_ns, story.overview.of_conditions)


def chosen(rows: Sequence[ScanRow], most: int = MOST, kept_ns: Collection[int] = ()) -> list[ScanRow]:
    """Return at most `most` rows in order: scans at `kept_ns` (at most half), and an even selection of the rest."""
    if len(rows) <= most:
        return list(rows)
    odd = [k for k, row in enumerate(rows) if row.time_ns in kept_ns][: most // 2]
    rest = sorted(set(range(len(rows))) - set(odd))
    even = [rest[k] for k in np.linspace(0, len(rest) - 1, most - len(odd)).round().astype(int)]
    return [rows[k] for k in sorted({*odd, *even})]


def _read(run: Run, row: ScanRow) -> tuple[TopographyPicture, Array | None]:
    # without the image, but with its values
    if not row.file:
        return TopographyPicture(row), None
    try:
        scans = run.scan(row)
    except AfspmError as error:
        _log.warning("scan %d has no picture: %s", row.number, error)
        return TopographyPicture(row, unread=f"scan {row.number}: {error}"), None
    scan = scans[topography(scans)]
    if not np.isfinite(scan.values).any():
        return TopographyPicture(row, scan.channel, scan.unit), None
    values = reduced(flattened(scan.values), LARGEST_PX, each_side=True)
    return TopographyPicture(row, scan.channel, scan.unit, thumbnail=thumbnail(scan)), values


def is_topography(channel: str) -> bool:
    """Return whether the name of a channel is a name of heights."""
    return channel.lower().startswith(_TOPOGRAPHY)


def topography(scans: ScanSet) -> str:
    """Return the displayed channel of a scan: the topography, else one with a name like a height, else the first."""
    if TOPOGRAPHY in scans:
        return scans[TOPOGRAPHY].channel
    return next((c for name in _TOPOGRAPHY for c in scans if c.lower().startswith(name)), scans.first.channel)


def draw(run: Run, story: RunStory, pictures: Sequence[TopographyPicture]) -> None:
    """Draw the picture of the night unless a component has drawn it, and the figures that packages declare."""
    if is_ours(run.folder, OWN_NIGHT, NIGHT) and any(one.thumbnail is not None for one in pictures):
        picture_of_night(run, story, pictures).savefig(run.folder / OWN_NIGHT, dpi=_DPI)
    for name, figure in declared_figures(run, story):
        figure.savefig(run.folder / f"{name}.png", dpi=_DPI)


def picture_of_night(run: Run, story: RunStory, pictures: Sequence[TopographyPicture]) -> Figure:
    """Return the picture of the night."""
    from afspm.report.night_figure import figure_of

    record = night_of(run, story, pictures)
    numbers = {number: story.overview.problems.name(number) for number in record.problems}
    return figure_of(record, numbers, title=story.name, simulated=story.simulated)


def declared_figures(run: Run, story: RunStory, *, again: bool = False) -> Iterator[tuple[str, Figure]]:
    """Yield (name, figure) as packages declare; `again`: also of figures that a component has drawn."""
    title = f"{story.name}   SIMULATED" if story.simulated else story.name
    for name in entry_points.names(entry_points.FIGURES):
        try:
            yield from entry_points.load(entry_points.FIGURES, name)(run, title, again)
        except Exception as error:  # a package's code may raise anything: the report does without its figure
            _log.warning("the figure %s is not drawn: %s: %s", name, type(error).__name__, error)


def is_ours(folder: Path, own: str, components: str) -> bool:
    """Return whether the report draws a figure itself; remove its own figure if a component has drawn one since."""
    if (folder / components).exists():
        (folder / own).unlink(missing_ok=True)
        return False
    return True


def night_of(run: Run, story: RunStory, pictures: Sequence[TopographyPicture]) -> NightRecord:
    """Return the data for the picture of the night."""
    record = NightRecord(end_ns=story.end_ns, scans_taken=len(story.scans))
    record.shots = [
        Shot(one.row.time_ns, one.row.began_ns, one.row.holder, one.thumbnail)
        for one in pictures
        if one.thumbnail is not None
    ]
    record.control = [(row.time_ns, row.state) for row in run.control] or [
        (story.start_ns, ControlState(ControlMode.UNDEFINED))
    ]
    record.routine = [span.start_ns for span in story.overview.routine_spans]
    record.of_conditions = set(story.overview.of_conditions)
    record.interruptions = [row.time_ns for row in story.scans if row.interrupted]
    record.marks = [NightMark(of_ns, "", "verdict", score, of_ns) for of_ns, score in run.verdicts()]
    record.marks += [
        NightMark(entry.time_ns, entry.who, entry.what)
        for entry in treatments_once(run.journal)
        if entry.what in names.TREATMENTS and entry.response == 0
    ]
    return record


def of_figures(folder: Path) -> list[FigurePicture]:
    """Return the figures in the run folder except the report's own night: the night first, then drift, then others."""
    found = [path for path in folder.glob("*.png") if path.name != OWN_NIGHT]  # the page itself shows the same
    first = (NIGHT, OFFSET, _OWN_OFFSET)
    found.sort(key=lambda path: (first.index(path.name) if path.name in first else len(first), path.name))
    return [made for path in found if (made := _reduced(path)) is not None]


def _reduced(path: Path) -> FigurePicture | None:
    # at the resolution that a page shows, a figure takes a tenth of the bytes
    from PIL import Image

    try:
        with Image.open(path) as image:
            small = image.convert("RGB")
    except OSError as error:  # also raised for a file that is not an image
        _log.warning("%s is not shown: %s", path.name, error)
        return None
    small.thumbnail((FIGURE_PX, FIGURE_PX))
    written = io.BytesIO()
    small.save(written, "WEBP", quality=_QUALITY)
    return FigurePicture(path.name, written.getvalue(), small.width / small.height)
