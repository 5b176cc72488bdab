"""The pause of `QuietHours`: when it begins, what ends it, and what a person at the instrument changes in that."""

from __future__ import annotations

import datetime as dt
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import ConfigError
from afspm.client.component import Component
from afspm.client.scope import Scope
from afspm.components.planned_scans import ScanSeries
from afspm.components.quiet_hours import QuietHours, is_act
from afspm.model import (
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    JournalEntry,
    PanelAct,
)
from afspm.model.requests import RETURN_REQUEST
from afspm.scheduler.publishing.event_log import panel_entry
from afspm.testing import Bench
from afspm.testing.components.simulated_time import START_S

UNIT_S, BEGIN_S = 600.0, 180.0
NUMBER = 254


def utc(text: str) -> dt.datetime:
    return dt.datetime.fromisoformat(text).replace(tzinfo=dt.UTC)


@pytest.mark.parametrize(
    ("begin", "end", "now", "until"),
    [
        ("22:00", "07:00", "2026-11-27T20:59:59", None),
        ("22:00", "07:00", "2026-11-27T21:00:00", "2026-11-28T06:00:00"),
        ("22:00", "07:00", "2026-11-28T05:59:59", "2026-11-28T06:00:00"),
        ("22:00", "07:00", "2026-11-28T06:00:00", None),
        ("09:00", "17:00", "2026-07-01T07:00:00", "2026-07-01T15:00:00"),
        ("09:00", "17:00", "2026-07-01T15:00:00", None),
        # the clocks go forward at 2:00 of 29 March, so the night has 8 hours
        ("22:00", "07:00", "2026-03-29T04:59:59", "2026-03-29T05:00:00"),
        # the hour from 2:00 to 3:00 of 25 October comes twice; the hours end in the first
        ("22:00", "02:30", "2026-10-25T00:29:59", "2026-10-25T00:30:00"),
        ("22:00", "02:30", "2026-10-25T01:15:00", None),
        ("02:30", "04:00", "2026-03-29T01:29:59", None),  # there is no 2:30 that night
        ("02:30", "04:00", "2026-03-29T01:30:00", "2026-03-29T02:00:00"),
    ],
)
def test_hours_are_local_times_also_when_the_clocks_change(begin: str, end: str, now: str, until: str | None) -> None:
    hours = QuietHours(begin, end, zone="Europe/Vienna").hours
    ends = hours.end_after(utc(now))
    assert (ends and ends.astimezone(dt.UTC)) == (until and utc(until))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"begin": "22", "end": "07:00"}, "begin: '22' is not a time of the day"),
        ({"begin": "22:00", "end": "24:00"}, "end: '24:00'"),
        ({"begin": "22:00", "end": "22:00"}, "leaves no time"),
        ({"begin": "22:00", "end": "07:00", "zone": "Europe/Wien"}, "there is no time zone 'Europe/Wien'"),
    ],
)
def test_impossible_hours_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        QuietHours(**settings)


def seconds(units: float) -> float:
    """Return the time in units of ten minutes as seconds; the quiet hours last from 1 to 2, and the run from 0.7."""
    return BEGIN_S + (units - 1.0) * UNIT_S


