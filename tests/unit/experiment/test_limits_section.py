"""[limits] becomes the scheduler's limits; contradictions, also with plans, are errors."""

from __future__ import annotations

import json
import math

import pytest

from afspm.model import ControlRequest, Feedback, Parameter, Request
from afspm.model.snapshot import from_plain, to_plain
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limits import ExperimentLimits
from afspm.scheduler.safety.movers import MEASURES

from .conftest import FRAME, Write, errors, line_of, only_error

CORRECTOR = '[repair]\ncomponent = true\nclass = "parts.Corrector"\n'
BIAS = "[limits.tip-bias-voltage]\n"


def test_limits_reach_the_scheduler_in_si(write: Write) -> None:
    experiment = write(
        CORRECTOR
        + BIAS
        + 'min = "-3 V"\nmax = "300 mV"\nstep = "0.5 V"\nrate = "1 V/min"\nevery = "2 s"\nonly = ["repair"]\n'
        + "[limits.scan-angle]\nmax = 1.0\n"
        + '[limits.actions.x-crash]\nonly = []\nevery = "10 min"\n'
    )
    assert not errors(experiment)
    bias = experiment.resolved.limits.parameters["tip-bias-voltage"]
    assert (bias.low, bias.high, bias.step) == (-3.0, 0.3, 0.5)
    assert bias.rate_per_s == pytest.approx(1 / 60)
    assert (bias.interval_s, bias.only, bias.unit) == (2.0, ("repair",), "V")
    assert bias.source.endswith(f"night.toml:{line_of(experiment, '[limits.tip')}")
    assert experiment.resolved.limits.actions["x-crash"].only == ()
    assert experiment.resolved.limits.parameters["scan-angle"].high == 1.0


@pytest.mark.parametrize(
    "region",
    [
        '{ x = ["-5 um", "5 um"], y = ["0 um", "2 um"] }',
        '{ center = ["0 um", "1 um"], size = ["10 um", "2 um"] }',
    ],
)
def test_a_region_may_be_given_by_its_ends_or_its_centre(write: Write, region: str) -> None:
    found = write(f"[limits]\nregion = {region}\n").resolved.limits.region
    assert found is not None
    assert found.center_m == pytest.approx((0, 1e-6))
    assert found.size_m == pytest.approx((10e-6, 2e-6))


def test_a_turned_region_needs_the_unit_of_its_angle(write: Write) -> None:
    region = 'region = { center = ["0 um", "0 um"], size = ["2 um", "2 um"], angle = 5 }'
    assert "5 has no unit" in only_error(write(f"[limits]\n{region}\n")).what


