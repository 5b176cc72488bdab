"""`bias_reference` and `sample-bias` in an experiment file: one setting under two names, or an error."""

from __future__ import annotations

from functools import partial

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from afspm.basics.errors import ConfigError
from afspm.driver import Driver
from afspm.experiment import Experiment, capabilities
from afspm.model.bias import BiasOf, BiasReference
from afspm.plugins.asylum import Asylum
from afspm.plugins.gxsm import Gxsm
from afspm.plugins.nanonis import Nanonis
from afspm.plugins.nanosurf import Nanosurf
from afspm.plugins.park import Park
from afspm.scheduler.safety.limits import Limit
from afspm.simulation.simulator import Simulator

from .conftest import Write, errors, only_error

SCHEDULER = '[scheduler]\ncomponent = true\nclass = "Scheduler"\n'

ALIAS, BIAS = "[limits.sample-bias]\n", "[limits.tip-bias-voltage]\n"
UNKNOWN = '[microscope]\ncomponent = true\nclass = "Nanonis"\n'
PARK, ASYLUM = UNKNOWN.replace("Nanonis", "Park"), UNKNOWN.replace("Nanonis", "Asylum")
TIP = UNKNOWN + 'bias_reference = "tip"\n'
SAMPLE = TIP.replace('"tip"', '"sample"')


@pytest.fixture(name="write")
def with_a_driver(write: Write) -> Write:
    return partial(write, frame=SCHEDULER)


def limit_of(experiment: Experiment) -> Limit:
    assert not errors(experiment)
    assert "sample-bias" not in experiment.resolved.limits.parameters
    return experiment.resolved.limits.parameters["tip-bias-voltage"]


@pytest.mark.parametrize(("microscope", "ends"), [(SAMPLE, (-1.0, 3.0)), (TIP, (-3.0, 1.0))])
def test_limit_on_the_alias_is_one_on_the_panel(write: Write, microscope: str, ends: tuple[float, float]) -> None:
    found = limit_of(write(microscope + ALIAS + 'min = "-1 V"\nmax = "3 V"\nstep = "0.5 V"\n'))
    assert ((found.low, found.high), found.step, found.unit) == (ends, 0.5, "V")


def test_the_narrower_of_both_limits_holds_and_names_both_places(write: Write) -> None:
    text = TIP + ALIAS + 'min = "-1 V"\nmax = "3 V"\nrate = "1 V/s"\nevery = "2 s"\n'
    found = limit_of(write(text + BIAS + 'min = "-2 V"\nmax = "2 V"\nrate = "3 V/s"\n'))
    assert (found.low, found.high, found.rate_per_s, found.interval_s) == (-2.0, 1.0, 1.0, 2.0)
    assert found.source.count("night.toml:") == 2


@given(
    st.sampled_from(("sample", "tip")),
    *[st.one_of(st.none(), st.integers(-9, 9).map(float)) for _ in range(4)],
    st.integers(-10, 10).map(float),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_value_within_both_limits_and_no_other_is_within_the_one_made_of_them(
    of: BiasOf, low: float | None, high: float | None, low_too: float | None, high_too: float | None, volts: float
) -> None:
    sign = -1.0 if of == "tip" else 1.0

    def within(value: float, low: float | None, high: float | None) -> bool:
        return (low is None or low <= value) and (high is None or value <= high)

    made = Limit(low, high).narrowed(Limit(low_too, high_too).times(sign))
    assert within(volts, made.low, made.high) is (within(volts, low, high) and within(sign * volts, low_too, high_too))


def test_components_that_may_set_one_name_alone_may_not_set_the_other() -> None:
    assert Limit(only=("a", "b")).narrowed(Limit(only=("b", "c"))).only == ("b",)
    assert Limit(only=("a",)).narrowed(Limit(only=("b",))).only == ()
    assert not Limit(unseen_sweeps=True).narrowed(Limit()).unseen_sweeps


def test_ranges_of_roles_and_rules_are_those_of_the_panel(write: Write) -> None:
    role = '[limits.roles.microscope]\nparameters = { sample-bias = ["-1 V", "3 V"] }\n'
    rules = '[limits]\nforbid = ["sample-bias > 1 V", "abs(sample-bias) > 2 V and zctrl-setpoint > 100 pA"]\n'
    experiment = write(TIP + rules + role)
    assert not errors(experiment)
    limits = experiment.resolved.limits
    (found,) = limits.roles["microscope"].limits.parameters.items()
    assert (found[0], found[1].low, found[1].high) == ("tip-bias-voltage", -3.0, 1.0)
    first, second = limits.forbid.values()
    assert (first.names, second.names) == ({"tip-bias-voltage"}, {"tip-bias-voltage", "zctrl-setpoint"})
    assert first.units == {"tip-bias-voltage": "V"}
    assert limits.bias == BiasReference("tip")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            UNKNOWN + ALIAS + 'max = "3 V"\n',
            "sample-bias is not known here",
        ),
        (
            UNKNOWN + '[limits]\nforbid = ["sample-bias > 1 V"]\n',
            "sample-bias is not known",
        ),
        (
            UNKNOWN + "[limits.roles.microscope]\nparameters = { sample-bias = [0, 1] }\n",
            "sample-bias is not known here",
        ),
        (
            PARK + ALIAS + 'max = "3 V"\n',
            "where a second electrode has a voltage",
        ),
        (
            ASYLUM + '[limits]\nforbid = ["sample-bias > 1 V"]\n',
            "where a second electrode",
        ),
        (
            PARK + 'bias_reference = "sample"\n',
            "SmartScan has the bias of the tip, not of the",
        ),
        (UNKNOWN + 'bias_reference = "probe"\n', "bias_reference"),
        (TIP + ALIAS + 'min = "1 V"\n' + BIAS + 'min = "1 V"\n', "no value is within the limits of both"),
        (TIP + '[limits]\nforbid = ["sample-bias"]\n', "is a number, and is compared with nothing"),
        (TIP + "[microscope.parameters.sample-bias]\nvendor = 'Bias.'\n", "another name of tip-bias-voltage"),
    ],
)
def test_contradictions_are_errors(write: Write, text: str, said: str) -> None:
    assert said in only_error(write(text)).what


