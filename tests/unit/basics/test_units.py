"""Units are exact where they can be, and refused where they make no sense."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import UnitError
from afspm.basics.units import DIMENSIONS, convert, parse_quantity, same_kind, si, si_unit


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("1500 nm", "m", 1.5e-6),
        ("2.5um", "m", 2.5e-6),
        ("2.5 µm", "m", 2.5e-6),
        ("3 Å", "m", 3e-10),
        ("15 min", "s", 900.0),
        ("-2 mV", "V", -0.002),
        ("10 nm/s", "m/s", 1e-8),
        ("1 um/ms", "m/s", 1e-3),
        ("7", "s", 7.0),
        (7, "s", 7.0),
        (7e-6, "m", 7e-6),
        ("50 %", "", 0.5),
        ("90 deg", "rad", math.pi / 2),
        ("325 kHz", "Hz", 325e3),
    ],
)
def test_quantities_in_si(text: str, unit: str, expected: float) -> None:
    assert si(text, unit) == expected


def test_other_units_are_known_as_well() -> None:
    assert si("1 inch", "m") == pytest.approx(0.0254)
    assert si("20 mK", "K") == si("20 millikelvin", "K") == 0.02
    assert si("1 eV/nm", "N") == pytest.approx(1.602e-10, rel=1e-3)


@pytest.mark.parametrize("text", ["5 flurb", "nm", "", "5 V", "five nm", "5 nm nm", "1e400000 x", True])
def test_quantity_that_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(UnitError):
        si(text, "m")


@pytest.mark.parametrize(("text", "unit"), [("20 degC", "K"), ("0 °C", "K"), ("68 degF", "K"), ("3 dB", "")])
def test_unit_with_an_offset_is_refused(text: str, unit: str) -> None:
    with pytest.raises(UnitError, match="does not count from zero"):
        si(text, unit)


@pytest.mark.parametrize("unit", [unit for unit, one in DIMENSIONS.items() if math.isfinite(one.largest_plain)])
def test_a_plain_number_above_the_largest_is_refused_and_one_with_a_unit_is_not(unit: str) -> None:
    dimension = DIMENSIONS[unit]
    assert si(-dimension.largest_plain, unit) == -dimension.largest_plain
    for plain in (1.1 * dimension.largest_plain, f"{-1.1 * dimension.largest_plain}"):
        with pytest.raises(UnitError, match=f"without a unit this means .* {unit} ") as refused:
            si(plain, unit)
        assert refused.value.hint == dimension.hint
    assert si(f"{2 * dimension.largest_plain} {unit}", unit) == 2 * dimension.largest_plain
    assert abs(si(dimension.example, unit)) <= dimension.largest_plain


def test_arrays_are_converted_as_a_whole() -> None:
    np.testing.assert_array_equal(convert(np.array([1.0, 2.0]), "um", "nm"), [1000.0, 2000.0])


@given(st.floats(-1e6, 1e6), st.sampled_from(["nm", "um", "pm", "mm", "Å"]))
def test_conversion_there_and_back_is_exact(value: float, unit: str) -> None:
    assert convert(convert(value, unit, "m"), "m", unit) == pytest.approx(value, rel=1e-15)


def test_units_of_one_kind_are_recognised() -> None:
    assert same_kind("nm", "inch")
    assert not same_kind("nm", "V")
    assert not same_kind("nm", "flurb")
    assert parse_quantity("-1e-3 nA") == (-1e-3, "nA")


@pytest.mark.parametrize("text", ["1,5 um", "10,000"])
def test_decimal_comma_is_refused(text: str) -> None:
    with pytest.raises(UnitError) as refused:
        parse_quantity(text)
    assert "decimal point" in refused.value.what


def test_common_units_need_no_heavy_library() -> None:
    code = "import sys, afspm.basics.units as u; u.si('2 um/s', 'm/s'); sys.exit('pint' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("unit", "wanted"), [("nm", "m"), ("um/s", "m/s"), ("deg", "rad"), ("mV", "V"), ("", ""), ("px", "px")]
)
def test_the_si_unit_of_a_unit_is_the_one_of_its_kind(unit: str, wanted: str) -> None:
    assert si_unit(unit) == wanted
