"""The simulated run of a plan."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.model import Frame, names
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.safety.limits import Limit, RoleLimits
from afspm_agents.plan import read_plan
from afspm_agents.twin import refusals, simulate

SCAN = {"do": "scan", "center": ["0 nm", "0 nm"], "size": ["500 nm", "500 nm"], "pixels": [8, 8]}


def test_harmless_plan_changes_no_tip(tmp_path: Path) -> None:
    found = simulate(read_plan({"title": "look", "steps": [SCAN]}), {}, 1e-6, tmp_path)
    assert found["harm"]["tip_changes"] == 0
    assert found["seconds"] > 7.9


@pytest.mark.parametrize("who", ["agent:claude", "agent:rival"])
def test_preflight_names_what_the_role_lacks(who: str) -> None:
    role = RoleLimits(
        ExperimentLimits(parameters={names.TIP_BIAS_VOLTAGE: Limit(-1.0, 1.0, unit="V")}),
        parameters_only=True,
        actions=(names.START_SCAN,),
        source="night.toml:7",
    )
    steps = [
        {"do": "set", "parameter": names.TIP_BIAS_VOLTAGE, "value": "0.9 V"},
        {"do": "set", "parameter": names.FEEDBACK_ON, "value": "off"},
        SCAN,
        {"do": "spectrum", "at": ["0 nm", "0 nm"]},
    ]
    plan = read_plan({"title": "t", "steps": steps})
    found = refusals(plan, who, ExperimentLimits(roles={"agent": role}), Frame.TIP)
    assert [one.rpartition(": ")[2] for one in found] == [
        f"{names.FEEDBACK_ON} is not among the parameters of {who} (night.toml:7)",
        f"{names.SCAN_TOP_LEFT_X} is not among the parameters of {who} (night.toml:7)",
        f"{names.PROBE_POS_X} is not among the parameters of {who} (night.toml:7)",
        f"{names.START_SPEC} is not among the actions of {who} (night.toml:7)",
    ]