def test_reference_that_the_maker_has_may_be_repeated(write: Write) -> None:
    assert not errors(write(PARK + 'bias_reference = "tip"\n'))


SWEEP = '[sweep]\ncomponent = true\nclass = "Sweep"\nsize = ["1 um", "1 um"]\npixels = [32, 32]\n'


@pytest.mark.parametrize(("microscope", "refused"), [(SAMPLE, "tip-bias-voltage = 2 V"), (TIP, "-2 V is below")])
def test_plan_that_sweeps_the_alias_is_judged_by_the_limits(write: Write, microscope: str, refused: str) -> None:
    limits = BIAS + 'min = "-1 V"\nmax = "1 V"\n'
    plan = SWEEP + '[sweep.parameters]\nsample-bias = ["1 V", "2 V"]\n'
    assert refused in only_error(write(microscope + limits + plan)).what
    assert not errors(write(microscope + limits + plan.replace("2 V", "-1 V")))


def test_plan_that_sweeps_the_alias_of_an_unknown_reference_or_both_names_is_an_error(write: Write) -> None:
    plan = SWEEP + '[sweep.parameters]\nsample-bias = ["1 V", "2 V"]\n'
    assert "sample-bias is not known here" in only_error(write(UNKNOWN + plan)).what
    both = plan + 'tip-bias-voltage = ["1 V", "2 V"]\n'
    assert "are one setting" in only_error(write(TIP + both)).what


@pytest.mark.parametrize(
    ("driver", "of", "second"),
    [
        (Simulator, "sample", False),
        (Asylum, "tip", True),
        (Park, "tip", True),
        (Nanonis, "", False),
        (Gxsm, "", False),
        (Nanosurf, "", False),
    ],
)
def test_reference_of_each_maker(driver: type[Driver], of: BiasOf, *, second: bool) -> None:
    found = capabilities.of_class(driver, {})
    assert found is not None
    assert found.bias == BiasReference(of, second)


def test_driver_with_another_reference_does_not_start() -> None:
    with pytest.raises(ConfigError, match="has the bias of the sample, not of the tip"):
        Simulator(bias_reference="tip")


NEEDS = 'needs_parameters = ["sample-bias"]\n'
FOREIGN = '[microscope]\ncomponent = true\nrole = "translator"\ncommand = ["python3"]\n'
PROGRAM = '[program]\ncomponent = true\ncommand = ["python3"]\n'


def test_program_that_needs_the_alias_is_refused_where_it_is_not_known(write: Write) -> None:
    assert not errors(write(TIP + PROGRAM + NEEDS))
    assert "bias_reference" in only_error(write(UNKNOWN + PROGRAM + NEEDS)).hint


def test_translator_in_another_language_may_have_a_second_electrode(write: Write) -> None:
    assert write(FOREIGN).resolved.limits.bias == BiasReference()
    declared = FOREIGN + 'bias_reference = "tip"\n'
    assert write(declared).resolved.limits.bias == BiasReference("tip", may_have_second=True)
    assert "second electrode" in only_error(write(declared + ALIAS + 'max = "3 V"\n')).what
