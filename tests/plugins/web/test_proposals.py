"""The page knows the names of agents, their proposals, and the place that a person draws for a grant."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from afspm.model import Approval, Approvals, Proposal
from afspm.night import Overview
from afspm.plugins.web.archive import agents_in
from afspm.plugins.web.dashboard.steering_panel import drawn_box
from afspm.record import EXPERIMENT_FILE

PLAN = "f" * 16
PROPOSAL = Proposal(1, "agent:claude", PLAN, "{}", '{"seconds": 8.0}')


def test_plan_waits_again_only_after_a_new_preflight() -> None:
    overview = Overview()
    overview.take("Proposal", replace(PROPOSAL, preflight=""), 5)
    assert overview.waiting == []
    overview.take("Proposal", PROPOSAL, 10)
    assert overview.waiting == [PROPOSAL]
    overview.take("Approvals", Approvals((Approval("agent:claude", PLAN, "dashboard:Ada", 99, 3),)), 20)
    assert overview.waiting == []
    overview.take("Approvals", Approvals(), 30)
    assert overview.waiting == [], "it was carried out, and would be carried out a second time"
    overview.take("Proposal", replace(PROPOSAL, time_ns=40), 41)
    assert overview.waiting == [replace(PROPOSAL, time_ns=40)]


def test_drawn_rectangle_of_a_turned_picture_is_the_box_around_it() -> None:
    box = drawn_box({"x": 1.0, "y": 2.0, "width": 2.0, "height": 1.0, "angle": math.pi / 2})
    assert box.center_m == (1.0, 2.0)
    assert box.size_m == pytest.approx((1.0, 2.0))


def test_agents_of_the_experiment_file_are_suggested(tmp_path: Path) -> None:
    text = '[agent]\nclass = "Agent"\n[agent.people]\nclaude = "x"\n[other]\nclass = "Agent"\n[judge]\nclass = "J"\n'
    (tmp_path / EXPERIMENT_FILE).write_text(text, encoding="utf-8")
    assert agents_in(tmp_path) == ("agent:claude", "other:")
