"""Faults of emulators: their times and counts."""

from __future__ import annotations

import json
from typing import Any

import pytest

from afspm.basics.errors import ConfigError
from afspm.simulation.faults import EVERY_TIME, Fault, Faults

KNOWN = {"no-reply": "", "modal-dialog": "", "crash": ""}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("no-reply", Fault("no-reply")),
        ("no-reply@12.5", Fault("no-reply", 12.5)),
        ("no-reply@3,count=2,duration=0.5", Fault("no-reply", 3.0, 2, 0.5)),
        ("no-reply,count=every", Fault("no-reply", count=EVERY_TIME)),
    ],
)
def test_fault_is_parsed_from_the_command_line(text: str, fault: Fault) -> None:
    assert Fault.parse(text) == fault


@pytest.mark.parametrize("text", ["no-reply@soon", "no-reply,often", "no-reply,count=0", "no-reply@-1", "x,count=1.5"])
def test_invalid_fault_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        Fault.parse(text)


def test_fault_is_read_from_the_experiment_file() -> None:
    assert Fault.of({"kind": "crash", "at_s": 2.0}) == Fault("crash", 2.0)
    with pytest.raises(ConfigError, match="is not a fault"):
        Fault.of({"kind": "crash", "when": 2.0})


def test_unknown_kind_is_refused_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="no-reply"):
        Faults([Fault("no-replies")], KNOWN, 0.0)


def test_fault_strikes_from_its_time_on_up_to_its_count() -> None:
    faults = Faults([Fault("no-reply", 5.0, 2)], KNOWN, 100.0)
    struck = [faults.strikes("no-reply", t_s) is not None for t_s in (104.9, 105.0, 300.0, 301.0)]
    assert struck == [False, True, True, False]


def test_kinds_strike_independently() -> None:
    faults = Faults([Fault("crash")], KNOWN, 0.0)
    assert faults.strikes("no-reply", 1.0) is None
    assert faults.strikes("crash", 1.0) == Fault("crash")


def test_fault_lasts_for_its_duration() -> None:
    faults = Faults([Fault("modal-dialog", 5.0, duration_s=2.0)], KNOWN, 100.0)
    assert [faults.lasts("modal-dialog", t_s) for t_s in (104.9, 105.0, 106.9, 107.0)] == [False, True, True, False]
    assert [faults.next_s(t_s) for t_s in (100.0, 105.0, 107.0)] == [105.0, 107.0, None]


def test_fault_on_demand_counts_from_now() -> None:
    faults = Faults([], KNOWN, 100.0)
    faults.demand(Fault("crash", 1.0), 150.0)
    assert faults.strikes("crash", 150.5) is None
    assert faults.strikes("crash", 151.0) is not None


def test_faults_that_have_struck_do_not_strike_again_after_a_restart() -> None:
    given = [Fault("crash", 1.0), Fault("no-reply", 0.0, count=3)]
    kept: dict[str, Any] = {}
    faults = Faults(given, KNOWN, 100.0, kept)
    assert faults.strikes("crash", 101.0)
    assert faults.strikes("no-reply", 101.0)
    again = Faults(given, KNOWN, 100.0, json.loads(json.dumps(kept)))
    assert again.strikes("crash", 200.0) is None
    assert [bool(again.strikes("no-reply", 200.0)) for _ in range(3)] == [True, True, False]
