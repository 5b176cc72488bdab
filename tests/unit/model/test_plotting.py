"""Scans drawn with matplotlib, and given to and taken from sidpy."""

from __future__ import annotations

from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from afspm.basics.errors import InvalidValue
from afspm.model import Region, Scan
from afspm.model.caption import stated_settings

mpl.use("Agg")
VALUES = np.arange(12.0).reshape(3, 4) * 1e-9
SCAN = Scan(Region((1e-6, 2e-6), (3e-7, 2e-7), 0.1), "Height", "m", VALUES, 1_750_000_000_123_456_000, "a.sxm")


@pytest.mark.parametrize("kind", ["image", "contour", "surface"])
def test_scan_is_drawn_at_its_position(kind: str) -> None:
    axes = SCAN.plot(kind)
    axes.figure.canvas.draw()
    assert axes.get_xlim() == pytest.approx((850e-9, 1150e-9), abs=80e-9)
    assert axes.get_ylim() == pytest.approx((1900e-9, 2100e-9), abs=80e-9)
    assert axes.get_xlabel() == "x / nm"
    if kind != "surface":
        assert axes.child_axes[0].get_ylabel() == "Height / nm"
        assert axes.texts[0].get_text().endswith("0 nm")
        assert "1000" in [label.get_text() for label in axes.get_xticklabels()]
    assert isinstance(axes.figure, Figure)
    mpl.pyplot.close(axes.figure)


def test_figure_has_its_caption_and_says_that_it_is_simulated() -> None:  # spectra F12
    in_force = stated_settings({"tip-bias-voltage": (0.1, "V"), "zctrl-setpoint": (2e-11, "A")})
    scan = Scan(SCAN.region, "Height", "m", VALUES, in_force=in_force, simulated=True)
    axes, surface = scan.plot(), scan.plot("surface")
    for one in (axes, surface):
        assert one.get_title() == "Height\nV = 100 mV, I = 20 pA"
        assert "SIMULATED" in [text.get_text() for text in one.texts]
    assert "SIMULATED" not in [text.get_text() for text in SCAN.plot().texts]
    mpl.pyplot.close("all")


def test_scan_over_another_has_its_colours_so_that_the_bar_holds_for_both() -> None:
    axes = Scan(SCAN.region, "Height", "m", VALUES).plot()
    Scan(SCAN.region, "Height", "m", 1e-3 * VALUES).plot(axes=axes)  # alone it would be drawn in pm
    Scan(SCAN.region, "Height", "m", VALUES).plot(axes=axes, vmin=0.0, vmax=1e-9)
    first, second, third = axes.collections
    assert second.get_clim() == first.get_clim() == pytest.approx((0.11, 10.89))
    assert np.nanmax(np.asarray(second.get_array(), dtype=float)) == pytest.approx(0.011)
    assert third.get_clim() == pytest.approx((0.0, 1.0))
    assert isinstance(axes.figure, Figure)
    mpl.pyplot.close(axes.figure)


def test_scan_over_another_is_drawn_at_its_position_without_a_second_colour_bar() -> None:
    axes = Scan(Region((0.0, 0.0), (5e-6, 5e-6)), "Height", "m", VALUES).plot()
    assert SCAN.plot(axes=axes) is axes
    axes.figure.canvas.draw()
    assert len(axes.child_axes) == 1
    assert axes.get_xlabel() == "x / µm"
    survey, zoom = axes.collections
    assert isinstance(zoom, QuadMesh)
    corners = np.asarray(zoom.get_coordinates()).reshape(-1, 2)
    assert tuple(corners.mean(axis=0)) == pytest.approx(SCAN.region.center_m)
    assert np.ptp(corners[:, 0]) > 3e-7  # it is turned
    assert survey.get_zorder() <= zoom.get_zorder()
    assert isinstance(axes.figure, Figure)
    mpl.pyplot.close(axes.figure)


def test_the_colour_bar_is_as_high_as_the_picture() -> None:
    figure, (wide, _) = mpl.pyplot.subplots(1, 2, figsize=(9, 6), layout="constrained")
    flat = Scan(Region((0.0, 0.0), (3e-6, 1e-6)), "Height", "m", VALUES)
    flat.plot(axes=wide)
    figure.canvas.draw()
    bar, picture = wide.child_axes[0].get_window_extent(), wide.get_window_extent()
    assert (bar.y0, bar.y1) == pytest.approx((picture.y0, picture.y1), abs=1.0)
    mpl.pyplot.close(figure)


def test_a_scan_is_drawn_without_a_colour_bar_and_between_given_values() -> None:
    axes = SCAN.plot(colorbar=False, vmin=-2e-9, vmax=20e-9)
    assert not axes.child_axes
    assert axes.collections[0].get_clim() == pytest.approx((-2.0, 20.0))
    assert isinstance(axes.figure, Figure)
    mpl.pyplot.close(axes.figure)
    with pytest.raises(InvalidValue, match="colours from 2e-09 to 1e-09 m"):
        SCAN.plot(vmin=2e-9, vmax=1e-9)


def test_scan_that_can_not_be_drawn_is_refused() -> None:
    with pytest.raises(InvalidValue, match="'map'"):
        SCAN.plot("map")
    with pytest.raises(InvalidValue, match="no values"):
        Scan(SCAN.region, "Height", "m", np.full((3, 4), np.nan)).plot()


@pytest.mark.program
def test_a_scan_is_the_same_after_a_way_through_sidpy() -> None:
    pytest.importorskip("sidpy", reason="sidpy, a gigabyte, is not installed")
    in_force = stated_settings({"tip-bias-voltage": (0.1, "V")})
    scan = replace(SCAN, roles=("height",), in_force=in_force, simulated=True)
    dataset = scan.to_sidpy()
    assert dataset.shape == (4, 3)
    assert (dataset.data_type.name, dataset.quantity, dataset.units) == ("IMAGE", "Height", "m")
    assert dataset.x.values[[0, -1]] == pytest.approx((850e-9, 1150e-9))
    assert float(dataset[3, 0]) == VALUES[0, 3]
    back = Scan.from_sidpy(dataset)
    assert (back.roles, back.in_force, back.simulated) == (("height",), in_force, True)
    assert np.array_equal(back.values, VALUES)
    assert (back.channel, back.unit, back.filename) == ("Height", "m", "a.sxm")
    assert back.region.center_m == pytest.approx(SCAN.region.center_m)
    assert back.region.angle_rad == 0.1
    assert back.time_ns is not None
    assert abs(back.time_ns - (SCAN.time_ns or 0)) < 1_000_000
