"""A part on another computer takes over the scheduler's clock."""

from __future__ import annotations

import json
from typing import Any

import pytest

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import ConfigError, WireError
from afspm.model import ControlResponse, Response
from afspm.supervisor.run_identity import RunIdentity, _identity_in

THEIRS = ExperimentClock(1_000.0, 5_000.0, 600.0)


def told(now_s: float, **clock: Any) -> Response:
    facts = {**(clock or THEIRS.as_dict()), "now_ns": int(now_s * NS_PER_S)}
    return Response(int(ControlResponse.SUCCESS), json.dumps(facts).encode())


def test_clock_of_the_scheduler_is_taken_unchanged_if_real_time_agrees() -> None:
    assert _identity_in(told(5_000.0 + 10.0 * 600.0), 1_009.999, 1_010.001, "").clock == THEIRS


def test_experiment_time_is_the_scheduler_s_even_with_a_wrong_wall_clock() -> None:
    ours = _identity_in(told(11_000.0), 1_309.999, 1_310.001, "").clock  # 300 s ahead of the scheduler
    assert ours.speed == 600.0
    assert ours.start_s + (1_310.0 - ours.origin_s) * ours.speed == pytest.approx(11_000.0)


def test_part_has_the_identity_of_its_scheduler() -> None:
    facts = {**THEIRS.as_dict(), "run": "ab12", "simulated": True}
    assert _identity_in(told(5_000.0, **facts), 1_000.0, 1_000.0, "") == RunIdentity(THEIRS, "ab12", simulated=True)
    assert not _identity_in(told(5_000.0), 1_000.0, 1_000.0, "").simulated


def test_scheduler_without_an_answer_is_an_error() -> None:
    with pytest.raises(ConfigError, match="not for you"):
        _identity_in(Response(int(ControlResponse.FAILURE), b"", "not for you"), 0.0, 0.0, "")
    with pytest.raises(WireError):
        _identity_in(Response(int(ControlResponse.SUCCESS), b"half past six"), 0.0, 0.0, "")