def test_a_region_may_be_turned(write: Write) -> None:
    text = '[limits]\nregion = { center = ["0 m", "0 m"], size = ["1 um", "1 um"], angle = "45 deg" }\n'
    found = write(text).resolved.limits.region
    assert found is not None
    assert found.angle_rad == pytest.approx(math.pi / 4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BIAS + 'min = "3 V"\nmax = "-3 V"\n', "is above max"),
        (BIAS + 'max = "3 nm"\n', "nm can't be converted to V"),
        (BIAS + 'rate = "3 V"\n', "can't be converted"),
        (BIAS + 'step = "0 V"\n', "not above zero"),
        (BIAS + 'max = "a lot"\n', "not a number"),
        (BIAS + "max = nan\n", "not a finite number"),
        (BIAS + 'highest = "3 V"\n', "highest is not a setting"),
        (BIAS + 'only = ["repiar"]\n', "there is no component 'repiar'"),
        ("[limits]\ntip-bias-voltage = 3\n", "[limits] tip-bias-voltage"),
        ('[limits.scan-sped]\nmax = "1 um/s"\n', "there is no parameter 'scan-sped'"),
        ('[limits]\nregion = [["0 um", "1 um"], ["0 um", "1 um"]]\n', "region is a table of keys and values"),
        ("[limits.actions.strat-scan]\nonly = []\n", "there is no action 'strat-scan'"),
        ('[limits]\nregion = { x = ["5 um", "-5 um"], y = ["0 um", "1 um"] }\n', "region is empty"),
        ('[limits]\nregion = { x = ["0 um", "1 um"] }\n', "either x and y, or center and size"),
        ("[limits]\nmost_pixels = 0\n", "most_pixels"),
        ('[limits]\nforbid = "scan-speed > 1 um/s"\n', "neither a list of rules nor a table"),
        ("[limits]\nforbid = [3]\n", "3 is not a text"),
        ('[limits]\nforbid = ["scan-speed > 1 um/s and"]\n', "forbid, column 35: the rule ends where"),
        ('[limits]\nforbid = ["scan-sped > 1 um/s"]\n', "column 12: there is no parameter, instrument's"),
        ('[limits]\nforbid = ["""\nscan-sped > 1 um/s"""]\n', "character 1 of the rule: there is no parameter"),
        ('[limits]\nforbid = ["scan-speed > 1e999 um/s"]\n', "column 25: 1e999 is not a finite number"),
        ('[limits]\nforbid = ["scan-speed > 1 um"]\n', "scan-speed and 1 µm have different units: m/s and m"),
        ('[limits]\nforbid = ["scan-speed > 1"]\n', "scan-speed and 1 have different units: m/s and no unit"),
        ('[limits]\nforbid = ["scan-speed > scan-angle"]\n', "different units: m/s and rad"),
        ('[limits]\nforbid = ["x-feedback-on > 1"]\n', "is on or off, and can't be compared"),
        ('[limits]\nforbid = ["abs(scan-speed - scan-angle) > 1 um/s"]\n', "scan-angle is compared in rad and in m/s"),
        ('[limits]\nforbid = ["abs(scan-speed - x-feedback-on) > 1 um/s"]\n', "x-feedback-on is on or off"),
        ('[limits]\nforbid = ["SCANNING > 1"]\n', "is on or off, and can't be compared"),
        ('[limits]\nforbid = ["scan-speed"]\n', "scan-speed is a number, and is compared with nothing"),
        ('[limits]\nforbid = ["x-spec-kind"]\n', "x-spec-kind is a text"),
        ('[limits]\nforbid = ["not changes(scan-speed)"]\n', "a change can't be denied"),
        ('[limits]\nforbid = ["changes(scan-sped) and SCANNING"]\n', "there is no parameter, instrument's"),
        ('[limits]\nforbid = ["changes(scan-speed) > 1"]\n', "is on or off, and can't be compared"),
        ('[limits]\nforbid = ["changes(x-retract) and SCANNING"]\n', "and is never refused"),
        ('[limits]\nforbid = ["changes scan-speed"]\n', "where `(` is expected"),
        ('[limits]\nforbid = ["zctrl-setpoint > zctrl-setpoint"]\n', "known only in the run"),
        ('[limits]\nforbid = ["zctrl-setpoint > 1 nA or zctrl-setpoint > 1 nN"]\n', "compared in A and in N"),
        ('[limits]\nloosen = ["forbid"]\n', "the driver has no default limit 'forbid'"),
        (
            '[limits]\nregion = { x = ["0 um", "1 um"], y = ["0 um", "1 um"] }\n[limits.scan-size-x]\nmin = "3 um"\n',
            "does not fit into [limits] region",
        ),
    ],
)
def test_limits_that_contradict_are_errors(write: Write, text: str, said: str) -> None:
    assert said in only_error(write(text)).what


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[limits]\nregion = { x = [-3, 3e-6], y = [-3e-6, 3e-6] }\n", "[limits] region.x[0] = -3: without a unit"),
        ("[limits]\nregion = { center = [0, 0], size = [400, 1e-6] }\n", "[limits] region.size[0] = 400: without"),
        ("[limits.scan-size-x]\nmax = 400\n", "means 400 m"),
        (BIAS + "max = 300\n", "means 300 V"),
        (BIAS + "rate = 300\n", "means 300 V"),
        ("[limits.scan-speed]\nmax = 8\n", "means 8 m/s"),
    ],
)
def test_a_large_number_without_a_unit_is_an_error(write: Write, text: str, said: str) -> None:
    assert said in only_error(write(text)).what


