"""The file of an instrument: which limits are proposed from what was read."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from afspm.cli.instrument_file import text_of
from afspm.model import names
from afspm.plugins.asylum import Asylum
from afspm.plugins.nanonis import Nanonis
from afspm.translator.contact import Contact, ParameterReading


def limits(kind: type[Any] = Nanonis, most: float | None = None, **values: float) -> dict[str, Any]:
    rows = kind.parameter_table({})
    answers = {
        name: ParameterReading(rows[name], value, 0.01)
        for name, value in {"tip-bias-voltage": values.get("bias"), "zctrl-setpoint": values.get("setpoint")}.items()
        if value is not None
    }
    reach = {name: rows[name] for name in (names.PROBE_POS_X, names.PROBE_POS_Y) if name in rows}
    found = Contact("127.0.0.1:6501", answers=answers, reach=reach, most_setpoint=most)
    text = text_of(kind.__name__, kind.channels_of({}), found, "2026-03-14")
    read: dict[str, Any] = tomllib.loads(text)["limits"]
    return read


@pytest.mark.parametrize(
    ("setpoint", "most", "bounds"),
    [
        (1e-10, None, ("10 pA", "500 pA")),
        (5e-9, 1e-8, ("500 pA", "10 nA")),
        (-1e-10, None, ("-500 pA", "-10 pA")),
    ],
)
def test_current_setpoint_stays_within_the_preamplifiers_reach(
    setpoint: float, most: float | None, bounds: tuple[str, str]
) -> None:
    found = limits(setpoint=setpoint, most=most)["zctrl-setpoint"]
    assert (found["min"], found["max"]) == bounds


def test_bias_has_a_volt_to_each_side_or_twice_the_present_one() -> None:
    assert limits(bias=0.0)["tip-bias-voltage"]["max"] == "1 V"
    assert limits(bias=-8.0)["tip-bias-voltage"] == {"min": "-16 V", "max": "16 V", "step": "16 V"}


def test_amplitude_is_halved_at_most() -> None:
    found = limits(Asylum, setpoint=0.7)["zctrl-setpoint"]
    assert (found["min"], found["max"]) == ("350 mV", "1.05 V")
