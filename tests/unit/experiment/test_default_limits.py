"""Default limits of a driver: tightened by the experiment file, loosened by name."""

from __future__ import annotations

from dataclasses import fields

import pytest
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.experiment import Experiment
from afspm.experiment.limits_section import LimitsSection
from afspm.scheduler.safety.limits import ExperimentLimits, Limit, bounds, limit_key

from .conftest import Write, errors, only_error

MODULE = """
from pathlib import Path
from afspm.simulation.simulator import Simulator


class Stage(Simulator):
    limits_file = Path(__file__).with_name("limits.toml")
"""
DEFAULTS = """
[limits]
region = { x = ["-5 um", "5 um"], y = ["-5 um", "5 um"] }
most_pixels = 1000

[limits.forbid]
gentle = "abs(tip-bias-voltage) > 1 V and scan-speed > 1 um/s"

[limits.tip-bias-voltage]
min = "-10 V"
max = "10 V"
rate = "1 V/s"

[limits.actions.x-pulse]
every = "10 s"
"""
LINES = DEFAULTS.splitlines()
OF_BIAS = f"limits.toml:{LINES.index('[limits.tip-bias-voltage]') + 1}"
OF_RULE = f"limits.toml:{LINES.index('[limits.forbid]') + 2}"
FRAME = """
[scheduler]
component = true
class = "Scheduler"

[microscope]
component = true
class = "stage.Stage"
"""


@pytest.fixture
def staged(write: Write, request: pytest.FixtureRequest) -> Write:
    folder = request.getfixturevalue("tmp_path")
    (folder / "stage.py").write_text(MODULE, encoding="utf-8")
    (folder / "limits.toml").write_text(DEFAULTS, encoding="utf-8")
    return lambda text: write(text, frame=FRAME)


def test_defaults_hold_and_are_shown_with_their_source(staged: Write) -> None:
    experiment: Experiment = staged("")
    assert not errors(experiment)
    limits = experiment.resolved.limits
    assert (limits.parameters["tip-bias-voltage"].high, limits.most_pixels) == (10.0, 1000)
    assert limits.actions["x-pulse"].interval_s == 10.0
    assert limits.region is not None
    assert limits.most_pixels_source.endswith(f"limits.toml:{LINES.index('most_pixels = 1000') + 1}")
    assert list(limits.forbid) == ["gentle"]
    shown = CliRunner().invoke(app, ["check", str(experiment.files[0])]).output
    assert f"{OF_BIAS}: limit of the driver: tip-bias-voltage" in shown
    assert f"{OF_RULE}: limit of the driver: gentle" in shown


def test_file_tightens_defaults(staged: Write) -> None:
    text = '[limits]\nforbid = ["scan-speed > 1 mm/s"]\nmost_pixels = 10\n[limits.tip-bias-voltage]\nmax = "3 V"\n'
    experiment = staged(text)
    assert not errors(experiment)
    limits = experiment.resolved.limits
    bias = limits.parameters["tip-bias-voltage"]
    assert (bias.low, bias.high, bias.rate_per_s, limits.most_pixels) == (-10.0, 3.0, 1.0, 10)
    assert "night.toml:4" in bias.source
    assert OF_BIAS in bias.source
    assert len(limits.forbid) == 2


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ('[limits.tip-bias-voltage]\nmax = "11 V"\n', "tip-bias-voltage"),
        ('[limits.tip-bias-voltage]\nmin = "-11 V"\n', "tip-bias-voltage"),
        ('[limits.tip-bias-voltage]\nrate = "2 V/s"\n', "tip-bias-voltage"),
        ('[limits.actions.x-pulse]\nevery = "5 s"\n', "x-pulse"),
        ('[limits]\nregion = { x = ["-6 um", "5 um"], y = ["-5 um", "5 um"] }\n', "region"),
        ("[limits]\nmost_pixels = 2000\n", "most_pixels"),
    ],
)
def test_default_is_loosened_by_name_alone(staged: Write, text: str, name: str) -> None:
    error = only_error(staged(text))
    assert "than the driver's limit" in error.what
    assert f'loosen = ["{name}"]' in error.hint
    loosened = f'[limits]\nloosen = ["{name}"]\n' + text.replace("[limits]\n", "")
    assert not errors(staged(loosened))


def test_rule_is_dropped_by_its_name(staged: Write) -> None:
    assert not staged('[limits]\nloosen = ["gentle"]\n').resolved.limits.forbid
    assert "did you mean 'gentle'" in only_error(staged('[limits]\nloosen = ["gentel"]\n')).hint


def test_each_limit_has_a_default_that_a_file_may_tighten() -> None:
    assert {one.name for one in fields(Limit)} == {*bounds(Limit), "unit", "source", "unseen_sweeps"}
    of_experiment = bounds(ExperimentLimits)
    assert LimitsSection.model_fields.keys() == {*map(limit_key, of_experiment), "loosen", "none"}
    places, merged_by_name = (f"{name}_source" for name in of_experiment), ("parameters", "actions", "forbid")
    of_file_alone = ("sets", "roles", "bias", "movers")
    assert {one.name for one in fields(ExperimentLimits)} == {
        *of_experiment, *places, *merged_by_name, *of_file_alone
    }  # fmt: skip
