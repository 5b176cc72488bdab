"""[conditions] and the limits of other instruments reach the scheduler; mistakes are errors with their place."""

from __future__ import annotations

import pytest

from afspm.model.snapshot import from_plain
from afspm.scheduler.instruments.conditions import AllowedBand, InstrumentSettings

from .conftest import Write, errors, line_of, only_error

CRYO = """
[cryo]
component = true
class = "Instrument"
address = "secop://cryo-pc"
parameters = { "cryo.temperature" = "tt", "cryo.field" = "mf" }

[problems]
not-at-temperature = 100

"""
COLD = '[conditions.cold]\n"cryo.temperature" = { from = "4.15 K", to = "4.25 K", for = "1 min" }\n'


def test_condition_reaches_the_scheduler(write: Write) -> None:
    experiment = write(CRYO + COLD + 'while = ["start-scan"]\nproblem = "not-at-temperature"\n')
    assert not errors(experiment)
    (start,) = [
        one
        for one in experiment.launches(take_address=lambda: "tcp://127.0.0.1:9000")
        if "conditions" in one.launch.settings
    ]
    settings = from_plain(InstrumentSettings, start.launch.settings["conditions"])
    assert (settings.instruments, settings.problems) == (("cryo",), {"not-at-temperature": 100})
    cold = settings.conditions["cold"]
    assert cold.bands == {"cryo.temperature": AllowedBand(4.15, 4.25, None, 60.0, "K")}
    assert (cold.actions, cold.problem) == (("start-scan",), "not-at-temperature")
    assert cold.source.endswith(f"night.toml:{line_of(experiment, '[conditions.cold]')}")


def test_limit_of_an_instrument_is_in_the_unit_as_written(write: Write) -> None:
    experiment = write(CRYO + '[limits."cryo.field"]\nmax = "2 T"\nrate = "600 mT/min"\n')
    assert not experiment.check()
    limit = experiment.resolved.limits.parameters["cryo.field"]
    assert (limit.high, limit.unit) == (2.0, "T")
    assert limit.rate_per_s == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ('[limits."cryo.field"]\nmax = 2\n', "[limits.cryo.field]"),
        ('[limits.roles.grid]\nparameters = { "cryo.field" = [0, 2] }\n', "[limits.roles.grid.parameters.cryo.field]"),
    ],
)
def test_limit_of_an_instrument_without_a_unit_is_a_warning(write: Write, text: str, place: str) -> None:
    grid = "[grid]\ncomponent = true\nclass = 'Series'\n"
    found = [one for one in write(CRYO + grid + text).check() if "has no unit" in one.what]
    assert [one.what.partition(" has")[0] for one in found] == [place]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('[conditions.cold]\n"cryo.temprature" = { from = "4 K" }\n', "no instrument has the parameter"),
        ('[conditions.cold]\n"cryo.temperature" = { form = "4 K" }\n', "'form' is not a setting"),
        ('[conditions.cold]\n"cryo.temperature" = { for = "4 s" }\n', "has none of: from, to, within"),
        ('[conditions.cold]\n"cryo.temperature" = { from = "5 K", to = "4 K" }\n', "from must be less than to"),
        ('[conditions.cold]\n"cryo.temperature" = { from = "4 K", to = "5 V" }\n', "to = '5 V'"),
        ('[conditions.cold]\n"cryo.temperature" = { from = "4 K", for = 60 }\n', "a time without a unit"),
        ('[conditions.cold]\n"cryo.temperature" = { to = "5" }\n', "a text without a unit"),
        ("[conditions.cold]\n", "names no parameter of an instrument"),
        (COLD + 'problem = "too-warm"\n', "the experiment knows no problem 'too-warm'"),
        (COLD + 'while = ["strat-scan"]\n', "there is no action 'strat-scan'"),
        ('[limits."cryo.temprature"]\nmax = "300 K"\n', "there is no parameter"),
    ],
)
def test_mistake_in_a_condition_is_an_error(write: Write, text: str, what: str) -> None:
    assert what in only_error(write(CRYO + text)).what


def test_parameter_begins_with_the_name_of_its_instrument(write: Write) -> None:
    wrong = write(CRYO.replace('"cryo.field"', '"magnet.field"'))
    assert "'magnet.field' does not begin with 'cryo' and a dot" in only_error(wrong).what


def test_address_of_an_instrument_is_checked(write: Write) -> None:
    assert "is no address of a SECoP server" in only_error(write(CRYO.replace("secop:", "tcp:"))).what
    assert "names no module" in only_error(write(CRYO.replace('"tt"', '"t t"'))).what
