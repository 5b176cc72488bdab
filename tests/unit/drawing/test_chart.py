"""Charts as SVG."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np

from afspm.drawing.chart import Axis, Band, Curve, chart

BIAS = np.linspace(-1.0, 1.0, 21)


def test_chart_has_ticks_units_and_its_curves_within_the_frame() -> None:
    current = 3e-9 * BIAS
    drawn = chart(Axis.over("Bias", "V", BIAS), Axis.over("<I>", "A", current), [Curve(BIAS, current)])
    assert ElementTree.fromstring(drawn).tag == "svg"
    assert "Bias / V" in drawn
    assert "&lt;I&gt; / nA" in drawn
    assert ">−2</text>" in drawn
    points = re.search(r'<polyline[^>]* points="([^"]*)"', drawn)
    assert points is not None
    x, y = np.array([pair.split(",") for pair in points[1].split()], dtype=float).T
    assert (x[0], x[-1]) == (46.0, 312.0)
    assert y[0] > y[-1]  # upwards
    assert y.min() >= 8.0


def test_unmeasured_points_are_left_out_and_a_single_value_has_an_axis() -> None:
    values = np.array([1.0, np.nan, 1.0])
    axis = Axis.over("a", "", values)
    assert axis.low < 1.0 < axis.high
    drawn = chart(axis, axis, [Curve(values, values)], Band(values, values, values))
    assert "nan" not in drawn
    assert Axis.over("b", "", np.array([np.nan])).high == 1.0
