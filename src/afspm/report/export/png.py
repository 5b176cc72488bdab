"""Images (.png) of each channel of a scan, with scale bar and colour bar, and of each spectrum."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from afspm.basics.clock import iso_utc
from afspm.drawing.plotting import WITH_ASPECT, save_figure
from afspm.model import Scan, Spectrum
from afspm.model.line_levelling import flattened
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.report.export import file_word
from afspm.report.pictures import is_topography

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES = True
_DPI = 150


def write(run: Run, row: ScanRow | SpectrumRow, channels: Sequence[str] = ()) -> Iterator[tuple[str, bytes]]:
    """Yield (suffix, content) of an image for each channel of a scan, or of a spectrum."""
    for suffix, figure in figures(run, row, channels):
        yield f"{suffix}.png", content(figure, "png")


def figures(run: Run, row: ScanRow | SpectrumRow, channels: Sequence[str] = ()) -> Iterator[tuple[str, Figure]]:
    """Yield (suffix, figure) of each channel of a scan, or of a spectrum.

    Raises:
        NoSuchItem: the scan has no such channel.
    """
    time = f"{iso_utc(row.time_ns)[:19].replace('T', ' ')} UTC"
    if isinstance(row, ScanRow):
        there = run.scan(row)
        for scan in [there[name] for name in channels] or there.values():
            channel = scan.channel
            is_levelled = is_topography(channel)
            shown = replace(scan, values=flattened(scan.values)) if is_levelled else scan
            title = _title(run, f"{channel}{', lines levelled' if is_levelled else ''}, {time}", row.interrupted)
            yield f"_{file_word(channel)}", scan_figure(shown, title)
    else:
        title = _title(run, f"{row.kind}, {time}", interrupted=False)
        yield "", spectrum_figure(run.spectrum(row), title)


def scan_figure(scan: Scan, title: str) -> Figure:
    """Return a figure of a scan with colour bar and scale bar."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.6), layout=WITH_ASPECT)
    axes = figure.add_subplot()
    if np.isfinite(scan.values).any():
        scan.plot(axes=axes)
    axes.set_title(title, fontsize=9)
    return figure


def spectrum_figure(spectrum: Spectrum, title: str) -> Figure:
    """Return a figure of every variable over the first, one above the other."""
    from matplotlib.figure import Figure

    others = list(zip(spectrum.names, spectrum.units, spectrum.values.T, strict=True))[1:]
    figure = Figure(figsize=(5.2, 1.2 + 2.0 * max(1, len(others))), layout="constrained")
    panels = figure.subplots(max(1, len(others)), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, unit, values) in zip(panels, others, strict=False):
        axes.plot(spectrum.values[:, 0], values, linewidth=1.0)
        axes.set_ylabel(f"{name} / {unit}" if unit else name)
    panels[-1].set_xlabel(f"{spectrum.names[0]} / {spectrum.units[0]}" if spectrum.names else "")
    panels[0].set_title(title, fontsize=9)
    return figure


def content(figure: Figure, suffix: str, dpi: int = _DPI) -> bytes:
    """Return a figure as a file of a format that matplotlib knows by this suffix; `dpi`: of parts with pixels."""
    file = io.BytesIO()
    save_figure(figure, file, dpi, suffix)
    return file.getvalue()


def _title(run: Run, text: str, interrupted: bool) -> str:
    marks = [mark for mark, is_so in (("SIMULATED", run.simulated), ("interrupted", interrupted)) if is_so]
    return ", ".join([*marks, text])
