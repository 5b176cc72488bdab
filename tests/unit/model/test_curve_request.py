"""What a request for a curve may say, and the parameters that it sets."""

from __future__ import annotations

from typing import Any

import pytest

from afspm.basics.errors import AfspmError
from afspm.model import Parameter
from afspm.model.curve_request import curve_parameters


def test_request_is_in_parameters_with_units() -> None:
    asked = {
        "sweep": ("-500 mV", "0.5 V"), "points": 201, "point_time": "2 ms", "z_offset": "-50 pm",
        "lock_in": {"amplitude": "10 mV", "frequency": 973},
    }  # fmt: skip
    assert curve_parameters(asked) == (
        Parameter("x-spec-from", "-0.5", "V"),
        Parameter("x-spec-to", "0.5", "V"),
        Parameter("x-spec-points", "201"),
        Parameter("x-spec-point-time", "0.002", "s"),
        Parameter("x-spec-z-offset", "-5e-11", "m"),
        Parameter("x-lock-in-amplitude", "0.01", "V"),
        Parameter("x-lock-in-frequency", "973.0", "Hz"),
    )
    assert curve_parameters({}) == ()


def test_sweep_of_a_height_has_ends_of_its_own() -> None:
    ends = Parameter("x-spec-z-from", "2e-08", "m"), Parameter("x-spec-z-to", "-1e-09", "m")
    assert curve_parameters({"sweep": ["20 nm", "-1 nm"]}) == ends


@pytest.mark.parametrize(
    ("asked", "where"),
    [
        ({"sweep": (-0.5, 0.5)}, "curve.sweep"),  # of what?
        ({"sweep": "1 V"}, "curve.sweep"),
        ({"sweep": ("1 V", "1 V")}, "curve.sweep"),
        ({"sweep": ("0 V", "1 nm")}, "curve.sweep"),
        ({"sweep": ("0 V", "nan V")}, "curve.sweep"),
        ({"sweep": ("1 V",)}, "curve.sweep"),
        ({"points": 1}, "curve.points"),
        ({"points": True}, "curve.points"),
        ({"points": "many"}, "curve.points"),
        ({"pionts": 3}, "curve"),
        ({"point_time": "2 nm"}, ""),
        ({"point_time": float("inf")}, "curve.point_time"),
        ({"lock_in": "10 mV"}, "curve.lock_in"),
        ({"lock_in": {"amplitdue": "10 mV"}}, "curve.lock_in"),
        ({"lock_in": {"amplitude": [1]}}, "curve.lock_in.amplitude"),
    ],
)
def test_wrong_request_is_refused_with_its_place(asked: dict[str, Any], where: str) -> None:
    with pytest.raises(AfspmError) as caught:
        curve_parameters(asked)
    assert where in str(caught.value.where)


@pytest.mark.parametrize(
    ("asked", "kind"),
    [
        ({"sweep": ("10 nm", "0 nm")}, "IV"),
        ({"sweep": ("-1 V", "1 V")}, "force"),
        ({"z_offset": "-50 pm"}, "z"),
    ],
)
def test_request_that_does_not_fit_the_kind_is_refused(asked: dict[str, Any], kind: str) -> None:
    assert curve_parameters(asked)
    assert curve_parameters(asked, "GVP")
    with pytest.raises(AfspmError, match=f"a curve {kind} sweeps the"):
        curve_parameters(asked, kind)