def test_a_small_number_without_a_unit_is_in_si(write: Write) -> None:
    assert not errors(write("[limits]\nregion = { x = [-3e-6, 3e-6], y = [-3e-6, 3e-6] }\n" + BIAS + "max = 3\n"))


@pytest.mark.parametrize(("value", "is_clear"), [("100", False), ('"100 ms"', True), ('"0.1"', False), ("0", True)])
def test_a_time_without_a_unit_is_a_warning(write: Write, value: str, is_clear: bool) -> None:
    findings = write(f"[limits.x-pulse-duration]\nmax = {value}\n").check()
    assert not any(one.is_error for one in findings)
    assert (not any("has no unit, and counts in s" in one.what for one in findings)) is is_clear


def test_an_interval_without_a_unit_is_a_warning(write: Write) -> None:
    _, finding = write("[limits.actions.x-crash]\nevery = 10\n").check()
    assert not finding.is_error
    assert finding.what == "[limits.actions.x-crash] every = 10 has no unit, and counts in s"
    assert '"10 min"' in finding.hint


def test_a_pulse_duration_needs_its_unit(write: Write) -> None:
    corrector = '[repair]\ncomponent = true\nclass = "TipCorrector"\nworkshop_center = ["1 um", "1 um"]\n'
    assert "5 has no unit" in only_error(write(f"{corrector}pulse_duration = 5\n")).what


def test_action_among_the_parameters_is_an_error_with_its_place(write: Write) -> None:
    assert "[limits.actions.start-scan]" in only_error(write("[limits.start-scan]\nonly = []\n")).hint


SETPOINT = "[limits.zctrl-setpoint]\n"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('min = "0.1 V"\nmax = "500 mV"\n', (0.1, 0.5, None, None, "V")),
        ('max = "500 pA"\nstep = "0.1 nA"\n', (None, 5e-10, 1e-10, None, "A")),
        ('min = 0\nmax = "500 pA"\n', (0.0, 5e-10, None, None, "A")),
        ('rate = "1 nA/min"\n', (None, None, None, 1e-9 / 60, "A")),
    ],
)
def test_limit_of_unknown_dimension_is_in_si_with_a_warning(
    write: Write, text: str, found: tuple[float | None, ...]
) -> None:
    experiment = write(SETPOINT + text)
    assert not errors(experiment)
    (warning,) = [one for one in experiment.check() if "zctrl-setpoint" in one.what]
    assert f"counts in {found[-1]}" in warning.what
    limit = experiment.resolved.limits.parameters["zctrl-setpoint"]
    told = (limit.low, limit.high, limit.step, limit.rate_per_s)
    for value, wanted in zip(told, found[:-1], strict=True):
        assert value == (None if wanted is None else pytest.approx(wanted))
    assert limit.unit == found[-1]


@pytest.mark.parametrize("text", ["max = 500\n", "rate = 1\n", 'step = "0.1"\n'])
def test_a_limit_of_unknown_unit_is_an_error(write: Write, text: str) -> None:
    assert "has no unit" in only_error(write(SETPOINT + text)).what
    assert not errors(write(SETPOINT + 'every = "1 s"\n'))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("[limits.zctrl-pgain]", "V can't be converted to one without a unit"),
        ("[limits.x-laser]", ""),
    ],
)
def test_a_dimensionless_parameter_takes_no_limit_with_a_unit(write: Write, name: str, said: str) -> None:
    experiment = write(f'{name}\nmax = "3 V"\n')
    assert (said in only_error(experiment).what) if said else not errors(experiment)


