"""The spectra of a report: for each kind the curves with mean and spread, and small charts that enlarge."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from afspm.basics.errors import AfspmError, InvalidValue
from afspm.basics.formatting import typeset_position
from afspm.drawing import Axis, Curve
from afspm.drawing.chart import BACKWARD, Band, chart
from afspm.model import Spectrum
from afspm.model.arrays import Array
from afspm.model.geometry import XY
from afspm.night.run import Run
from afspm.night.tables import SpectrumRow
from afspm.record.spectrum_grid import at, common_sweep, grid, ways
from afspm.report import markup
from afspm.report.markup import PageTimes
from afspm.report.proofs import ResultProofs

MOST_READ = 400
MOST_SMALL = 100
_WIDEST_GRID = 12
_LEAST_AVERAGED = 3


@dataclass(frozen=True)
class SpectrumCurves:
    """A spectrum with its row in the record."""

    row: SpectrumRow
    spectrum: Spectrum

    @property
    def curves(self) -> dict[str, Array]:
        """The variables of the forward sweep, by name."""
        return ways(self.spectrum)[1][0]

    @property
    def back(self) -> dict[str, Array]:
        """The variables of the backward sweep, by name; empty without a backward sweep."""
        directions = ways(self.spectrum)[1]
        return directions[1] if len(directions) > 1 else {}

    def values(self, name: str) -> Array:
        return np.concatenate([way[name] for way in (self.curves, self.back) if name in way])

    @property
    def swept(self) -> Array:
        return ways(self.spectrum)[0]


@dataclass(frozen=True)
class SpectrumGroup:
    """Spectra of one kind with the same variables; `count` includes unread spectra."""

    measured: Sequence[SpectrumCurves]
    count: int

    @property
    def first(self) -> Spectrum:
        return self.measured[0].spectrum

    @property
    def positions(self) -> list[XY]:
        return [measured.spectrum.position_m for measured in self.measured if measured.spectrum.position_m is not None]

    @property
    def axes(self) -> tuple[Axis, dict[str, Axis]]:
        """The axis of the sweep and an axis for each variable, over the range of all curves."""
        first = self.first
        units = dict(zip(first.names, first.units, strict=True))
        swept = np.concatenate([spectrum.swept for spectrum in self.measured])
        others = {
            name: Axis.over(
                name, units.get(name, ""), np.concatenate([spectrum.values(name) for spectrum in self.measured])
            )
            for name in self.measured[0].curves
        }
        return Axis.over(first.names[0], first.units[0], swept), others


def read(run: Run, unread: list[str]) -> list[SpectrumGroup]:
    """Read the spectra of a run: of each kind, an even selection of at most `MOST_READ`.

    Args:
        unread: gets the reason for each file that can't be read.
    """
    rows: dict[tuple[object, ...], list[SpectrumRow]] = {}
    for row in run.spectra:
        if len(row.names) > 1:
            rows.setdefault((row.kind, row.names, row.units), []).append(row)
    groups = []
    for of_kind in rows.values():
        some = np.unique(np.linspace(0, len(of_kind) - 1, MOST_READ).round().astype(int))
        if measured := list(_read(run, [of_kind[k] for k in some], unread)):
            groups.append(SpectrumGroup(measured, len(of_kind)))
    return groups


def html(groups: Sequence[SpectrumGroup], clock: PageTimes, proofs: ResultProofs) -> str:
    """Return the HTML of all spectra; empty without spectra."""
    return "".join(_group(group, number, clock, proofs) for number, group in enumerate(groups, 1))


def _read(run: Run, rows: Iterable[SpectrumRow], unread: list[str]) -> Iterator[SpectrumCurves]:
    for row in rows:
        try:
            yield SpectrumCurves(row, run.spectrum(row))
        except AfspmError as error:
            unread.append(f"spectrum {row.number}: {error}")


def _group(group: SpectrumGroup, number: int, clock: PageTimes, proofs: ResultProofs) -> str:
    x, axes = group.axes
    charts = "".join(_all(group, x, axis, name) for name, axis in axes.items())
    kind = escape(group.first.kind or "spectra")
    return (
        f'<h3>{kind}: {group.count}</h3><div class="charts">{charts}</div><p class="note">{_legend(group)}</p>'
        f"{_small(group, number, clock, proofs)}"
    )


def _all(group: SpectrumGroup, x: Axis, y: Axis, name: str) -> str:
    measured = group.measured
    if len(measured) < _LEAST_AVERAGED:
        return chart(x, y, [curve for spectrum in measured for curve in _both_ways(spectrum, name)])
    step = -(-len(measured) // MOST_SMALL)
    thin = max(0.15, min(0.6, 6.0 / len(measured)))
    curves = [Curve(spectrum.swept, spectrum.curves[name], "", thin) for spectrum in measured[::step]]
    if (common := _common(measured)) is None:
        return chart(x, y, curves)
    if back := [at(common, spectrum.swept, spectrum.back[name]) for spectrum in measured if name in spectrum.back]:
        curves.append(Curve(common, np.mean(back, axis=0), BACKWARD))
    values = np.stack([at(common, spectrum.swept, spectrum.curves[name]) for spectrum in measured])
    mean, spread = values.mean(axis=0), values.std(axis=0, ddof=1)
    return chart(x, y, [*curves, Curve(common, mean)], Band(common, mean - spread, mean + spread))


def _both_ways(spectrum: SpectrumCurves, name: str) -> Iterator[Curve]:
    if name in spectrum.back:
        yield Curve(spectrum.swept, spectrum.back[name], BACKWARD)
    yield Curve(spectrum.swept, spectrum.curves[name])


def _common(measured: Sequence[SpectrumCurves]) -> Array | None:
    # None where the common range is less than half of the widest sweep
    try:
        common = common_sweep([spectrum.swept for spectrum in measured])
    except InvalidValue:
        return None
    return common if np.ptp(common) > 0.5 * max(np.ptp(spectrum.swept) for spectrum in measured) else None


def _legend(group: SpectrumGroup) -> str:
    sentences = []
    if len(group.measured) >= _LEAST_AVERAGED:
        sentences.append("Thin: single curves. Thick: their mean; the band is one standard deviation.")
    if any(spectrum.back for spectrum in group.measured):
        sentences.append("Orange: on the way there; blue: on the way back.")
    if left_out := group.count - len(group.measured):
        sentences.append(f"{left_out} more are not read.")
    return " ".join(sentences)


def _small(group: SpectrumGroup, number: int, clock: PageTimes, proofs: ResultProofs) -> str:
    shown = group.measured[:MOST_SMALL]
    if len(shown) < 2:
        return ""
    places, columns = _places(shown)
    names = ["", *(f"spectrum-{number}-{spectrum.row.number}" for spectrum in shown), ""]
    axes = group.axes
    figures = "".join(
        _figure(spectrum, axes, clock, names[k : k + 3], places[k] if places else "", proofs)
        for k, spectrum in enumerate(shown)
    )
    style = f' style="grid-template-columns:repeat({columns},minmax(0,1fr));gap:.3rem"' if places else ""
    position = "Each lies where it was measured on the grid, y upwards. " if places else ""
    more = f" {group.count - len(shown)} more are not shown." if group.count > len(shown) else ""
    note = f'<p class="note">{position}Click a curve to enlarge it; all have the same axes.{more}</p>'
    return f'<div class="sheet"{style}>{figures}</div>{note}'


def _places(shown: Sequence[SpectrumCurves]) -> tuple[list[str], int]:
    positions = [measured.spectrum.position_m for measured in shown]
    try:
        points = grid([position for position in positions if position is not None])
    except InvalidValue:
        return [], 0
    columns, rows = len(points.x_m), len(points.y_m)
    if None in positions or len(set(points.cells)) < len(shown) or not 1 < columns <= _WIDEST_GRID:
        return [], 0
    return [f"grid-row:{rows - row};grid-column:{column + 1}" for row, column in points.cells], columns


def _figure(
    spectrum: SpectrumCurves,
    axes: tuple[Axis, dict[str, Axis]],
    clock: PageTimes,
    names: Sequence[str],
    place: str,
    proofs: ResultProofs,
) -> str:
    x, others = axes
    charts = [chart(x, axis, list(_both_ways(spectrum, name))) for name, axis in others.items()]
    row = spectrum.row
    where = "" if row.position_m is None else typeset_position(row.position_m)
    facts = {
        "spectrum": f"{row.number}{f', {escape(row.key)}' if row.key else ''}",
        "finished": clock.whole(row.time_ns),
        "at": where,
        "points": str(row.points),
        "in control": escape(row.holder or "none"),
        "problems": escape(", ".join(row.problems)),
        **dict(proofs.facts(row)),
        "file": escape(row.file),
        "variables": f'<div class="charts">{"".join(charts[1:])}</div>' if charts[1:] else "",
    }
    before, name, after = names
    return markup.figure(
        name, charts[0], str(row.number), facts, beside=(before, after), style="curves", ratio=1.5, place=place
    )
