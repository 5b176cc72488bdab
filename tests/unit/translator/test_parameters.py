"""Values through the table: units both ways, and refusals."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError, Refused
from afspm.driver import Driver, ParameterSpec, Value
from afspm.model import names
from afspm.plugins.asylum import Asylum
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.nanonis import Nanonis
from afspm.simulation.simulator import FAULT_KINDS, Simulator
from afspm.translator.parameters import ParameterTable

TABLE = ParameterTable({}).extended(
    {
        "scan-size-x": {"vendor": "W", "unit": "nm", "range": ["1 nm", "10 um"]},
        "scan-angle": {"unit": "deg", "sign": -1, "range": [-180, 180]},
        "scan-resolution-x": {"type": "int", "range": [2, 64]},
        "x-on": {"type": "bool"},
    },
    where="the test",
)


@given(st.floats(1.0, 10_000.0), st.sampled_from([("nm", 1.0), ("um", 1e-3), ("m", 1e-9), ("Å", 10.0)]))
def test_value_is_read_back_as_it_was_set(number: float, unit: tuple[str, float]) -> None:
    spec = TABLE["scan-size-x"]
    given_number = min(max(number * unit[1], unit[1] * 1.0000001), unit[1] * 9999.999)
    value = spec.parse(repr(given_number), unit[0])
    back = spec.from_vendor(spec.to_vendor(value))
    assert spec.same(back, value)
    assert float(spec.for_peer(back, unit[0])[0]) == pytest.approx(given_number, rel=1e-14)


@given(st.text(max_size=20), st.one_of(st.none(), st.text(max_size=10)))
def test_any_text_is_a_value_within_the_range_or_refused_with_a_reason(text: str, unit: str | None) -> None:
    for name in TABLE:
        spec = TABLE[name]
        value, reason = _parsed(spec, text, unit)
        if value is None:
            assert reason.startswith(name)
        else:
            assert isinstance(value, bool) or spec.range[0] <= float(value) <= spec.range[1]


def _parsed(spec: ParameterSpec, text: str, unit: str | None) -> tuple[Value | None, str]:
    try:
        return spec.parse(text, unit), ""
    except Refused as refused:
        return None, refused.reason


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308])
def test_malformed_numbers_are_refused(value: float) -> None:
    for name in ("scan-size-x", "scan-angle", "scan-resolution-x"):
        with pytest.raises(Refused):
            TABLE[name].checked(value)


def test_angles_default_to_degrees_and_may_have_the_opposite_sign() -> None:
    spec = TABLE["scan-angle"]
    assert spec.parse("90") == pytest.approx(math.pi / 2)
    assert spec.parse("1.5", "rad") == 1.5
    assert spec.to_vendor(math.pi / 2) == pytest.approx(-90)
    assert spec.for_peer(math.pi / 2) == ("90", "deg")
    assert str(TABLE["scan-angle"].from_vendor(0.0)) == "0.0"


def test_an_experiment_file_changes_single_attributes_of_a_row() -> None:
    narrow = TABLE.extended({"scan-size-x": {"range": ["1 nm", "2 um"]}}, where="the experiment file")
    assert narrow["scan-size-x"].vendor == "W"
    with pytest.raises(Refused, match="the experiment file"):
        narrow["scan-size-x"].parse("3", "um")


@pytest.mark.parametrize("microscope", [Asylum, Gxsm, Nanonis])
def test_row_can_not_change_a_parameter_translated_by_code(microscope: type[Driver]) -> None:
    narrow = microscope.parameter_table({"scan-angle": {"range": ["-90 deg", "90 deg"]}})
    assert narrow["scan-angle"].range[1] == pytest.approx(math.pi / 2)
    for row in ({"sign": -1}, {"vendor": "Rotation"}):
        with pytest.raises(
            ConfigError, match=f"the experiment file, parameters.scan-angle: {next(iter(row))} has no effect"
        ):
            microscope.parameter_table({"scan-angle": row})
    without_vendor = {name for name, row in microscope.parameter_table({}).items() if row.vendor == name}
    assert without_vendor <= {*microscope.translated, *names.OF_HELD_Z, names.Z_IS_HELD}


def test_malformed_table_is_reported_with_its_file(tmp_path: Path) -> None:
    (tmp_path / "parameters.toml").write_text("[parameters\n")
    with pytest.raises(ConfigError, match=r"parameters\.toml"):
        ParameterTable.from_toml(tmp_path / "parameters.toml")


def test_the_simulator_has_every_base_parameter_and_the_right_unit_for_its_mode() -> None:
    assert set(names.BASE_PARAMETERS) <= set(Simulator().table)
    assert Simulator(feedback={"mode": "amplitude"}).table[names.ZCTRL_SETPOINT].unit == "V"
    assert Simulator(surface="lattice").table[names.ZCTRL_SETPOINT].unit == "A"


def test_setpoint_of_a_current_is_in_si_for_any_unit_of_the_controller() -> None:
    row = ParameterTable.from_toml(Gxsm.parameters_file)[names.ZCTRL_SETPOINT]
    assert (row.unit, row.si_unit) == ("nA", "A")
    assert row.parse("500", "pA") == pytest.approx(5e-10)
    assert row.to_vendor(5e-10) == pytest.approx(0.5)


def test_faults_of_the_simulator_equal_the_ones_that_can_be_demanded() -> None:
    assert Simulator(fault_action=True).table["x-fault-kind"].choices == tuple(FAULT_KINDS)


@pytest.mark.parametrize(
    "settings",
    [
        {"surfaces": "steps"},
        {"surface": "cheese"},
        {"initial": {"scan-speed": "1 V"}},
        {"initial": {"scan-sped": 1}},
        {"faults": [{"kind": "explode"}]},
        {"faults": [{"kind": "crash", "when": 3}]},
        {"panel": [{"at_s": 1.0, "set": {"scan-sped": 1}}]},
        {"panel": [{"at_s": 1.0, "action": "x-dance"}]},
    ],
)
def test_impossible_settings_of_the_simulator_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises((ConfigError, TypeError)):
        Simulator(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("driver", entry_points.names(entry_points.DRIVERS))
def test_every_driver_compares_within_the_resolution_of_a_row(driver: str) -> None:
    made = object.__new__(entry_points.load(entry_points.DRIVERS, driver))
    made.table = type(made).parameter_table({"x-own": {"vendor": "ZCtrl.TipLift", "unit": "m", "resolution": "20 pm"}})
    assert made.same("x-own", 7.12e-11, 6.94e-11, {})  # spectra F4
    assert not made.same("x-own", 7.12e-11, 1.12e-10, {})