@pytest.mark.parametrize(
    ("subject", "fits"),
    [
        (Feedback(setpoint=1e-6), False),
        (Feedback(setpoint=4e-10), True),
        (Parameter("zctrl-setpoint", "400"), False),
        (Parameter("zctrl-setpoint", "4e-10"), True),
        (Parameter("zctrl-setpoint", "400", "pA"), True),
        (Parameter("zctrl-setpoint", "0.6", "nA"), False),
        (Parameter("zctrl-setpoint", "0.4", "V"), False),
        (Parameter("x-laser", "400"), False),
        (Parameter("x-laser", "4e-10"), True),
        (Parameter("x-number", "2"), True),
        (Parameter("x-number", "2", "A"), False),
    ],
)
def test_plain_numbers_are_compared_in_si_with_a_foreign_translator(write: Write, subject: object, fits: bool) -> None:
    limited = SETPOINT + 'max = "500 pA"\n[limits.x-laser]\nmax = "500 pA"\n[limits.x-number]\nmax = 3\n'
    limits = LimitChecker(write(limited).resolved.limits)
    kind = ControlRequest.PARAM if isinstance(subject, Parameter) else ControlRequest.SET_ZCTRL_PARAMS
    assert (limits.check("experiment", Request(int(kind), subject), 0) is None) is fits


SIMULATED = '[scheduler]\ncomponent = true\nclass = "Scheduler"\n[microscope]\ncomponent = true\nclass = "Simulator"\n'


@pytest.mark.parametrize(
    ("settings", "limit", "said"),
    [
        ("", "0.9 V", ""),
        ("", "1 nA", "nA can't be converted to V"),
        ('feedback = { mode = "current" }\n', "1 nA", ""),
        ('surface = "lattice"\n', "1 nA", ""),  # by default it tunnels
        ('surface = "lattice"\nfeedback = { mode = "amplitude" }\n', "0.9 V", ""),
    ],
)
def test_a_setpoint_is_limited_in_the_unit_of_the_operating_mode(
    write: Write, settings: str, limit: str, said: str
) -> None:
    experiment = write(f'[limits.zctrl-setpoint]\nmax = "{limit}"\n', frame=SIMULATED + settings)
    assert (said in only_error(experiment).what) if said else not errors(experiment)


ADDED = 'actions = { x-high = { set = { tip-bias-voltage = "8 V", scan-angle = 90 } } }\n'


def test_parameters_set_by_an_added_action_are_limited_too(write: Write) -> None:
    experiment = write(BIAS + 'max = "3 V"\n', frame=SIMULATED + ADDED)
    error = only_error(experiment)
    assert "always refuse x-high: tip-bias-voltage = 8 V is above the highest allowed, 3 V" in error.what
    assert error.place is not None
    assert error.place.line == line_of(experiment, "actions")


def test_parameters_set_by_added_actions_reach_the_scheduler(write: Write) -> None:
    experiment = write(CORRECTOR + BIAS + 'only = ["repair"]\n', frame=SIMULATED + ADDED)
    assert not errors(experiment)
    limits = from_plain(ExperimentLimits, json.loads(json.dumps(to_plain(experiment.resolved.limits))))
    assert limits.sets == experiment.resolved.limits.sets
    guard = LimitChecker(limits)
    high = Request(int(ControlRequest.ACTION), "x-high")
    assert guard.check("repair", high, 0) is None
    refusal = guard.check("series", high, 0)
    assert refusal is not None
    assert "only repair" in refusal.reason


def test_rate_with_a_wrong_unit_is_an_error_with_an_example(write: Write) -> None:
    error = only_error(write('[limits.scan-speed]\nrate = "1 um/s^2"\n'))
    assert "1 m/s/s" in error.hint


SERIES = '[series]\ncomponent = true\nclass = "ScanSeries"\nsize = ["2 um", "2 um"]\n'
REGION = '[limits]\nregion = { x = ["-1.5 um", "1.5 um"], y = ["-1.5 um", "1.5 um"] }\n'


def test_a_planned_scan_within_the_limits_is_fine(write: Write) -> None:
    assert not errors(write(SERIES + REGION))