class Night:
    """An experiment of scans with quiet hours."""

    def __init__(
        self,
        folder: Path,
        *,
        withdraw: bool = False,
        panel: Sequence[tuple[float, str]] = (),
        others: Mapping[str, Component] | None = None,
    ) -> None:
        begin, end = (
            dt.datetime.fromtimestamp(START_S + seconds(units), dt.UTC).strftime("%H:%M") for units in (1.0, 2.0)
        )
        self.bench = Bench(
            QuietHours(begin, end, zone="UTC", withdraw=withdraw),
            others={"series": ScanSeries((1e-6, 1e-6), pixels=(16, 16), every=60.0, scans=10_000), **(others or {})},
            microscope={"panel": [{"at_s": at_s, "action": action} for at_s, action in panel]},
            problems={"quiet-hours": NUMBER},
            folder=folder,
        )

    def go_to(self, units: float) -> None:
        self.bench.run(until=seconds(units))

    @property
    def control(self) -> ControlState:
        state: ControlState = self.bench.published("ControlState")[-1]
        return state

    @property
    def entries(self) -> list[JournalEntry]:
        return [one for batch in self.bench.published("JournalEntries") for one in batch.entries]

    def actions_of(self, who: str) -> list[str]:
        return [one.subject for one in self.entries if one.who == who and one.subject.startswith(("x-", "start"))]

    @property
    def scans(self) -> int:
        return len(self.bench.scans)

    @property
    def is_paused(self) -> bool:
        return self.control == ControlState(ControlMode.MANUAL, None, (NUMBER,))

    @property
    def is_at_work(self) -> bool:
        before = self.scans
        self.bench.run(until=self.bench.now_s + 0.25 * UNIT_S)
        return self.control.mode is ControlMode.AUTOMATED and not self.control.problems and self.scans > before


@pytest.fixture
def night(tmp_path: Path) -> Iterator[Night]:
    made = Night(tmp_path)
    yield made
    made.bench.close()


def test_run_pauses_between_two_scans_and_goes_on(night: Night) -> None:
    night.go_to(0.9)
    assert not night.is_paused
    night.go_to(1.3)
    assert night.is_paused
    during = night.scans
    night.go_to(1.8)
    assert (night.is_paused, night.scans) == (True, during)
    night.go_to(2.2)
    assert night.is_at_work
    states = [one.state.name for one in night.bench.published("ScopeStateMsg")]
    assert "INTERRUPTED" not in states


def test_no_tip_waits_the_night_through_at_the_bias_of_a_plan(tmp_path: Path) -> None:
    plan = ScanSeries((1e-6, 1e-6), pixels=(16, 16), every=60.0, scans=10_000, parameters={"tip-bias-voltage": "-2 V"})
    night = Night(tmp_path, others={"series": plan})
    night.go_to(1.3)
    assert night.is_paused
    before, now = night.bench.published("Loans")[-2:]
    assert [one.lender for one in before.loans] == ["series"]
    assert now.loans == ()
    kinds = [one.request for one in night.entries if one.who == "quiet_hours"]
    assert kinds.index(RETURN_REQUEST) < kinds.index(ControlRequest.SET_CONTROL_MODE)
    night.bench.close()


def test_person_who_lets_the_run_continue_is_right_until_the_next_begin(night: Night) -> None:
    night.go_to(1.2)
    night.bench.set_mode(ControlMode.AUTOMATED)
    assert night.is_at_work
    night.go_to(1.9)
    assert night.is_at_work


def test_person_who_ends_a_pause_of_her_own_in_the_hours_is_right(night: Night) -> None:
    night.go_to(0.9)
    night.bench.set_mode(ControlMode.MANUAL)
    night.go_to(1.3)
    assert night.control == ControlState(ControlMode.MANUAL, None, ())
    night.bench.set_mode(ControlMode.AUTOMATED)
    assert night.is_at_work


