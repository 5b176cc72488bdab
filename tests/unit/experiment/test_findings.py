"""Hints with the name that was meant."""

from __future__ import annotations

import pytest

from afspm.experiment.findings import nearest
from afspm.model.parameter_names import BASE_PARAMETERS

from .conftest import Write, only_error

SIMULATED = """
[microscope]
component = true
class = "Simulator"
[scheduler]
component = true
class = "Scheduler"
"""


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("bias", "tip-bias-voltage"),
        ("Bias", "tip-bias-voltage"),
        ("setpoint", "zctrl-setpoint"),
        ("scna-speed", "scan-speed"),
    ],
)
def test_hint_has_the_only_parameter_with_the_word(name: str, meant: str) -> None:
    # users N8: of "bias" the hint was a list that ended before tip-bias-voltage
    assert nearest(name, BASE_PARAMETERS) == f"did you mean {meant!r}?"


def test_long_list_has_the_names_most_alike() -> None:
    # users N8: the alphabet cut it
    hint = nearest("size", [*(f"a{k}" for k in range(20)), "scan-size-x", "scan-size-y"])
    assert "scan-size-x, scan-size-y" in hint
    assert hint.endswith(", …")


def test_word_that_rhymes_is_no_misspelling() -> None:
    # users N8: "surface" of the simulator, on Nanonis: "did you mean 'trace'?"
    assert nearest("surface", ["trace", "address"]) == "known here: address, trace"
    assert nearest("rtace", ["trace", "address"]) == "did you mean 'trace'?"


def test_sweep_of_bias_names_the_parameter_of_the_microscope(write: Write) -> None:
    # users N8
    sweep = '[sweep]\ncomponent = true\nclass = "Sweep"\nparameters = { bias = ["1 V", "2 V"] }\n'
    assert only_error(write(sweep, frame=SIMULATED)).hint == "did you mean 'tip-bias-voltage'?"
