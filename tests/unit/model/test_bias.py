"""`sample-bias` is `tip-bias-voltage` with the sign of a bias of the sample, or nothing at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.client.parameter_text import from_parameter, to_parameter
from afspm.model import Grant, GrantedRange, Parameter, Spectrum
from afspm.model.bias import BiasOf, BiasReference
from afspm.model.caption import BIAS_REFERENCE, SettingInForce, bias_of, caption
from afspm.model.sweep_plan import SweepPlan


@pytest.mark.parametrize(("of", "there"), [("sample", "1.5"), ("tip", "-1.5")])
def test_reference_decides_the_sign_both_ways(of: BiasOf, there: str) -> None:
    bias = BiasReference(of)
    panel = bias.canonical(Parameter("sample-bias", "1.5", "mV"))
    assert panel == Parameter("tip-bias-voltage", there, "mV")
    assert bias.of_sample(panel) == Parameter("sample-bias", "1.5", "mV")
    assert bias.canonical(Parameter("sample-bias")) == Parameter("tip-bias-voltage")


def test_zero_has_no_sign() -> None:
    assert BiasReference("tip").canonical(Parameter("sample-bias", "0.0")).value == "0.0"
    assert BiasReference("tip").canonical(Parameter("sample-bias", "-0.0")).value == "0.0"


@pytest.mark.parametrize("of", ["sample", "tip"])
@pytest.mark.parametrize("text", ["1_0", "one", "nan", "inf", "0x10", "", "1,5"])
def test_value_whose_sign_could_be_lost_is_refused(text: str, of: BiasOf) -> None:
    with pytest.raises(InvalidValue, match="is not a finite number"):
        BiasReference(of).canonical(Parameter("sample-bias", text))


def test_unknown_reference_is_refused_with_the_remedy_and_other_parameters_pass() -> None:
    with pytest.raises(InvalidValue, match='bias_reference = "sample" or "tip"'):
        BiasReference().canonical(Parameter("sample-bias", "1"))
    assert BiasReference("tip").canonical(Parameter("x-sample-bias", "1")) == Parameter("x-sample-bias", "1")


def test_value_without_a_unit_counts_in_v_for_both_names() -> None:
    for name in ("sample-bias", "tip-bias-voltage"):
        assert to_parameter(name, 0.1, None).unit == "V"
        assert from_parameter(Parameter(name, "100", "mV"), None) == pytest.approx(0.1)


def test_sweep_names_one_of_both() -> None:
    with pytest.raises(InvalidValue, match="are one setting"):
        SweepPlan.of({"sample-bias": ["1 V"], "tip-bias-voltage": ["1 V", "2 V"]})
    (axis,) = SweepPlan.of({"sample-bias": ["100 mV", "1 V"]}).axes
    assert (axis.values, axis.unit) == ((0.1, 1.0), "V")


@pytest.mark.parametrize(("of", "shown"), [("sample", "V(sample)"), ("tip", "V(tip)"), ("", "V")])
def test_caption_names_the_electrode_where_it_is_known(of: str, shown: str) -> None:
    bias = SettingInForce("tip-bias-voltage", "V", 0.1, 0.1)
    settings = (bias, SettingInForce(BIAS_REFERENCE, "", of, of)) if of else (bias,)
    assert bias_of(settings) == of
    assert caption(settings) == f"{shown} = 100 mV"


def test_axis_of_a_curve_names_the_electrode_where_it_is_known() -> None:
    curve = Spectrum(None, "IV", ("Bias", "Current"), ("V", "A"), np.zeros((2, 2)))
    known = replace(curve, in_force=(SettingInForce(BIAS_REFERENCE, "", "sample", None),))
    assert (curve.label("Bias"), known.label("Bias"), known.label("Current")) == (
        "Bias",
        "Bias (sample bias)",
        "Current",
    )


def test_grant_for_the_alias_is_refused() -> None:
    with pytest.raises(InvalidValue, match="a grant for sample-bias"):
        Grant("agent:one", ranges=(GrantedRange("sample-bias", -1.0, 1.0),), lasts_s=1.0)