def test_pause_of_a_person_outlasts_the_hours(night: Night, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    night.go_to(1.5)
    night.bench.set_mode(ControlMode.MANUAL)  # it is MANUAL already, and now a person wants it
    night.go_to(2.2)
    assert night.is_paused
    (line,) = (one for one in caplog.messages if "waits for a person" in one)
    assert "person: sets the mode MANUAL" in line
    night.bench.set_mode(ControlMode.AUTOMATED)
    assert night.is_at_work
    assert any(one.startswith("no longer true: the quiet hours are over") for one in caplog.messages)


def test_person_who_clears_the_flag_lets_the_run_go_on(night: Night) -> None:
    night.go_to(1.5)
    night.bench.clear("quiet-hours")
    night.go_to(1.6)
    assert night.control == ControlState(ControlMode.MANUAL, None, ())
    night.bench.set_mode(ControlMode.AUTOMATED)
    assert night.is_at_work


@pytest.mark.parametrize("who", ["quiet_hours", "scheduler", "translator"])
@pytest.mark.parametrize("when", [0.93, 1.93])
def test_kill_changes_nothing(tmp_path: Path, who: str, when: float) -> None:
    night = Night(tmp_path, withdraw=True)
    night.bench.at(seconds(when), night.bench.kill, who)
    night.go_to(1.9)
    assert night.is_paused
    night.go_to(2.2)
    assert night.is_at_work
    night.bench.close()


def test_tip_is_withdrawn_for_the_pause_and_brought_back_before_the_first_scan(tmp_path: Path) -> None:
    night = Night(tmp_path, withdraw=True)
    night.go_to(2.2)
    assert night.is_at_work
    wanted = ("flagged", "x-", "mode", "cleared")
    assert [one.what for one in night.entries if one.who == "quiet_hours" and one.what.startswith(wanted)] == [
        "flagged quiet-hours",
        "x-retract",
        "mode MANUAL",
        "mode AUTOMATED",
        "x-engage",
        "cleared quiet-hours",
    ]
    night.bench.close()


def test_tip_that_does_not_come_back_is_left_to_a_person(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    night = Night(tmp_path, withdraw=True)
    night.go_to(1.5)
    night.bench.refuse("x-engage")
    night.go_to(2.2)
    assert night.is_paused
    assert [one.getMessage() for one in caplog.records if one.levelno == logging.CRITICAL] == [
        "the quiet hours are over, and the run waits for a person: the tip could not be brought back: "
        "the action was refused: refused by the bench (2025-06-15); `afspm continue` lets it go on"
    ]
    night.bench.set_mode(ControlMode.AUTOMATED)
    assert night.is_at_work


@pytest.mark.parametrize(
    "panel", [[(280.0, "x-engage"), (380.0, "x-retract")], [(280.0, "x-engage")]], ids=["and back", "alone"]
)
def test_tip_that_a_person_has_moved_is_left_to_a_person(tmp_path: Path, panel: list[tuple[float, str]]) -> None:
    night = Night(tmp_path, withdraw=True, panel=panel)
    night.go_to(2.2)
    assert night.is_paused
    assert night.actions_of("quiet_hours") == ["x-retract"]
    night.bench.close()


@pytest.mark.parametrize("at_s", [139.9, 140.0, 140.1, 140.3, 141.0])
def test_pause_of_a_person_while_the_tip_is_withdrawn_outlasts_the_hours(tmp_path: Path, at_s: float) -> None:
    night = Night(tmp_path, withdraw=True)
    night.bench.at(at_s, night.bench.set_mode, ControlMode.MANUAL)
    night.go_to(2.2)
    assert night.control.mode is ControlMode.MANUAL
    assert "x-engage" not in night.actions_of("quiet_hours")
    night.bench.set_mode(ControlMode.AUTOMATED)
    assert night.is_at_work
    night.bench.close()


def test_act_while_the_component_was_away_is_seen(tmp_path: Path) -> None:
    night = Night(tmp_path, withdraw=True)
    night.go_to(1.9)
    night.bench.kill("quiet_hours", restarts=False)
    night.bench.set_mode(ControlMode.MANUAL)
    night.bench.run(until=seconds(1.95))
    process = night.bench._processes["quiet_hours"]
    process.banned = False
    process.start()
    night.go_to(2.2)
    assert night.is_paused
    assert "x-engage" not in night.actions_of("quiet_hours")
    night.bench.close()


def test_flag_that_a_person_cleared_leaves_the_tip_to_the_person(tmp_path: Path) -> None:
    night = Night(tmp_path, withdraw=True)
    night.go_to(1.5)
    night.bench.clear("quiet-hours")
    night.go_to(2.2)
    assert night.control.mode is ControlMode.MANUAL
    assert "x-engage" not in night.actions_of("quiet_hours")
    night.bench.close()


class Repair(Component):
    """Scans once to solve tip-shape-changed."""

    solves = ("tip-shape-changed",)

    def run(self) -> None:
        with self.scope.events("ControlState") as states:
            for _ in states:
                if self.scope.is_flagged("tip-shape-changed"):
                    with self.scope.control(solving="tip-shape-changed"):
                        self.scope.scan()
                        self.scope.clear("tip-shape-changed")


def test_no_problem_is_solved_while_the_tip_is_withdrawn(tmp_path: Path) -> None:
    night = Night(tmp_path, withdraw=True, others={"repair": Repair()})
    night.bench.at(150.0, night.bench.flag, "tip-shape-changed")
    night.go_to(2.2)
    assert night.is_at_work
    moved = [one.subject for one in night.entries if one.time_ns * 1e-9 > START_S + 145.0 and one.response == 0]
    assert next(one for one in moved if one in ("x-engage", "start-scan")) == "x-engage"
    assert night.actions_of("repair") == ["start-scan"]
    night.bench.close()


# tip T9
def test_tip_that_is_not_shown_and_was_moved_by_hand_is_never_engaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Scope, "tip", None)
    night = Night(tmp_path, withdraw=True, panel=[(280.0, "x-engage")])
    night.go_to(2.2)
    night.bench.set_mode(ControlMode.AUTOMATED)
    night.go_to(2.4)
    assert night.is_paused
    assert night.actions_of("quiet_hours") == ["x-retract"]
    assert "the microscope does not report its tip, which was moved by hand" in caplog.text
    night.bench.close()


# tip T9
def test_pause_goes_on_after_a_kill_right_before_the_mode_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_mode, reached = QuietHours._set_mode, list[str]()

    def killed_before(component: QuietHours, mode: ControlMode) -> str:
        if not reached:
            reached.append(component.memory["phase"])
            component.scope.sleep(UNIT_S)  # it is killed meanwhile
        return set_mode(component, mode)

    monkeypatch.setattr(QuietHours, "_set_mode", killed_before)
    night = Night(tmp_path)
    night.bench.at(seconds(1.2), night.bench.kill, "quiet_hours")
    night.go_to(1.5)
    assert reached == ["pauses"]
    assert night.is_paused
    night.go_to(2.2)
    assert night.is_at_work
    night.bench.close()


def asked(who: str, request: int, response: int = ControlResponse.SUCCESS, subject: str = "") -> JournalEntry:
    return JournalEntry(1, "request", who, "", response, request=request, subject=subject)


@pytest.mark.parametrize(
    ("entry", "is_one"),
    [
        (panel_entry(1, "translator", ActByHand(1, PanelAct.WITHDRAW), []), True),
        (asked("dashboard:ada", ControlRequest.ACTION, subject="start-scan"), True),
        (asked("dashboard:ada", ControlRequest.PARAM, subject="tip-bias-voltage"), True),
        (asked("terminal:ada", ControlRequest.SET_CONTROL_MODE), True),
        (asked("dashboard:ada", ControlRequest.PARAM), False),  # a value is read
        (asked("series", ControlRequest.SET_PROBE_POS, ControlResponse.NOT_IN_CONTROL), False),
        (asked("quiet_hours", ControlRequest.ACTION, subject="x-retract"), False),
        (asked("dashboard:ada", ControlRequest.ACTION, ControlResponse.NO_RESPONSE, "x-engage"), True),
        (asked("scheduler", ControlRequest.ACTION, subject="stop-scan"), False),
        (asked("scheduler", ControlRequest.ACTION, subject="x-retract"), True),
    ],
)
def test_acts_of_a_person_differ_from_all_else(entry: JournalEntry, *, is_one: bool) -> None:
    assert is_act(entry, "quiet_hours") is is_one
