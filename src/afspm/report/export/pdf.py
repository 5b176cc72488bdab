"""Figures for print (.pdf): of each measurement, of the night, as packages declare, and as components wrote them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.report import pictures, story
from afspm.report.export import png

PICTURES = True
_DPI = 300


def write(run: Run, row: ScanRow | SpectrumRow, channels: Sequence[str] = ()) -> Iterator[tuple[str, bytes]]:
    """Yield (suffix, content) of a figure for each channel of a scan, or of a spectrum."""
    for suffix, figure in png.figures(run, row, channels):
        for axes in figure.axes:
            for mesh in axes.collections:
                mesh.set_rasterized(True)  # of one square for each pixel a viewer shows the seams
        yield f"{suffix}.pdf", png.content(figure, "pdf", _DPI)


def tables(run: Run, scans: list[ScanRow], spectra: list[SpectrumRow]) -> Iterator[tuple[str, bytes]]:
    """Yield (name, content) of the figures about the whole run, unless single scans are asked for."""
    if len(scans) < sum(bool(row.file) for row in run.scans):
        return
    contents = story.read(run)
    bad_ns = pictures.bad_ns(run, contents)
    shown = pictures.of_scans(run, pictures.chosen(contents.scans, kept_ns=bad_ns), bad_ns)
    if any(one.thumbnail is not None for one in shown):
        yield "night.pdf", png.content(pictures.picture_of_night(run, contents, shown), "pdf")
    for name, figure in pictures.declared_figures(run, contents, again=True):
        yield f"{name}.pdf", png.content(figure, "pdf")
    for path in sorted(run.folder.glob("*.pdf")):  # of a survey or a map: only its component has all data of it
        yield path.name, path.read_bytes()
