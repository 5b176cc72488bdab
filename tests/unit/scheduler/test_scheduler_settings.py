"""The settings of a scheduler, from the experiment file through the launch line to its decisions."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import pydantic
import pytest

from afspm.basics.errors import ConfigError
from afspm.experiment.sections import keys_of
from afspm.model import Parameter, ProblemNames, Region
from afspm.model.events import SUPERVISOR
from afspm.model.snapshot import from_plain, to_plain
from afspm.scheduler.control.arbitration import Cause, RoleTable
from afspm.scheduler.publishing.envelopes import CacheRule, CacheSettings
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.scheduler import Scheduler
from afspm.scheduler.settings import ControlSettings

CONTROL = ControlSettings(
    lease_s=600.0,
    grace_s=1.5,
    malfunction_after_s=0.0,
    stop_scan_on_problem=False,
    retract=False,
    dangerous=("SCANNING", "feedback-off"),
    request_retries=0,
    adjustable=("zctrl-setpoint",),
    idle="stay",
    end_on=("tip-shape-changed",),
    roles=RoleTable(end_experiment=("boss",), operate=("dashboard:Ada",)),
)
CACHE = CacheSettings(
    {"Scan2d": 7}, (CacheRule("Scan2d", above_m=1e-6, envelope="Scan2d_wide_{channel}", history=3),), "parts.named"
)
LIMITS = ExperimentLimits(
    {"tip-bias-voltage": Limit(low=-3.0, high=3.0, rate_per_s=1.0, only=("repair",), unit="V", source="night.toml:3")},
    {"x-pulse": Limit(interval_s=60.0)},
    Region((1e-6, 0.0), (5e-6, 4e-6), 0.5),
    most_pixels=10_000,
    sets={"x-high": (Parameter("tip-bias-voltage", "2", "V"),)},
)


@pytest.mark.parametrize("section", [CONTROL, CACHE, LIMITS], ids=lambda section: type(section).__name__)
def test_section_survives_the_launch_line(section: object) -> None:
    assert from_plain(type(section), json.loads(json.dumps(to_plain(section)))) == section


def test_section_is_checked_by_the_keys_of_the_file() -> None:
    table = {"lease": "10 min", "grace": "1.5 s", "retract": False, "roles": {"set_mode": ["boss"]}}
    read = pydantic.TypeAdapter(ControlSettings).validate_python(table)
    assert read == ControlSettings(lease_s=600.0, grace_s=1.5, retract=False, roles=RoleTable(set_mode=("boss",)))
    assert list(keys_of(ControlSettings))[:3] == ["lease", "grace", "malfunction_after"]
    assert len(keys_of(ControlSettings)) == len(fields(ControlSettings))


@pytest.mark.parametrize(
    ("table", "error"),
    [
        ({"lease": "0 s"}, "not above 0 s"),
        ({"grace": "-1 s"}, "below 0 s"),
        ({"lease": "3 nm"}, "nm"),
        ({"lease_s": 3.0}, "lease_s"),
        ({"retract": "yes"}, "boolean"),
        ({"request_retries": -1}, "greater than or equal to 0"),
        ({"idle": "sleep"}, "'end' or 'stay'"),
        ({"roles": {"set_mod": ["boss"]}}, "set_mod"),
    ],
)
def test_impossible_setting_is_refused(table: dict[str, Any], error: str) -> None:
    with pytest.raises(pydantic.ValidationError, match=error):
        pydantic.TypeAdapter(ControlSettings).validate_python(table)


def test_rules_and_watchdog_follow_from_control() -> None:
    rules, watchdog = CONTROL.rules(ProblemNames()), CONTROL.watchdog()
    assert rules.roles.end_experiment == ("boss", SUPERVISOR)
    assert rules.end_on == {ProblemNames().number("tip-shape-changed")}
    assert (watchdog.retract, watchdog.dangerous) == (None, {"SCANNING", "feedback-off"})
    assert Cause.PROBLEM not in watchdog.stop_when
    assert Cause.MANUAL in watchdog.stop_when


@pytest.mark.parametrize("plain", [{"leese_s": 3.0}, {"retract": "yes"}, {"idle": "sleep"}, {"dangerous": ["HUNGRY"]}])
def test_launch_line_with_an_impossible_setting_names_its_section(plain: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=r"\[control\]"):
        Scheduler(control=plain)
