"""Drift against time, and spectra, as they are on the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from afspm.clock import NS_PER_S
from afspm.dashboard.plots import Array, Axis, Curve, plot
from afspm.dashboard.time_line import time_ticks
from afspm.dashboard.words import escape, position, quantity
from afspm.formatting import time_of_day
from afspm.model import Spectrum
from afspm.record.overview import DriftPoint

BEFORE = 6  # spectra that are shown faintly behind the newest
MOST_DRIFT = 5_000


def drift_html(points: Sequence[DriftPoint]) -> str:
    """Where the sample has drifted to, and how fast, against time: as figure 7 of the paper has it."""
    if not points:
        return '<p class="nothing">Nobody tracks drift in this experiment.</p>'
    points = points[-MOST_DRIFT:]
    seconds = np.array([point.time_ns / NS_PER_S for point in points])
    xy = np.array([point.translation_m for point in points])
    lost = np.array([point.lost for point in points])
    guessed = np.array([not point.matched for point in points])
    shown: Array = np.where(lost[:, None], np.nan, xy)
    curves = [
        Curve(seconds, shown[:, 0], "curve-a", "x"),
        Curve(seconds, shown[:, 1], "curve-b", "y"),
    ]
    if guessed.any():
        either = np.concatenate([xy[guessed & ~lost, 0], xy[guessed & ~lost, 1]])
        curves.append(Curve(np.tile(seconds[guessed & ~lost], 2), either, "curve-c", "predicted only", dots=True))
    times = Axis(
        "", text=lambda s: time_of_day(round(s * NS_PER_S), seconds=False), ticks=time_ticks(seconds[0], seconds[-1])
    )
    return _drift_words(points[-1]) + plot(curves, times, Axis("drift of the sample", "m"), "Drift against time")


def _drift_words(point: DriftPoint) -> str:
    speed = math.hypot(*point.rate_m_s) * 60
    if point.lost:
        return f'<p class="alarm">The sample is lost: {escape(point.reason) or "no scan fits"}</p>'
    how = "corrected" if point.correcting else "not corrected yet"
    word = "" if point.matched else f"; the last scan did not fit ({escape(point.reason)})"
    return f"<p>{position(point.translation_m)}, moving at {quantity(speed, 'm')}/min, {how}{word}</p>"


def spectrum_html(spectra: Sequence[tuple[int, Spectrum]], variable: str) -> str:
    """The last of `spectra`, and behind it those before that have the same variables.

    Args:
        variable: which is shown against the first; another is taken if it has none of this name.
    """
    if not spectra:
        return '<p class="nothing">No spectrum has been taken.</p>'
    time_ns, last = spectra[-1]
    if len(last.names) < 2 or not len(last.values):
        return f'<p class="nothing">A spectrum at {time_of_day(time_ns)} that has no curve.</p>'
    variable = variable if variable in last.names[1:] else last.names[1]
    unit = last.units[last.names.index(variable)]
    before = [s for _, s in spectra[:-1] if s.names == last.names and s.units == last.units][-BEFORE:]
    curves = [Curve(s.values[:, 0], s[variable], "curve-old") for s in before]
    curves.append(Curve(last.values[:, 0], last[variable], "curve-a"))
    where = "" if last.position_m is None else f" at {position(last.position_m)}"
    words = f"<p>{escape(last.kind or 'Spectrum')}{where}, {time_of_day(time_ns)}</p>"
    return words + plot(curves, Axis(last.names[0], last.units[0]), Axis(variable, unit), f"Spectrum: {variable}")