@pytest.mark.parametrize(
    ("plan", "limits", "said"),
    [
        ('center = ["1 um", "0 um"]\n', REGION, "outside the region allowed"),
        ("pixels = [512, 512]\n", "[limits]\nmost_pixels = 10_000\n", "512 x 512 pixels"),
        ("", '[limits.scan-size-x]\nmax = "1 um"\n', "scan-size-x"),
        ("", CORRECTOR + '[limits.scan-size-x]\nonly = ["repair"]\n', "may not use"),
    ],
)  # fmt: skip
def test_a_planned_scan_that_the_limits_would_refuse_is_an_error(
    write: Write, plan: str, limits: str, said: str
) -> None:
    experiment = write(SERIES + plan + limits)
    error = only_error(experiment)
    assert said in error.what
    assert "[series]" in error.what


def test_settings_that_do_not_fit_together_are_an_error_of_the_component(write: Write) -> None:
    assert "`end_when_done` without an end" in only_error(write(SERIES + "end_when_done = true\n")).what


def test_role_bounds_parameters_of_an_instrument_in_their_written_unit(write: Write) -> None:
    experiment = write(
        CORRECTOR
        + '[magnet]\ncomponent = true\nclass = "Instrument"\naddress = "secop://localhost"\n'
        + 'parameters = { "magnet.field" = "mf" }\n'
        + '[limits.roles.repair]\nparameters = { "magnet.field" = ["-500 mT", "0.5 T"] }\n'
    )
    assert not errors(experiment)
    limit = experiment.resolved.limits.roles["repair"].limits.parameters["magnet.field"]
    assert (limit.low, limit.high, limit.unit) == (-500.0, 500.0, "mT")


# --- movers ---

MOTOR = """
[limits.movers]
retraction = 40
x-coarse-away = { direction = "away", steps = 20, total = 2000 }
x-coarse-left = { direction = "lateral", steps = 20, total = 200 }
"""
SIMULATED = FRAME[: FRAME.index("[microscope]")] + '[microscope]\ncomponent = true\nclass = "Simulator"\n'
LAB = '[lab]\ncomponent = true\nclass = "Instrument"\naddress = "secop://127.0.0.1:1"\nparameters = { "lab.x" = "x" }\n'
STAGE = '[limits."lab.x"]\nstep = "100 um"\n[limits.movers."lab.x"]\ndirection = "lateral"\ntotal = "1 mm"\n'


def test_movers_reach_the_scheduler_with_their_rules(write: Write) -> None:
    experiment = write(LAB + MOTOR + STAGE, frame=SIMULATED)
    assert not errors(experiment)
    limits = experiment.resolved.limits
    found = limits.movers
    assert (found.retraction, found.approach) == (40, "x-approach")
    assert found.undeclared == ("x-coarse-down", "x-coarse-right", "x-coarse-up")
    assert (found.movers["lab.x"].total, found.movers["lab.x"].unit) == (1000.0, "um")
    assert found.movers["x-coarse-away"].steps == 20
    assert limits.forbid.keys() == {
        *(f"changes({one}) and x-engaged" for one in found.movers),
        *(f"changes({one}) and lab.x.busy" for one in ("x-engage", "x-approach", "x-feedback-on", *MEASURES)),
        "changes(lab.x) and COARSE_MOTOR",
    }
    assert from_plain(ExperimentLimits, json.loads(json.dumps(to_plain(limits)))) == limits


