"""Drift against time, and spectra, each as options of ECharts and a line of text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from afspm.basics import Plain, quantity, time_of_day, typeset_position, zone_offset_s
from afspm.components import Array
from afspm.drawing import Axis, Curve, thinned
from afspm.model import RegistrationOutcome, Spectrum, registration_summary
from afspm.night import DriftPoint

Options = Plain
BEFORE = 6  # spectra that are shown faintly behind the newest
MOST_DRIFT = 5_000
_MARGINS = {"left": 8, "right": 16, "top": 30, "bottom": 28, "containLabel": True}
_QUIET, _LINE = "var(--quiet)", "var(--line)"
_LEGEND = {"top": 0, "right": 0, "icon": "rect", "itemWidth": 14, "itemHeight": 3, "textStyle": {"color": _QUIET}}


@dataclass(frozen=True)
class Chart:
    """A chart and the HTML above the chart; without `options` nothing is drawn."""

    words: str
    options: Options | None = None


def drift_chart(points: Sequence[DriftPoint]) -> Chart:
    """Return the drift of the sample in x and y against time, for the last `MOST_DRIFT` points.

    The time of day is of this computer's zone, as everywhere on the page, also in a browser in another zone. The text
    above the chart has the present velocity. Figure 7 of the paper.
    """
    if not points:
        return Chart('<p class="nothing">This experiment does not track drift.</p>')
    registered = registration_summary(point.outcome for point in points)
    points = points[-MOST_DRIFT:]
    # shown as UTC: the chart knows only UTC and the zone of the browser
    time_ms = np.array([point.time_ns / 1e6 for point in points]) + 1e3 * zone_offset_s(points[-1].time_ns)
    xy = np.array([point.translation_m for point in points])
    lost = np.array([point.lost for point in points])
    guessed = np.array([not point.matched for point in points]) & ~lost
    shown: Array = np.where(lost[:, None], np.nan, xy)
    y = Axis.over("drift of the sample", "m", shown)
    factor, _ = y.scaled
    series = [_line(Curve(time_ms, shown[:, i], f"var(--t{i})"), 1.0, factor, name) for i, name in enumerate("xy")]
    if guessed.any():
        either = np.concatenate([xy[guessed, 0], xy[guessed, 1]]) * factor
        dots = {"type": "scatter", "name": "predicted only", "symbolSize": 5, "itemStyle": {"color": "var(--bad)"}}
        series.append({**dots, "data": _pairs(np.tile(time_ms[guessed], 2), either)})
    options = _options(series, {"type": "time"}, y)
    return Chart(_drift_words(points[-1], registered), {**options, "legend": _LEGEND, "useUTC": True})


def _drift_words(point: DriftPoint, registered: str) -> str:
    count = f"<p>{registered[0].upper()}{registered[1:]}.</p>"
    speed = math.hypot(*point.rate_m_s) * 60
    if point.lost:
        return f'<p class="alarm">The sample is lost: {escape(point.reason) or "no scan fits"}</p>{count}'
    how = "corrected" if point.correcting else "not corrected yet"
    at = f"{typeset_position(point.translation_m)}, moving at {quantity(speed, 'm')}/min, {how}"
    if point.outcome is RegistrationOutcome.REGISTERED:
        return f"<p>{at}</p>{count}"
    sd = "" if point.sd_m is None else f" (standard deviation {quantity(point.sd_m, 'm', 2)})"
    what = "known coarsely" if point.matched else "predicted"
    return f'<p>{at}</p><p class="alarm">The last scan is {what}{sd}: {escape(point.reason)}</p>{count}'


def spectrum_chart(
    spectra: Sequence[tuple[int, Spectrum]], variable: str, facts: Sequence[tuple[str, str]] = ()
) -> Chart:
    """Return the last of `spectra`, with up to `BEFORE` earlier spectra of the same variables behind it.

    Args:
        variable: variable drawn against the first; the second is drawn if the spectrum has no variable of this name.
        facts: pairs of label and text about the last of `spectra`.
    """
    if not spectra:
        return Chart('<p class="nothing">No spectrum has been taken.</p>')
    time_ns, last = spectra[-1]
    if len(last.names) < 2 or not len(last.values):
        return Chart(f'<p class="nothing">A spectrum at {time_of_day(time_ns)} that has no curve.</p>')
    variable = variable if variable in last.names[1:] else last.names[1]
    before = [s for _, s in spectra[:-1] if s.names == last.names and s.units == last.units][-BEFORE:]
    unit = last.units[last.names.index(variable)]
    x = Axis.over(last.label(last.names[0]), last.units[0], last.values[:, 0])
    y = Axis.over(last.label(variable), unit, np.concatenate([s[variable] for s in (*before, last)]))
    curves = [Curve(s.values[:, 0], s[variable], _QUIET, 0.4) for s in before]
    curves.append(Curve(last.values[:, 0], last[variable], "var(--t0)"))
    series = [_line(curve, x.scaled[0], y.scaled[0]) for curve in curves]
    where = "" if last.position_m is None else f" at {typeset_position(last.position_m)}"
    more = "".join(f"<br>{escape(label)}: {escape(text)}" for label, text in facts)
    words = f"<p>{escape(last.kind or 'Spectrum')}{where}, {time_of_day(time_ns)}{more}</p>"
    return Chart(words, _options(series, {"type": "value", "scale": True, "name": x.scaled[1]}, y))


def _line(curve: Curve, across: float, up: float, name: str = "") -> Options:
    style = {"color": curve.colour}
    return {
        "type": "line", "name": name, "data": _pairs(*thinned(curve.x * across, curve.y * up)), "showSymbol": False,
        "itemStyle": style, "lineStyle": {**style, "width": 1.6, "opacity": curve.opacity},
        "emphasis": {"disabled": True},
    }  # fmt: skip


def _pairs(x: Array, y: Array) -> list[list[float | None]]:
    # JSON has no NaN: None is a gap
    points = zip(x.tolist(), y.tolist(), strict=True)
    return [[a if math.isfinite(a) else None, float(f"{b:.6g}") if math.isfinite(a + b) else None] for a, b in points]


def _options(series: list[Options], x: Options, y: Axis) -> Options:
    axis = {
        "axisLabel": {"color": _QUIET},
        "axisLine": {"onZero": False, "lineStyle": {"color": _LINE}},
        "splitLine": {"show": False},
    }
    names = {"nameTextStyle": {"color": _QUIET, "align": "left"}, "nameGap": 12}
    return {
        "animation": False, "grid": _MARGINS, "series": series,
        "tooltip": {"trigger": "axis", "className": "tip", "borderWidth": 0},
        "xAxis": {**axis, "nameLocation": "middle", "nameTextStyle": {"color": _QUIET}, "nameGap": 26, **x},
        "yAxis": {**axis, **names, "type": "value", "scale": True, "name": y.scaled[1],
                  "splitLine": {"lineStyle": {"color": _LINE}}},
    }  # fmt: skip
