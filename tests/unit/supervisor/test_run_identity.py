"""What a part of an experiment makes of the time that the scheduler tells, on another computer."""

from __future__ import annotations

import json
from typing import Any

import pytest

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import ConfigError, WireError
from afspm.model import ControlResponse, Response
from afspm.supervisor.run_identity import RunIdentity, _read

THEIRS = ExperimentClock(1_000.0, 5_000.0, 600.0)


def told(now_s: float, **clock: Any) -> Response:
    facts = {**(clock or THEIRS.as_dict()), "now_ns": int(now_s * NS_PER_S)}
    return Response(int(ControlResponse.SUCCESS), json.dumps(facts).encode())


def test_where_real_time_is_the_same_the_clock_is_taken_as_it_is() -> None:
    assert _read(told(5_000.0 + 10.0 * 600.0), 1_009.999, 1_010.001, "").clock == THEIRS


def test_where_the_clock_on_the_wall_is_wrong_the_time_in_the_experiment_is_still_the_scheduler_s() -> None:
    ours = _read(told(11_000.0), 1_309.999, 1_310.001, "").clock  # five minutes ahead of the scheduler's computer
    assert ours.speed == 600.0
    assert ours.start_s + (1_310.0 - ours.origin_s) * ours.speed == pytest.approx(11_000.0)


def test_a_part_has_the_run_and_the_simulation_of_its_scheduler() -> None:
    facts = {**THEIRS.as_dict(), "run": "ab12", "simulated": True}
    assert _read(told(5_000.0, **facts), 1_000.0, 1_000.0, "") == RunIdentity(THEIRS, "ab12", simulated=True)
    assert not _read(told(5_000.0), 1_000.0, 1_000.0, "").simulated


def test_a_scheduler_that_does_not_tell_is_no_reason_to_guess() -> None:
    with pytest.raises(ConfigError, match="not for you"):
        _read(Response(int(ControlResponse.FAILURE), b"", "not for you"), 0.0, 0.0, "")
    with pytest.raises(WireError):
        _read(Response(int(ControlResponse.SUCCESS), b"half past six"), 0.0, 0.0, "")
