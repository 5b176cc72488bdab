"""The caption of a figure: settings as they were in force, with units."""

from __future__ import annotations

from afspm.model import MeasurementConditions, Parameter
from afspm.model.caption import SettingInForce, are_alike, caption, captioned, picture_settings, stated_settings

BEGIN = (
    Parameter("scan-speed", "5", "nm/s"),
    Parameter("x-lock-in-amplitude", "0.01", "V"),
    Parameter("zctrl-setpoint", "2e-11", "A"),
    Parameter("tip-bias-voltage", "0.1", "V"),
    Parameter("x-feedback-on", "true"),
)


def conditions(*end: Parameter, begin: tuple[Parameter, ...] = BEGIN) -> MeasurementConditions:
    return MeasurementConditions(1, "", begin_in_force=begin, end_in_force=end)


def test_caption_names_bias_setpoint_and_speed() -> None:  # spectra F10
    assert caption(conditions(*BEGIN).in_force) == "V = 100 mV, I = 20 pA, 5 nm/s, lock-in amplitude = 10 mV"
    assert caption(()) == ""


def test_setpoint_is_no_part_of_a_caption_at_constant_height() -> None:
    off = (*BEGIN[2:4], Parameter("x-feedback-on", "false"))
    assert caption(conditions(begin=off).in_force) == "V = 100 mV, feedback off"


def test_end_has_a_column_where_it_differs() -> None:
    (bias, speed) = conditions(Parameter("tip-bias-voltage", "50", "mV"), begin=BEGIN[::3]).in_force
    assert bias.columns == {"tip-bias-voltage [V]": 0.1, "tip-bias-voltage.end [V]": 0.05}
    assert (bias.text, bias.constant) == ("100 mV → 50 mV", None)
    assert speed.columns == {"scan-speed [m/s]": 5e-9}, "its end is not known"
    assert speed.constant == 5e-9


def test_begin_that_was_not_seen_has_no_value() -> None:
    (bias,) = conditions(BEGIN[3], begin=()).in_force
    assert bias.columns == {"tip-bias-voltage [V]": None, "tip-bias-voltage.end [V]": 0.1}


def test_setpoint_of_another_mode_is_another_column() -> None:
    found = conditions(Parameter("zctrl-setpoint", "0.7", "V"), begin=BEGIN[2:3]).in_force
    assert [one.columns for one in found] == [
        {"zctrl-setpoint [A]": 2e-11},
        {"zctrl-setpoint [V]": None, "zctrl-setpoint.end [V]": 0.7},
    ]


def test_settings_of_an_earlier_version_are_those_of_the_run() -> None:
    earlier = MeasurementConditions(1, "", begin_values=(BEGIN[3], Parameter("zctrl-igain", "5")))
    bias, gain = SettingInForce("tip-bias-voltage", "V", 0.1, None), SettingInForce("zctrl-igain", "", 5.0, None)
    assert earlier.in_force == (bias, gain)
    assert earlier.caption() == "V = 100 mV", "a gain is for comparisons, and no part of a caption"


# settings: one place alternately at two speeds, the tip unchanged
def test_pictures_with_other_settings_are_not_compared() -> None:
    def of(**values: float) -> dict[str, float]:
        given = ((name.replace("_", "-"), value) for name, value in values.items())
        return picture_settings(SettingInForce(name, "", value, value) for name, value in given)

    slow = of(scan_speed=2e-6, tip_bias_voltage=0.5)
    assert are_alike(slow, of(scan_speed=2.001e-6, tip_bias_voltage=0.5))
    assert not are_alike(slow, of(scan_speed=8e-6, tip_bias_voltage=0.5))
    assert not are_alike(slow, of(scan_speed=2e-6, tip_bias_voltage=-0.5))
    assert are_alike(slow, of(scan_speed=2e-6)), "what is not known counts as alike"
    assert not are_alike(slow, {**slow, "zctrl-igain": 5.0}), "a gain is known where the run has set it"
    assert picture_settings([SettingInForce("scan-speed", "m/s", 1e-6, 2e-6)]) == {}, "changed during the scan"


def test_few_parameters_are_read_for_a_caption() -> None:
    table = ["move-speed", "scan-speed", "tip-bias-voltage", "x-spec-kind", "x-spec-from", "x-lock-in-amplitude"]
    assert captioned(table, of_scan=True) == ["scan-speed", "tip-bias-voltage"]
    assert captioned(table, of_scan=False) == ["tip-bias-voltage"]


def test_calibration_that_a_file_does_not_state_is_left_out() -> None:
    found = stated_settings({"x-spring-constant": (0.4, "N/m"), "x-sensitivity": (None, "m/V")})
    assert found == (SettingInForce("x-spring-constant", "N/m", 0.4, 0.4),)
