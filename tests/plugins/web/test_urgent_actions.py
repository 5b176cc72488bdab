"""An action that waits for a free microscope lets urgent ones and renewals through, and states its settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest
from deadlines import DEADLINE_S

from afspm.basics import ExperimentClock, Launch
from afspm.client import ExperimentLink
from afspm.model import ControlResponse, Parameter, Region, Response, ScanParameters, ScopeState, ScopeStatus, names
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.persons import Persons
from afspm.plugins.web.watch import Watch


class BusyMicroscope:
    """A connection to a scheduler whose microscope is never free."""

    def __init__(self) -> None:
        self.clock = ExperimentClock.real()
        self.asked: list[object] = []
        self.busy = 1_000_000

    def pump(self, timeout_s: float) -> None:
        pass

    def until(self, timeout_s: float) -> float:
        return self.clock.monotonic_s() + timeout_s

    def request(self, kind: int, subject: object = None, **_: object) -> Response:
        self.asked.append(subject)
        if subject != names.START_SCAN or self.busy == 0:
            return Response(int(ControlResponse.SUCCESS))
        self.busy -= 1
        return Response(int(ControlResponse.NOT_FREE))

    def lend(self, settings: object, _: float) -> Response:
        return self.request(0, settings)

    def give_back(self, _: float) -> Response:
        return self.request(0, "give back")


@pytest.fixture
def link() -> BusyMicroscope:
    return BusyMicroscope()


@pytest.fixture
def persons(link: BusyMicroscope) -> Persons:
    watch = Watch(link.clock)
    watch.take("ScopeStateMsg", ScopeStatus(ScopeState.SCANNING), 1)

    def connect(person: str, one: Any) -> tuple[Any, PersonCommands]:
        return None, PersonCommands(cast("ExperimentLink", link), watch, lambda: one.urgent > 0, one.meanwhile)

    return Persons(Launch("dashboard"), link.clock, watch, connect)


def test_wait_for_a_region_ends_with_its_centre_size_and_angle(
    link: BusyMicroscope, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = Region((0.0, 0.0), (2e-6, 2e-6), 0.5)
    others = [replace(wanted, size_m=(1e-6, 2e-6)), replace(wanted, angle_rad=0.0), wanted.moved_to((1e-6, 0.0))]
    watch = Watch(link.clock)
    commands = PersonCommands(cast("ExperimentLink", link), watch)
    waits: list[Any] = []
    monkeypatch.setattr(commands, "_settle", waits.append)
    assert commands.prepare_scan(wanted, (64, 64)) is None
    ended = []
    for number, region in enumerate([*others, wanted]):
        watch.take("ScanParameters2d", ScanParameters(region, (64, 64)), number + 1)
        with watch.reading() as overview:
            ended.append(waits[0](overview))
    assert ended == [False, False, False, True]


def test_stop_ends_the_waits_of_earlier_scans(persons: Persons, link: BusyMicroscope) -> None:
    waiting = [persons.submit("Ada", lambda one: one.act_when_free(names.START_SCAN)) for _ in range(2)]
    stopped = persons.submit("Ada", lambda one: one.act(names.STOP_SCAN), urgent=True)
    assert stopped.result(DEADLINE_S).ok
    assert [one.result(DEADLINE_S).code for one in waiting] == [ControlResponse.NOT_FREE] * 2
    assert link.asked[-1] == names.STOP_SCAN


def test_urgent_action_of_another_person_ends_no_wait(persons: Persons, link: BusyMicroscope) -> None:
    waiting = persons.submit("Ada", lambda one: one.act_when_free(names.START_SCAN))
    assert persons.submit("Max", lambda one: one.act(names.STOP_SCAN), urgent=True).result(DEADLINE_S).ok
    with pytest.raises(TimeoutError):
        waiting.result(0.2)
    assert persons.submit("Ada", lambda one: one.act(names.STOP_SCAN), urgent=True).result(DEADLINE_S).ok
    assert waiting.result(DEADLINE_S).code == ControlResponse.NOT_FREE


def test_scan_after_an_urgent_action_waits_again(persons: Persons, link: BusyMicroscope) -> None:
    assert persons.submit("Ada", lambda one: one.act(names.STOP_SCAN), urgent=True).result(DEADLINE_S).ok
    waiting = persons.submit("Ada", lambda one: one.act_when_free(names.START_SCAN))
    with pytest.raises(TimeoutError):
        waiting.result(0.2)
    persons.submit("Ada", lambda one: one.act(names.STOP_SCAN), urgent=True).result(DEADLINE_S)


def test_renewal_is_carried_out_while_a_scan_waits_which_then_waits_on(persons: Persons, link: BusyMicroscope) -> None:
    waiting = persons.submit("Ada", lambda one: one.act_when_free(names.START_SCAN))
    for lease_s in (60.0, 61.0):
        assert persons.submit("Ada", lambda one, s=lease_s: one.renew(s), meanwhile=True).result(DEADLINE_S).ok  # type: ignore[misc]
    assert link.asked == [60.0, 61.0]
    with pytest.raises(TimeoutError):
        waiting.result(0.2)
    assert persons.submit("Ada", lambda one: one.act(names.STOP_SCAN), urgent=True).result(DEADLINE_S).ok


def test_renewal_is_carried_out_where_nothing_waits(persons: Persons, link: BusyMicroscope) -> None:
    assert persons.submit("Ada", lambda one: one.renew(60.0), meanwhile=True).result(DEADLINE_S).ok
    assert link.asked == [60.0]


def test_settings_are_stated_before_each_attempt_and_given_back_with_control(link: BusyMicroscope) -> None:
    link.busy = 1
    watch = Watch(link.clock)
    watch.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), 1)
    commands = PersonCommands(cast("ExperimentLink", link), watch)
    bias = Parameter("tip-bias-voltage", "0.5", "V")
    assert commands.act_when_free(names.START_SCAN, settings=(bias,)).ok
    assert link.asked == [(bias,), names.START_SCAN] * 2
    assert commands.act_when_free(names.START_SCAN).ok
    assert link.asked[-2:] == [(), names.START_SCAN], "what an earlier scan has stated must not hold"
    assert commands.release_control().ok
    assert link.asked[-2:] == ["give back", None]
