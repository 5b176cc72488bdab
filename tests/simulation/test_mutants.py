"""The invariants can fail: what is broken on purpose is found within a few nights."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from afspm.logic import arbitration, event_log
from afspm.logic.arbiter import Arbiter
from afspm.logic.arbitration import ControlChange, ControlEvent, Transition
from afspm.logic.cache import PacketCache
from afspm.logic.event_log import EventLog
from afspm.logic.experiment_end import ExperimentEnd
from afspm.logic.forwarder import Forwarder
from afspm.logic.holder_timeout import HolderTimeout
from afspm.logic.idempotency_cache import IdempotencyCache
from afspm.logic.lease import Lease
from afspm.logic.limit_checker import LimitChecker
from afspm.logic.microscope_status import TipRisk
from afspm.logic.request_pipeline import RequestPipeline
from afspm.logic.scheduler_core import SchedulerCore
from afspm.logic.sessions import Hearing, SessionTable
from afspm.logic.watchdog import Watchdog
from afspm.model import JournalEntries
from tests.simulation.invariants import InvariantViolated
from tests.simulation.night import Fault, Night, Plan, plan

NIGHTS = 16
Patch = pytest.MonkeyPatch

_FEW = ("experiment", "classifier", "corrector", "feedback", "person")


def _bad_night(seed: int) -> Plan:
    """A night in which much goes wrong, half of them with a translator of version 1, some with somebody greedy."""
    away = [Fault("outage", "experiment", (seed % 10) / 10.0, 60.0)]
    drawn = plan(seed, hours=4.0)
    if seed % 4 == 3:  # few others and slow, so that control stays where it is
        drawn = replace(drawn, hours=8.0, speed=60.0, cast=(*_FEW, "greedy"), lease_s=900.0)
        away += [Fault("outage", holder, ((seed + place) % 10) / 10.0, 60.0) for place, holder in enumerate(_FEW)]
    if seed % 4 == 1:  # one whose tip is often in danger, at a microscope that can't always withdraw it
        cast = (*_FEW, "careless", "stranger")
        drawn = replace(drawn, cast=cast, ends=True, retracts=seed != 13, speed=60.0)
    there = ("scheduler", "translator", *drawn.cast)
    faults = (*(fault for fault in drawn.faults if fault.whom in there), *away)
    slow = replace(drawn, speed=drawn.speed / 2.0)  # in more real time more connections come and go
    return replace(slow, faults=faults, ids_known=seed % 2 == 0, dies_in_step=0.003, doubles=0.1, hangs=0.005)


def _rows(
    patch: Patch, event: ControlEvent, change: Callable[[tuple[Transition, ...]], tuple[Transition, ...]]
) -> None:
    patch.setitem(arbitration._ROWS, event, change(arbitration._ROWS[event]))


def _without(condition: arbitration.Condition) -> Callable[[tuple[Transition, ...]], tuple[Transition, ...]]:
    return lambda rows: tuple(row for row in rows if row.when is not condition)


def _not_doing(do: ControlChange) -> Callable[[tuple[Transition, ...]], tuple[Transition, ...]]:
    return lambda rows: tuple(replace(row, do=tuple(d for d in row.do if d is not do)) for row in rows)


def flag_leaves_control(patch: Patch) -> None:
    _rows(patch, ControlEvent.FLAG, _not_doing(ControlChange.TAKE))


def two_in_control(patch: Patch) -> None:
    _rows(patch, ControlEvent.REQUEST_CONTROL, _without(arbitration.OTHER_HOLDS))


def anybody_while_flagged(patch: Patch) -> None:
    _rows(patch, ControlEvent.REQUEST_CONTROL, _without(arbitration.SOLVES_NONE))


def manual_lets_in(patch: Patch) -> None:
    _rows(patch, ControlEvent.REQUEST_CONTROL, _without(arbitration.IS_MANUAL))


def manual_leaves_control(patch: Patch) -> None:
    _rows(patch, ControlEvent.SET_MODE, _not_doing(ControlChange.TAKE))


def solver_stays_when_solved(patch: Patch) -> None:
    _rows(patch, ControlEvent.CLEAR, _not_doing(ControlChange.TAKE))


def anybody_commands(patch: Patch) -> None:
    rows = arbitration._ROWS[ControlEvent.COMMAND]
    _rows(patch, ControlEvent.COMMAND, lambda _: (replace(rows[0], when=arbitration.OTHERWISE),))


def the_dead_keep_control(patch: Patch) -> None:
    _rows(patch, ControlEvent.DEAD, _not_doing(ControlChange.TAKE))


def no_lease(patch: Patch) -> None:
    patch.setattr(Lease, "deadline_ns", lambda self: None)


def nobody_is_dead(patch: Patch) -> None:
    patch.setattr(HolderTimeout, "dead_at_s", lambda self, holder: None)


def an_impostor_is_let_in(patch: Patch) -> None:
    real = SessionTable.hear

    def hear(self: SessionTable, *args: Any) -> Hearing:
        hearing = real(self, *args)
        if hearing is Hearing.TAKEN:
            self._bind(args[1], None, args[0])
            return Hearing.ACCEPTED
        return hearing

    patch.setattr(SessionTable, "hear", hear)


def ids_are_forgotten(patch: Patch) -> None:
    patch.setattr(IdempotencyCache, "look_up", lambda self, client, request: None)


def sent_actions_are_not_saved(patch: Patch) -> None:
    real = RequestPipeline.snapshot
    patch.setattr(RequestPipeline, "snapshot", lambda self: {**real(self), "sent": []})


def nothing_expires(patch: Patch) -> None:
    patch.setattr(Forwarder, "expire", lambda self, now_s: [])


def any_answer_will_do(patch: Patch) -> None:
    real = Forwarder.answered

    def answered(self: Forwarder, number: int, response: Any, now_s: float) -> Any:
        return real(self, self.flight.number if self.flight else number, response, now_s)

    patch.setattr(Forwarder, "answered", answered)


def nothing_is_called_back(patch: Patch) -> None:
    patch.setattr(RequestPipeline, "call_back", lambda self, former, cause: None)


def told_before_saved(patch: Patch) -> None:
    real = Arbiter._follow

    def follow(self: Arbiter, *args: Any) -> None:
        real(self, *args)
        self._pipeline.effects.sort(key=lambda effect: type(effect).__name__ == "SaveState")

    patch.setattr(Arbiter, "_follow", follow)


def times_go_back(patch: Patch) -> None:
    def next_ns(self: PacketCache, time_ns: int) -> int:
        self._last_ns = time_ns
        return time_ns

    patch.setattr(PacketCache, "_next_ns", next_ns)


def doubles_of_the_translator_pass(patch: Patch) -> None:
    patch.setattr(PacketCache, "remember", lambda self, recent: None)


def replay_by_one_newest_time(patch: Patch) -> None:
    real = PacketCache.replay
    patch.setattr(PacketCache, "replay", lambda self, prefixes, since_ns: real(self, prefixes, since_ns)[-3:])


def replay_envelope_by_envelope(patch: Patch) -> None:
    real = PacketCache.replay

    def replay(self: PacketCache, prefixes: Any, since_ns: int) -> Any:
        return tuple(sorted(real(self, prefixes, since_ns), key=lambda packet: packet.envelope))

    patch.setattr(PacketCache, "replay", replay)


def answers_are_written_down_once_more(patch: Patch) -> None:
    real = EventLog.take

    def take(self: EventLog) -> JournalEntries:
        taken, before = real(self), self.__dict__.setdefault("before", JournalEntries(()))
        self.__dict__["before"] = JournalEntries(taken.entries[-1:])
        return JournalEntries((*before.entries, *taken.entries))

    patch.setattr(EventLog, "take", take)


def every_fiftieth_answer_is_not_written_down(patch: Patch) -> None:
    real, count = EventLog.answered, itertools.count(1)

    def answered(self: EventLog, *args: Any) -> None:
        if next(count) % 50:
            real(self, *args)

    patch.setattr(EventLog, "answered", answered)


def changes_of_control_are_not_written_down(patch: Patch) -> None:
    patch.setattr(EventLog, "_say", lambda self, who, what, reason="": None)


def entries_are_held_back(patch: Patch) -> None:
    patch.setattr(SchedulerCore, "_entries_due_s", lambda self: None)


def entries_are_published_at_once(patch: Patch) -> None:
    patch.setattr(event_log, "PERIOD_S", 0.0)


def entries_backwards(patch: Patch) -> None:
    real = EventLog.take
    patch.setattr(EventLog, "take", lambda self: JournalEntries(real(self).entries[::-1]))


def entries_are_not_kept_over_a_kill(patch: Patch) -> None:
    real = PacketCache.restore

    def restore(self: PacketCache, packets: Any, *args: Any) -> None:
        real(self, [entry for entry in packets if entry[0].envelope != event_log.ENTRIES], *args)

    patch.setattr(PacketCache, "restore", restore)


def the_tip_is_never_retracted(patch: Patch) -> None:
    patch.setattr(Watchdog, "_want_retract", lambda self: None)


def a_danger_that_can_not_be_helped_is_never_told(patch: Patch) -> None:
    patch.setattr(TipRisk, "untold", lambda self: None)


def nobody_is_called_to_a_tip_that_was_retracted(patch: Patch) -> None:
    patch.setattr(Watchdog, "left_to_people", False)


def other_problems_are_solved_with_a_tip_that_is_away(patch: Patch) -> None:
    _rows(patch, ControlEvent.REQUEST_CONTROL, _without(arbitration.SOLVES_OTHER_THAN_MALFUNCTION))


def the_end_does_not_wait_for_the_tip(patch: Patch) -> None:
    patch.setattr(ExperimentEnd, "is_due", lambda self, now_s: self.by_s is not None)


def the_end_never_comes(patch: Patch) -> None:
    patch.setattr(ExperimentEnd, "is_due", lambda self, now_s: False)


def limits_are_not_checked(patch: Patch) -> None:
    patch.setattr(LimitChecker, "check", lambda self, *args: None)


def everybody_has_every_role(patch: Patch) -> None:
    patch.setattr(arbitration, "may", lambda role, who: True)


MUTANTS = [
    the_tip_is_never_retracted,
    a_danger_that_can_not_be_helped_is_never_told,
    nobody_is_called_to_a_tip_that_was_retracted,
    other_problems_are_solved_with_a_tip_that_is_away,
    the_end_does_not_wait_for_the_tip,
    the_end_never_comes,
    limits_are_not_checked,
    everybody_has_every_role,
    answers_are_written_down_once_more,
    every_fiftieth_answer_is_not_written_down,
    changes_of_control_are_not_written_down,
    entries_are_held_back,
    entries_are_published_at_once,
    entries_backwards,
    entries_are_not_kept_over_a_kill,
    flag_leaves_control,
    two_in_control,
    anybody_while_flagged,
    manual_lets_in,
    manual_leaves_control,
    solver_stays_when_solved,
    anybody_commands,
    the_dead_keep_control,
    no_lease,
    nobody_is_dead,
    an_impostor_is_let_in,
    ids_are_forgotten,
    sent_actions_are_not_saved,
    nothing_expires,
    any_answer_will_do,
    nothing_is_called_back,
    told_before_saved,
    times_go_back,
    doubles_of_the_translator_pass,
    replay_by_one_newest_time,
    replay_envelope_by_envelope,
]


def _nights() -> None:
    for seed in range(NIGHTS):
        Night(_bad_night(seed)).run()


def test_without_a_mutant_nothing_is_found() -> None:
    _nights()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.__name__)
def test_a_broken_scheduler_is_found(mutant: Callable[[Patch], None], monkeypatch: Patch) -> None:
    mutant(monkeypatch)
    with pytest.raises(InvariantViolated):
        _nights()
