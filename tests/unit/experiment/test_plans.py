"""`afspm check` checks each plan as a whole, so that impossible measurements are found before the night."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.experiment.planned_measurements import nearest_region
from afspm.model import Region

from .conftest import FRAME, Write, errors, line_of, only_error

SIMULATED = FRAME[: FRAME.index("[microscope]")] + '[microscope]\ncomponent = true\nclass = "Simulator"\n'
SERIES = '[series]\ncomponent = true\nclass = "ScanSeries"\n'
SIZE = 'size = ["1 um", "1 um"]\n'
SURVEY = '[survey]\ncomponent = true\nclass = "Survey"\nsize = "4 um"\n'
GRID = '[grid]\ncomponent = true\nclass = "RegionGrid"\ncounts = [3, 2]\n' + SIZE
LIST = '[list]\ncomponent = true\nclass = "ScanList"\nregions = [{ center = [0, 0], size = ["1 um", "1 um"] }]\n'
REGION = '[limits]\nregion = { x = ["-2 um", "2 um"], y = ["-2 um", "2 um"] }\n'


@pytest.mark.parametrize(
    ("plan", "setting", "what", "hint"),
    [
        (SERIES + SIZE, 'every = "-10 min"', "[series] every = '-10 min': '-10 min' is below 0 s", "a time"),
        (GRID, 'every = "-1 s"', "[grid] every = '-1 s': '-1 s' is below 0 s", "a time"),
        (LIST, 'every = "-1 s"', "[list] every = '-1 s': '-1 s' is below 0 s", "a time"),
        (SERIES + SIZE, "every = 10", "[series] every = 10: 10 has no unit", 'a time, for example "15 min"'),
        (SERIES + SIZE + 'every = "1 min"\n', "duration = 8", "duration = 8: 8 has no unit", "a time, for example"),
        (SERIES + SIZE, 'every = "10"', "every = '10': 10 has no unit", "a time, for example"),
        (SERIES + SIZE, 'end_when_done = "yes"', "end_when_done is true or false, not 'yes'", ""),
        (SERIES + SIZE, "keep_control = 1", "keep_control is true or false, not 1", ""),
        (SERIES + SIZE, 'parameters = { scan-speed = "2 um" }', "um can't be converted to m/s", "give it in m/s"),
        (GRID, 'spacing = ["0 nm", "1 um"]', "[grid] 3 points of a grid lie 0 nm apart", "spacing is above zero"),
        (SURVEY + 'zoom = "1 um"\n', 'min_height = "-1 nm"', "[survey] min_height: -1 nm is below zero", ""),
        (SERIES + SIZE, "pixels = [0, 128]", "[series] pixels: [0, 128] is no number of pixels", "columns and rows"),
        (LIST, "pixels = [128, -1]", "[list] pixels: [128, -1] is no number of pixels", "columns and rows"),
        (SURVEY + 'zoom = "1 um"\n', "zoom_pixels = [128, 0]", "[survey] zoom_pixels: [128, 0]", "columns and rows"),
        (SURVEY, 'zoom = "5 um"', "[survey] zoom: a zoom of 5 x 5 µm is larger than the survey", "at most 4 x 4 µm"),
        (
            SURVEY + 'zoom = "1 um"\n',
            "zoom_parameters = { scan-speed = 8 }",
            "[survey] zoom_parameters.scan-speed: without a unit this means 8 m/s",
            "a speed",
        ),
    ],
)
def test_impossible_plan_is_an_error_at_its_line(write: Write, plan: str, setting: str, what: str, hint: str) -> None:
    experiment = write(plan + setting + "\n", frame=SIMULATED)
    error = only_error(experiment)
    assert what in error.what
    assert hint in error.hint
    assert error.place.line == line_of(experiment, setting.split(" ")[0])


@pytest.mark.parametrize("setting", ["every = 0", 'every = "0 s"', 'every = "15 min"', "end_when_done = false"])
def test_possible_plan_is_no_error(write: Write, setting: str) -> None:
    assert errors(write(f"{SERIES}{SIZE}{setting}\n", frame=SIMULATED)) == []


def test_a_switch_of_a_section_is_true_or_false(write: Write) -> None:
    error = only_error(write('[record]\non = "yes"\n'))
    assert error.what == "[record] on is true or false, not 'yes'"


@pytest.mark.parametrize(
    ("plan", "setting"),
    [
        (SERIES + SIZE, 'parameters = { scan-speed = "20 um/s" }'),
        (SURVEY + 'zoom = "1 um"\n', 'zoom_parameters = { scan-speed = "20 um/s" }'),
        ('[sweep]\ncomponent = true\nclass = "Sweep"\n', 'parameters = { scan-speed = ["2 um/s", "20 um/s"] }'),
    ],
)
def test_parameters_of_a_plan_are_checked_against_the_limits(write: Write, plan: str, setting: str) -> None:
    experiment = write(plan + setting + '\n[limits.scan-speed]\nmax = "10 um/s"\n', frame=SIMULATED)
    error = only_error(experiment)
    assert "plans what its limits refuse: scan-speed" in error.what
    assert "above the highest allowed" in error.what
    assert error.place.line == line_of(experiment, setting.split(" ")[0])


@pytest.mark.parametrize(
    ("plan", "what", "line"),
    [
        (SERIES + SIZE + 'parameters = { scan-speed = "0 um/s" }\n', "scan-speed: 0 µm/s is outside", "parameters"),
        (SERIES + 'size = ["200 um", "1 um"]\n', "scan-size-x: 200000 nm is outside", "[series]"),
        (SERIES + SIZE + "pixels = [8000, 64]\n", "scan-resolution-x: 8000 px is outside", "[series]"),
    ],
)
def test_plan_is_checked_against_the_microscope(write: Write, plan: str, what: str, line: str) -> None:
    experiment = write(plan, frame=SIMULATED)
    found = errors(experiment)
    assert any("plans what its microscope refuses" in error.what and what in error.what for error in found)
    assert {error.place.line for error in found} == {line_of(experiment, line)}
    assert errors(write(plan)) == [], "of a command nothing is known"


NANONIS = SIMULATED.replace("Simulator", "Nanonis")
REACH = "".join(f'[microscope.parameters.probe-pos-{axis}]\nrange = ["-1 um", "1 um"]\n' for axis in "xy")
ANGLE = 'angle = "45 deg"\n'


@pytest.mark.parametrize(
    "plan",
    [
        SERIES + SIZE + "pixels = [24, 24]\n",
        LIST + "pixels = [24, 24]\n",
        GRID + "pixels = [24, 24]\n",
        SURVEY + 'zoom = "1 um"\nzoom_pixels = [24, 24]\n',
    ],
)
def test_pixels_that_are_no_multiple_of_the_makers_are_an_error(write: Write, plan: str) -> None:
    # paper F4: refused at the run only
    assert "scan-resolution-x: 24 is no multiple of 16: set 16 or 32" in only_error(write(plan, frame=NANONIS)).what
    assert not errors(write(plan, frame=SIMULATED))


@pytest.mark.parametrize(
    ("plan", "angle", "line"),
    [
        (SERIES + 'size = ["1.5 um", "1.5 um"]\n', ANGLE, "[series]"),
        (GRID + 'spacing = ["500 nm", "900 nm"]\n', ANGLE, "[grid]"),
        (LIST.replace("[0, 0]", '["600 nm", "0 nm"]'), "", "regions"),
        (SURVEY.replace("4 um", "1.9 um") + 'zoom = "1 um"\n', ANGLE, "[survey]"),
    ],
)
def test_frame_that_sticks_out_of_the_scanner_is_one_error(write: Write, plan: str, angle: str, line: str) -> None:
    experiment = write(plan + angle + REACH, frame=NANONIS)
    error = only_error(experiment)
    assert "plans what its microscope refuses: scan frame: its corners are at" in error.what
    assert "beyond the scanner's -1 to 1 µm (set in the experiment file" in error.what
    assert error.place.line == line_of(experiment, line)


@pytest.mark.parametrize("setting", ['poll_period_s = "0 s"', 'poll_period_s = "-1 s"', 'approach_s = "-1 s"'])
def test_a_duration_of_the_microscope_is_not_below_zero(write: Write, setting: str) -> None:
    experiment = write("", frame=SIMULATED + setting + "\n")
    error = only_error(experiment)
    assert error.place.line == line_of(experiment, setting.split(" ")[0])


@pytest.mark.parametrize("maker", ["Asylum", "Gxsm", "Nanonis", "Nanosurf", "Park"])
def test_polling_period_of_zero_is_refused(write: Write, maker: str) -> None:
    microscope = SIMULATED.replace("Simulator", maker)
    assert maker in microscope
    experiment = write("", frame=microscope + 'poll_period_s = "0 s"\n')
    assert any(error.place.line == line_of(experiment, "poll_period_s") for error in errors(experiment))


def test_a_tip_is_treated_within_the_limits(write: Write) -> None:
    corrector = '[repair]\ncomponent = true\nclass = "TipCorrector"\nworkshop_center = ["3 um", "0 um"]\n'
    error = only_error(write(corrector + REGION, frame=SIMULATED))
    assert "[repair] plans what its limits refuse: the probe position" in error.what
    assert error.hint == "it fits if moved by (-1 µm, 0 nm)"


def test_initial_values_are_checked_against_the_limits(write: Write) -> None:
    initial = 'initial = { tip-bias-voltage = "5 V", scan-angle = 0.5 }\n'
    limit = '[limits.tip-bias-voltage]\nmax = "3 V"\nonly = []\n'
    experiment = write(limit, frame=SIMULATED + initial)
    error = only_error(experiment)
    assert "[microscope] plans what its limits refuse: tip-bias-voltage = 5 V is above" in error.what
    assert error.place.line == line_of(experiment, "initial")
    assert errors(write(limit.replace("3 V", "6 V"), frame=SIMULATED + initial)) == []


def test_period_shorter_than_its_scan_is_a_warning(write: Write) -> None:
    def said(more: str, initial: str = "") -> list[str]:
        return [finding.what for finding in write(SERIES + SIZE + more, frame=SIMULATED + initial).check()]

    assert said('pixels = [64, 600]\nevery = "10 min"\n') == []
    slow = said('pixels = [64, 601]\nevery = "10 min"\n')
    assert slow == ["[series] the scan takes about 10 min at 2 µm/s, longer than its period of 10 min"]
    assert said('every = "4 min"\n', 'initial = { scan-speed = "1 um/s" }\n')
    assert said('every = "1 min"\nparameters = { scan-speed = "10 um/s" }\n') == []
    assert said("") == []


def test_a_drift_that_is_a_slip_of_the_unit_is_refused(write: Write) -> None:
    drift = "drift = { velocity_m_per_s = [60e-6, 0.0, 0.0] }\n"
    error = only_error(write("", frame=SIMULATED + drift))
    assert "[microscope] drift.velocity_m_per_s" in error.what
    assert "faster than" in error.what
    assert "1 nm/s is 1e-9" in error.hint
    assert errors(write("", frame=SIMULATED + drift.replace("e-6", "e-9"))) == []


CURE = re.compile(r'the nearest that fits: center = \["(.*)", "(.*)"\], size = \["(.*)", "(.*)"\]')


@pytest.mark.parametrize(
    ("place", "cure"),
    [
        ('center = ["3 um", "0 um"]\n', ("1.5 µm", "0 nm", "1 µm", "1 µm")),
        ('center = ["0 um", "-1.6 um"]\nangle = "90 deg"\n', ("0 nm", "-1.5 µm", "1 µm", "1 µm")),
    ],
)
def test_the_cure_of_a_scan_outside_is_the_nearest_region_that_fits(
    write: Write, place: str, cure: tuple[str, ...]
) -> None:
    error = only_error(write(SERIES + SIZE + place + REGION, frame=SIMULATED))
    assert "plans what its limits refuse" in error.what
    found = CURE.search(error.hint)
    assert found is not None
    assert found.groups() == cure
    center, size = f'center = ["{found[1]}", "{found[2]}"]\n', f'size = ["{found[3]}", "{found[4]}"]\n'
    angle = 'angle = "90 deg"\n' if "angle" in place else ""
    assert errors(write(SERIES + size + center + angle + REGION, frame=SIMULATED)) == []


def test_the_cure_of_a_grid_outside_is_how_far_it_moves(write: Write) -> None:
    (error,) = {finding.hint for finding in errors(write(GRID + 'center = ["1 um", "0 um"]\n' + REGION))}
    assert error == "it fits if moved by (-500 nm, 0 nm)"
    (error,) = {finding.hint for finding in errors(write(GRID.replace("[3,", "[5,") + REGION))}
    assert error == "all of it is larger than the region allowed, 4 x 4 µm"


ALLOWED = st.floats(1e-6, 1e-5)


def test_each_region_of_a_list_has_a_line_and_a_cure(write: Write) -> None:
    places = '{ center = [0, 0], size = ["1 um", "1 um"] },\n{ center = ["9 um", 0], size = ["1 um", "1 um"] }'
    listed = f'[list]\ncomponent = true\nclass = "ScanList"\nregions = [\n{places}]\n'
    experiment = write(listed + REGION, frame=SIMULATED)
    error = only_error(experiment)
    assert error.hint == 'the nearest that fits: center = ["1.5 µm", "0 nm"], size = ["1 µm", "1 µm"]'
    assert error.place.line == line_of(experiment, '{ center = ["9 um"')


LENGTHS = st.floats(1e-8, 1e-5)
PLACES = st.floats(-1e-5, 1e-5)
ANGLES = st.floats(-math.pi, math.pi)


@given(PLACES, PLACES, LENGTHS, LENGTHS, ANGLES, ALLOWED, ALLOWED, ANGLES)
def test_the_nearest_region_lies_within_the_region_allowed(
    x: float, y: float, width: float, height: float, angle: float, across: float, up: float, turned: float
) -> None:
    wanted = Region((x, y), (width, height), angle)
    allowed = Region((1e-6, -2e-6), (across, up), turned)
    nearest = nearest_region(wanted, allowed)
    reach = Region(allowed.center_m, (across * (1 + 1e-9), up * (1 + 1e-9)), turned)  # as the limits have it
    assert all(reach.contains((float(x), float(y))) for x, y in nearest.corners_m())
    assert nearest.size_m[0] / nearest.size_m[1] == pytest.approx(width / height, rel=1e-4)
    if all(allowed.contains((float(x), float(y))) for x, y in wanted.corners_m()):
        assert nearest.center_m == pytest.approx(wanted.center_m, abs=1e-3 * max(across, up))


@pytest.mark.parametrize(
    ("role", "what"),
    [
        ('region = { x = ["-1 um", "1 um"], y = ["-0.3 um", "1 um"] }', "lies outside the region allowed"),
        ('actions = ["start-spec"]', "start-scan is not among the actions of series"),
        ('parameters = { tip-bias-voltage = ["-1 V", "1 V"] }', "tip-bias-voltage = 2 V is above the highest allowed"),
        ("parameters = { zctrl-setpoint = [0.1, 1.0] }", "tip-bias-voltage is not among the parameters of series"),
    ],
)
def test_a_plan_that_the_role_of_its_component_refuses_is_an_error(write: Write, role: str, what: str) -> None:
    series = SERIES + SIZE + 'parameters = { tip-bias-voltage = "2 V" }\n'
    assert what in only_error(write(f"{series}[limits.roles.series]\n{role}\n", frame=SIMULATED)).what
    other = GRID.replace("[grid]", "[series2]")
    assert not errors(write(f"{other}{series}[limits.roles.series2]\nactions = ['start-scan']\n", frame=SIMULATED))


def test_spectra_outside_the_range_of_the_microscope_are_an_error(write: Write) -> None:
    grid = '[spectra]\ncomponent = true\nclass = "SpectroscopyGrid"\ncounts = [4, 1]\nspacing = ["10 um", "1 um"]\n'
    error = only_error(write(grid + 'center = ["40 um", "0 um"]\n', frame=SIMULATED))
    assert "[spectra] plans what its microscope refuses: probe-pos-x: 55000 nm is outside" in error.what
    assert not errors(write(grid, frame=SIMULATED))


@pytest.mark.parametrize(
    "plan",
    [
        '[plan]\ncomponent = true\nclass = "SpectroscopyGrid"\ncounts = [2, 2]\nspacing = ["1 um", "1 um"]\n',
        '[plan]\ncomponent = true\nclass = "Survey"\nsize = "4 um"\nzoom = "1 um"\ncurves = { top = "0 nm" }\n',
        '[plan]\ncomponent = true\nclass = "Sweep"\nmeasure = "spectrum"\nparameters = { zctrl-igain = [1, 2] }\n',
    ],
)
def test_a_kind_of_spectra_that_the_microscope_lacks_is_an_error(write: Write, plan: str) -> None:
    what = only_error(write(plan + 'kind = "Force"\n', frame=SIMULATED)).what
    assert what == "[plan] plans what its microscope refuses: x-spec-kind: 'Force' is not one of IV, force, z"
    assert not errors(write(plan + 'kind = "force"\n', frame=SIMULATED))


@pytest.mark.parametrize(
    ("bound", "limit", "what"),
    [
        ("2e6", "", "what its microscope refuses: zctrl-igain: 2e+06 is outside 0 to 1e+06"),
        ("900.0", "[limits.zctrl-igain]\nmax = 500.0\n", "zctrl-igain = 900 is above the highest allowed, 500"),
    ],
)
def test_gain_of_the_tuner_beyond_a_bound_is_an_error_of_its_line(
    write: Write, bound: str, limit: str, what: str
) -> None:
    # paper F3: the tuner requested gains beyond the bound of the microscope, each of them refused
    tuner = f'[tuner]\ncomponent = true\nclass = "FeedbackTuner"\nlowest_gain = 1.0\nhighest_gain = {bound}\n'
    error = only_error(write(tuner + limit, frame=SIMULATED))
    assert what in error.what
    assert error.place.line == 5


@pytest.mark.parametrize(
    ("limit", "what"),
    [
        ("[limits]\nmost_pixels = 40_000\n", "256 x 256 pixels is above the highest number allowed, 40000 pixels"),
        ('[limits.scan-size-y]\nmin = "1.5 um"\n', "scan-size-y = 1 µm is below the lowest allowed, 1.5 µm"),
    ],
)
def test_zooms_that_the_limits_refuse_are_an_error(write: Write, limit: str, what: str) -> None:
    survey = SURVEY + 'zoom = "1 um"\nzoom_pixels = [256, 256]\n'
    error = only_error(write(survey + limit, frame=SIMULATED))
    assert what in error.what
    assert error.place.line == 5
    assert not errors(write(survey + REGION, frame=SIMULATED))
