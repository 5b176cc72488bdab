"""Scans and spectra in the hands of a user."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import ProblemNames, Region, Scan, ScanParameters, ScanSet, Spectrum

REGION = Region.from_top_left((0.0, 1e-6), (3e-6, 2e-6))
SCAN = Scan(REGION, "Height", "m", np.arange(12.0).reshape(3, 4), 1_767_225_600_000_000_000, "a.nc")
SPECTRUM = Spectrum((0.0, 0.0), "IV", ("Bias", "Current"), ("V", "A"), np.array([[-1.0, 2.0], [1.0, 4.0]]), 0)


def test_xarray_has_coordinates_in_metres() -> None:
    array = SCAN.to_xarray()
    np.testing.assert_allclose(array.x, [0, 1e-6, 2e-6, 3e-6])
    np.testing.assert_allclose(array.y, [1e-6, 2e-6, 3e-6])
    assert (array.name, array.attrs["units"]) == ("Height", "m")
    assert float(array.sel(x=1e-6, y=3e-6, method="nearest")) == SCAN.values[2, 1]


@pytest.mark.parametrize("convert", [SCAN.to_xarray, ScanSet([SCAN]).to_xarray, SPECTRUM.to_xarray])
def test_conversion_without_xarray_is_refused_with_the_extra(
    convert: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ConfigError, match=r'pip install "afspm\[xarray\]"'):
        convert()


def test_a_scan_without_values_has_the_shape_that_it_was_taken_with() -> None:
    scan = Scan(REGION, "Height", "m", np.empty((0, 0)), pixels=(3, 4))
    assert scan.shape == (3, 4)
    assert scan.parameters == SCAN.parameters
    assert scan.lines_missing == 3
    assert "4 × 3 px" in scan._repr_html_()
    assert "4 x 3 px" in repr(ScanSet([scan]))
    array = scan.to_xarray()
    np.testing.assert_allclose(array.y, SCAN.to_xarray().y)
    assert np.isnan(array).all()
    assert scan.undistorted((0.0, 0.0), 1.0).shape == (3, 4)


def test_scan_of_unknown_shape_has_parameters() -> None:
    scan = Scan(REGION, "Height", "m", np.empty((0, 0)))
    assert scan.shape == (0, 0)
    assert scan.parameters == ScanParameters(REGION, unit="m")
    assert scan.lines_missing == 0


@pytest.mark.parametrize("pixels", [(4, 3), (0, 0), (3,)])
def test_invalid_or_contradictory_pixels_are_refused(pixels: tuple[int, int]) -> None:
    with pytest.raises(InvalidValue):
        Scan(REGION, "Height", "m", SCAN.values, pixels=pixels)


def test_a_set_of_scans_is_a_mapping_by_channel() -> None:
    scans = ScanSet([SCAN, Scan(REGION, "Phase", "deg", SCAN.values)], ["tip repair"])
    assert list(scans) == ["Height", "Phase"]
    assert scans["Phase"].unit == "deg"
    assert scans.first is SCAN
    assert set(scans.to_xarray()) == {"Height", "Phase"}
    with pytest.raises(KeyError, match="Height, Phase"):
        scans["Heigth"]


def test_a_scan_shows_itself_in_a_notebook() -> None:
    shown = Scan(REGION, "<b>", "m", SCAN.values)._repr_html_()
    assert "&lt;b&gt;" in shown
    assert "data:image/png;base64," in shown
    assert "no values" in Scan(REGION, "Height", "m", np.empty((0, 0)))._repr_html_()


def test_channels_are_shown_in_a_row_each_with_its_colour_bar() -> None:
    shown = ScanSet([SCAN, Scan(REGION, "Phase", "deg", SCAN.values)])._repr_html_()
    assert shown.count("<figure") == 2
    assert shown.count("linear-gradient") == 2
    assert "flex-wrap" in shown
    assert " deg</span>" in shown


def test_a_spectrum_gives_its_variables_by_name() -> None:
    np.testing.assert_array_equal(SPECTRUM["Current"], [2.0, 4.0])
    assert SPECTRUM.to_xarray().Current.sel(Bias=1.0) == 4.0
    assert "polyline" in SPECTRUM._repr_html_()
    with pytest.raises(InvalidValue, match="fit together"):
        Spectrum(None, "IV", ("Bias",), ("V", "A"), np.zeros((2, 2)))


def test_problems_are_known_by_many_spellings() -> None:
    names = ProblemNames({"sample-worn": 17})
    for spelling in ("tip-shape-changed", "EP_TIP_SHAPE_CHANGED", "Tip shape changed", 1):
        assert names.number(spelling) == 1
    assert (names.number("sample_worn"), names.name(17)) == (17, "sample-worn")
    with pytest.raises(InvalidValue, match="did you mean 'sample-worn'"):
        names.number("sample-wron")


@pytest.mark.parametrize("named", [{"a": 3}, {"a": 256}, {"thermal-drift": 9}, {"a": 9, "b": 9}])
def test_problem_needs_a_unique_name_and_number(named: dict[str, int]) -> None:
    with pytest.raises(InvalidValue):
        ProblemNames(named)