@pytest.mark.parametrize(
    ("changed", "to", "what"),
    [
        ("retraction = 40\n", "", "retraction is the number of steps away"),
        ("retraction = 40", "retraction = 0", "retraction is the number of steps away"),
        ('"lateral", steps = 20', '"sideways", steps = 20', "direction = 'sideways'"),
        ('"lateral", steps = 20', '"lateral"', "steps: the steps of one action"),
        ("x-coarse-left", "x-coarse-lift", "there is no action or instrument's parameter 'x-coarse-lift'"),
        (", total = 200 }", " }", "total = None is not a quantity"),
        ('[limits."lab.x"]\nstep = "100 um"\n', "", "a stage needs a longest way of one request"),
        ('"lab.x"]\ndirection = "lateral"', '"lab.x"]\ndirection = "away"', "direction = 'away'"),
    ],
)
def test_wrong_mover_is_refused(write: Write, changed: str, to: str, what: str) -> None:
    text = LAB + MOTOR + STAGE
    assert changed in text
    assert what in only_error(write(text.replace(changed, to), frame=SIMULATED)).what


def test_movers_need_a_microscope_that_shows_its_tip(write: Write) -> None:
    park = SIMULATED.replace("Simulator", "Park")
    found = only_error(write(LAB + "[limits.movers]\nretraction = 40\n" + STAGE, frame=park))
    assert "never shows whether its tip is withdrawn" in found.what


def test_coarse_motor_that_is_no_mover_is_named(write: Write) -> None:
    frame = SIMULATED.replace("Simulator", "Nanonis") + 'actions = { OUT = { command = "Motor.StartMove 4 10 0 1" } }\n'
    found = [one.what for one in write("", frame=frame).check() if "OUT" in one.what]
    assert found == ["[microscope] actions.OUT moves the coarse motor, and is refused until it is a mover"]


NANONIS = SIMULATED.replace("Simulator", "Nanonis")


@pytest.mark.parametrize(
    ("out", "mover", "what"),
    [
        ("Motor.StartMove 4 10 0 1", '{ direction = "away", steps = 10, total = 200 }', ""),
        ("Motor.StartMove 4 10 0 1", '{ direction = "away", steps = 20, total = 200 }', "its command makes 10"),
        ("Motor.StartMove 4 10 0 1", '{ direction = "lateral", steps = 10, total = 200 }', "its command goes Z+"),
        ("Motor.StartMove 0 10 0 1", '{ direction = "away", steps = 10, total = 200 }', "its command goes X+"),
        ("'Motor.StartMove' 4 5 0 1", '{ direction = "away", steps = 10, total = 200 }', "its command makes 5"),
    ],
)
def test_mover_is_compared_with_its_command(write: Write, out: str, mover: str, what: str) -> None:
    frame = NANONIS + f'actions = {{ OUT = {{ command = "{out}", withdrawn = false }} }}\n'
    found = errors(write(f"[limits.movers]\nretraction = 40\nOUT = {mover}\n", frame=frame))
    assert [what in one.what for one in found] == ([True] if what else []), found


def test_movers_away_go_one_way(write: Write) -> None:
    actions = ", ".join(
        f'{name} = {{ command = "Motor.StartMove {way} 10 0 1" }}' for name, way in (("A", 4), ("B", 5))
    )
    movers = "".join(f'{name} = {{ direction = "away", steps = 10, total = 200 }}\n' for name in "AB")
    found = only_error(write(f"[limits.movers]\n{movers}", frame=NANONIS + f"actions = {{ {actions} }}\n"))
    assert "go in two directions: Z+, Z-" in found.what


def test_approach_and_retract_are_no_movers(write: Write) -> None:
    mover = '[limits.movers]\nx-engage = { direction = "away", steps = 10, total = 200 }\n'
    assert "there is no action or instrument's parameter 'x-engage'" in only_error(write(mover, frame=SIMULATED)).what


def test_lateral_mover_is_refused_beside_sample_coordinates(write: Write) -> None:
    drift = '[scheduler]\ncomponent = true\nclass = "DriftCompensatedScheduler"\n'
    frame = drift + SIMULATED[SIMULATED.index("[microscope]") :]
    found = only_error(
        write('[control]\nsolved_by_hand = ["thermal-drift", "device-malfunction"]\n' + MOTOR, frame=frame)
    )
    assert "x-coarse-left moves the sample along, and sample coordinates of before do not hold" in found.what
