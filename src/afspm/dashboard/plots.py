"""Curves as HTML: lines in SVG that stretch with the page, and around them numbers that don't."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.dashboard.words import escape, scale

Array = NDArray[np.float64]
MOST_POINTS = 600


@dataclass(frozen=True)
class Curve:
    """A line through points.

    Attributes:
        style: a class of the style sheet.
        name: for the legend; empty: not in it.
        dots: points and no line.
    """

    x: Array
    y: Array
    style: str
    name: str = ""
    dots: bool = False


@dataclass(frozen=True)
class Axis:
    """What is along an axis.

    Attributes:
        label: its name; the unit is put behind it, with the prefix that fits.
        text: how a tick is written instead, e.g. as a time of day.
        ticks: where; None: where numbers are round.
    """

    label: str
    unit: str = ""
    text: Callable[[float], str] | None = None
    ticks: Sequence[float] | None = None


def plot(curves: Sequence[Curve], x: Axis, y: Axis, title: str) -> str:
    """Curves with axes. What is not finite is a gap."""
    known = [curve for curve in curves if np.isfinite(curve.x).any() and np.isfinite(curve.y).any()]
    if not known:
        return f'<p class="nothing">{escape(title)}: nothing yet</p>'
    x_from, x_to = _range([curve.x for curve in known], margin=0.0)
    y_from, y_to = _range([curve.y for curve in known], margin=0.06)
    lines = "".join(_drawn(curve, (x_from, x_to), (y_from, y_to)) for curve in known)
    x_ticks, x_label = _ticks(x, x_from, x_to)
    y_ticks, y_label = _ticks(y, y_from, y_to)
    across = "".join(_tick("x", at, text) for at, text in x_ticks)
    up = "".join(_tick("y", at, text) for at, text in y_ticks)
    return (
        f'<figure class="plot" role="img" aria-label="{escape(title)}">'
        f'<figcaption><span class="y-label">{escape(y_label)}</span>{_legend(known)}</figcaption>'
        '<div class="plot-area"><svg viewBox="0 0 1000 1000" preserveAspectRatio="none" aria-hidden="true">'
        f'{lines}</svg>{up}{across}</div><div class="x-label">{escape(x_label)}</div></figure>'
    )


def round_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers between two, about so many."""
    if not high > low:
        return [low]
    step = 10.0 ** math.floor(math.log10((high - low) / about))
    step *= next((factor for factor in (1, 2, 5, 10) if (high - low) / (step * factor) <= about), 10)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(i * step, 15 - math.floor(math.log10(abs(i * step) or 1.0))) for i in range(first, last + 1)]


def thinned(x: Array, y: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """Of many points the lowest and highest of each stretch, in their order, so that no peak gets lost."""
    if len(x) <= most:
        return x, y
    edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
    chosen: list[int] = []
    for begin, end in itertools.pairwise(edges.tolist()):
        part = y[begin:end]
        if not np.isfinite(part).any():
            chosen.append(begin)
            continue
        chosen += sorted({int(begin + np.nanargmin(part)), int(begin + np.nanargmax(part))})
    return x[chosen], y[chosen]


def _range(parts: Iterable[Array], margin: float) -> tuple[float, float]:
    finite = np.concatenate([part[np.isfinite(part)] for part in parts])
    low, high = float(finite.min()), float(finite.max())
    if not high > low:
        around = abs(low) * 0.05 or 1.0
        return low - around, high + around
    return low - margin * (high - low), high + margin * (high - low)


def _drawn(curve: Curve, across: tuple[float, float], up: tuple[float, float]) -> str:
    x, y = thinned(curve.x, curve.y)
    x = (x - across[0]) / (across[1] - across[0]) * 1000
    y = 1000 - (y - up[0]) / (up[1] - up[0]) * 1000
    if curve.dots:  # a line of no length with round ends is a dot that doesn't stretch
        path = "".join(f"M{a:.0f} {b:.0f}h0" for a, b in zip(x, y, strict=True) if math.isfinite(a + b))
        return f'<path class="dots {curve.style}" d="{path}"/>'
    parts, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if not math.isfinite(a + b):
            pen = "M"
            continue
        parts.append(f"{pen}{a:.1f} {b:.1f}")
        pen = "L"
    return f'<path class="{curve.style}" d="{"".join(parts)}"/>'


def _ticks(axis: Axis, low: float, high: float) -> tuple[list[tuple[float, str]], str]:
    """([(0 to 1 along the axis, text)], label)."""
    if axis.text is not None:
        at = axis.ticks if axis.ticks is not None else round_ticks(low, high)
        return [((v - low) / (high - low), axis.text(v)) for v in at if low <= v <= high], axis.label
    factor, unit = scale(max(abs(low), abs(high)), axis.unit)
    values = round_ticks(low * factor, high * factor)
    label = f"{axis.label} [{unit}]" if unit else axis.label
    texts = [f"{v:g}".replace("-", "−") for v in values]
    return [((v / factor - low) / (high - low), text) for v, text in zip(values, texts, strict=True)], label


def _tick(axis: str, at: float, text: str) -> str:
    side = "left" if axis == "x" else "bottom"
    return f'<span class="tick-{axis}" style="{side}:{100 * at:.2f}%">{escape(text)}</span>'


def _legend(curves: Sequence[Curve]) -> str:
    named = [curve for curve in curves if curve.name]
    items = "".join(f'<span class="key {curve.style}">{escape(curve.name)}</span>' for curve in named)
    return f'<span class="legend">{items}</span>' if len(named) > 1 else ""
