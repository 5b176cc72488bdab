"""The invariants can fail: decisions broken on purpose are found within a few nights."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import JournalEntries, JournalEntry, PacketHeader
from afspm.model.idempotency_cache import Floors, IdempotencyCache
from afspm.model.microscope_status import MicroscopeStatus
from afspm.model.sessions import Hearing, SessionTable
from afspm.scheduler import scheduler_core
from afspm.scheduler.control import arbitration, control_change
from afspm.scheduler.control.arbitration import ArbitrationEvent, Cause, ControlChange, Transition
from afspm.scheduler.control.holder_timeout import HolderTimeout, Lease
from afspm.scheduler.control.lifecycle import ExperimentEnd
from afspm.scheduler.control.panel_state import PanelState
from afspm.scheduler.coordinate_frame import MappedRequest
from afspm.scheduler.events import Effect, PacketIn, RequestIn
from afspm.scheduler.publishing import event_log
from afspm.scheduler.publishing.cache import PacketCache
from afspm.scheduler.publishing.event_log import EventLog
from afspm.scheduler.requests import answers, request_pipeline
from afspm.scheduler.requests.forwarder import ForwardedRequest, Forwarder
from afspm.scheduler.safety import safety_commands
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.watchdog import Watchdog
from afspm.scheduler.shell import SchedulerShell
from afspm.scheduler.state import StateDraft
from afspm.transport.port import CaughtUp, PacketReceived
from tests.simulation.drift_night import DriftNight
from tests.simulation.forbidden_bench import SCENARIOS, ForbiddenBench
from tests.simulation.forbidden_mutants import MUTANTS as FORBIDDEN_MUTANTS
from tests.simulation.invariants import InvariantViolated
from tests.simulation.microscope import GARBLED
from tests.simulation.night import FINDERS, PANEL_NIGHTS, Night, bad_night, ends_in_danger, panel_night

pytestmark = pytest.mark.slow
Patch = pytest.MonkeyPatch


def _rows(
    patch: Patch, event: ArbitrationEvent, change: Callable[[tuple[Transition, ...]], tuple[Transition, ...]]
) -> None:
    patch.setitem(arbitration.TABLE, event, change(arbitration.TABLE[event]))


def _without(condition: arbitration.Condition) -> Callable[[tuple[Transition, ...]], tuple[Transition, ...]]:
    return lambda rows: tuple(row for row in rows if row.when is not condition)


def _not_doing(do: ControlChange) -> Callable[[tuple[Transition, ...]], tuple[Transition, ...]]:
    return lambda rows: tuple(replace(row, do=tuple(d for d in row.do if d is not do)) for row in rows)


def flag_leaves_control(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.FLAG, _not_doing(ControlChange.TAKE))


def two_in_control(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.REQUEST_CONTROL, _without(arbitration.OTHER_HOLDS))


def any_component_while_flagged(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.REQUEST_CONTROL, _without(arbitration.SOLVES_NONE))


def manual_lets_in(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.REQUEST_CONTROL, _without(arbitration.IS_MANUAL))


def manual_leaves_control(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.SET_MODE, _not_doing(ControlChange.TAKE))


def solver_stays_when_solved(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.CLEAR, _not_doing(ControlChange.TAKE))


def any_component_commands(patch: Patch) -> None:
    rows = arbitration.TABLE[ArbitrationEvent.COMMAND]
    _rows(patch, ArbitrationEvent.COMMAND, lambda _: (replace(rows[0], when=arbitration.OTHERWISE),))


def the_dead_keep_control(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.DEAD, _not_doing(ControlChange.TAKE))


def no_lease(patch: Patch) -> None:
    patch.setattr(Lease, "deadline_ns", lambda self, is_free: None)


def restarts_of_the_holder_are_not_counted(patch: Patch) -> None:
    patch.setattr(Lease, "is_restarted_too_often", lambda self, starts: False)


def no_holder_is_ever_dead(patch: Patch) -> None:
    patch.setattr(HolderTimeout, "dead_at_s", lambda self, *args: None)


def an_impostor_is_let_in(patch: Patch) -> None:
    real = SessionTable.hear

    def hear(self: SessionTable, *args: Any) -> tuple[SessionTable, Hearing]:
        table, hearing = real(self, *args)
        if hearing is Hearing.TAKEN:
            return table.bound(args[1], None, args[0]), Hearing.ACCEPTED
        return table, hearing

    patch.setattr(SessionTable, "hear", hear)


def ids_are_forgotten(patch: Patch) -> None:
    patch.setattr(IdempotencyCache, "look_up", lambda self, client, request: None)


def sent_actions_are_not_saved(patch: Patch) -> None:
    patch.setattr(IdempotencyCache, "sent", lambda self, client, request: self)


def nothing_expires(patch: Patch) -> None:
    patch.setattr(Forwarder, "expired", lambda self, now_s: (self, ()))


def any_answer_will_do(patch: Patch) -> None:
    real = Forwarder.answered

    def answered(self: Forwarder, number: int, response: Any) -> Any:
        return real(self, self.flight.number if self.flight else number, response)

    patch.setattr(Forwarder, "answered", answered)


def a_former_holder_commands_on(patch: Patch) -> None:
    patch.setattr(answers, "call_back", lambda draft, former, cause: None)
    patch.setattr(request_pipeline, "_not_allowed_now", lambda draft, job: None)


def published_before_saved(patch: Patch) -> None:
    real, persist = SchedulerShell._carry_out, SchedulerShell._persist

    def carry_out(self: SchedulerShell, effects: Sequence[Effect]) -> None:
        real(self, effects)
        persist(self, effects)

    patch.setattr(SchedulerShell, "_persist", lambda self, effects: None)
    patch.setattr(SchedulerShell, "_carry_out", carry_out)


def the_translator_is_closed_with_the_tip_in_danger(patch: Patch) -> None:
    patch.setattr(SchedulerShell, "_close_translator", lambda self: self._sockets.send(0, [wire.CLOSE]))


def the_translator_is_never_closed(patch: Patch) -> None:
    patch.setattr(SchedulerShell, "_close_translator", lambda self: None)


def keys_are_not_looked_at(patch: Patch) -> None:
    class Anyone(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            return True

        def __ne__(self, other: object) -> bool:
            return False

    patch.setattr(request_pipeline, "component_of", lambda name: Anyone(name))
    patch.setattr(scheduler_core, "component_of", lambda name: Anyone(name))


def unreadable_packets_pass(patch: Patch) -> None:
    real = SchedulerShell._of_translator

    def of_translator(self: SchedulerShell, event: PacketReceived | CaughtUp) -> list[Effect]:
        effects = real(self, event)
        if isinstance(event, PacketReceived) and not effects and event.packet.payload == GARBLED:
            return self._decide(PacketIn(event.packet, PacketHeader(event.packet.envelope)))
        return effects

    patch.setattr(SchedulerShell, "_of_translator", of_translator)


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


def answers_are_logged_twice(patch: Patch) -> None:
    real, before = EventLog.take, list[JournalEntry]()

    def take(self: EventLog, *args: Any) -> tuple[EventLog, JournalEntries]:
        log, taken = real(self, *args)
        twice = JournalEntries((*before, *taken.entries))
        before[:] = taken.entries[-1:]
        return log, twice

    patch.setattr(EventLog, "take", take)


def every_fiftieth_answer_is_not_logged(patch: Patch) -> None:
    real, count = EventLog.add_request, itertools.count(1)

    def add_request(self: EventLog, *args: Any) -> EventLog:
        return real(self, *args) if next(count) % 50 else self

    patch.setattr(EventLog, "add_request", add_request)


def changes_of_control_are_not_logged(patch: Patch) -> None:
    patch.setattr(control_change, "control_entries", lambda *args: [])


def entries_are_held_back(patch: Patch) -> None:
    patch.setattr(scheduler_core, "_entries_due_s", lambda state: None)


def entries_are_published_at_once(patch: Patch) -> None:
    patch.setattr(event_log, "PERIOD_S", 0.0)


def entries_backwards(patch: Patch) -> None:
    real = EventLog.take

    def take(self: EventLog, *args: Any) -> tuple[EventLog, JournalEntries]:
        log, taken = real(self, *args)
        return log, JournalEntries(taken.entries[::-1])

    patch.setattr(EventLog, "take", take)


def entries_are_not_kept_over_a_kill(patch: Patch) -> None:
    real = PacketCache.restore

    def restore(self: PacketCache, packets: Any, *args: Any) -> None:
        real(self, [entry for entry in packets if entry[0].envelope != "JournalEntries"], *args)

    patch.setattr(PacketCache, "restore", restore)


def starts_are_not_saved_before_they_are_sent(patch: Patch) -> None:
    patch.setattr(EventLog, "sending", lambda self, *args: self)


def the_tip_is_never_retracted(patch: Patch) -> None:
    patch.setattr(Watchdog, "_endangered", lambda self, microscope: self)


def danger_without_a_retract_is_never_logged(patch: Patch) -> None:
    patch.setattr(MicroscopeStatus, "telling", lambda self: (self, None))


def no_person_is_called_after_a_retract(patch: Patch) -> None:
    patch.setattr(Watchdog, "left_to_people", False)


def other_problems_are_solved_with_a_tip_that_is_away(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.REQUEST_CONTROL, _without(arbitration.SOLVES_OTHER_THAN_MALFUNCTION))


def the_end_does_not_wait_for_the_tip(patch: Patch) -> None:
    patch.setattr(ExperimentEnd, "is_due", lambda self, now_s, waits: self.by_s is not None)


def the_end_never_comes(patch: Patch) -> None:
    patch.setattr(ExperimentEnd, "is_due", lambda self, now_s, waits: False)


def limits_are_not_checked(patch: Patch) -> None:
    patch.setattr(LimitChecker, "check", lambda self, *args, **how: None)


def limits_are_decided_at_arrival(patch: Patch) -> None:
    """As before decision 0060: a queued request is sent as it was decided at its arrival."""
    real, decided = request_pipeline.enqueue, dict[str, MappedRequest | None]()

    def enqueue(draft: StateDraft, event: RequestIn) -> None:
        job = ForwardedRequest.of(event, command=not request_pipeline.reads(event.request))
        draft.frame, mapped = draft.frame.outgoing(job.client, job.request, draft.now_ns)
        if job.command and isinstance(mapped, MappedRequest | None):
            names = None if mapped is None else mapped.names
            sent = job.request if mapped is None else mapped.request
            refusal = draft.limits.check(job.client, sent, draft.now_ns, names) or draft.limits.check_place(job.request)
            if refusal is not None:
                answers.answer_unsent(draft, job, refusal)
                return
            decided[job.request.id] = mapped
        real(draft, event)

    def send(draft: StateDraft, job: ForwardedRequest) -> None:
        request_pipeline._send(draft, job, decided.get(job.request.id))

    patch.setattr(request_pipeline, "enqueue", enqueue)
    patch.setattr(request_pipeline, "_decide", send)


def forgotten_ids_are_new(patch: Patch) -> None:
    patch.setattr(Floors, "is_below", lambda self, client, request_id: False)


def every_component_has_every_role(patch: Patch) -> None:
    patch.setattr(arbitration, "may", lambda role, who: True)


def a_stop_by_hand_is_ignored(patch: Patch) -> None:
    patch.setattr(PanelState, "asks_for_pause", lambda self, act, **settings: False)


def a_withdrawn_tip_is_no_reason_to_wait(patch: Patch) -> None:
    patch.setattr(PanelState, "remedy", property(lambda self: ""))


def a_scan_is_stopped_when_a_person_acts(patch: Patch) -> None:
    patch.setattr(safety_commands, "leave_to_person", lambda draft: None)
    real = Watchdog.control_taken

    def control_taken(self: Watchdog, cause: Cause, *args: Any, **more: Any) -> Watchdog:
        return real(self, Cause.MANUAL if cause is Cause.BY_HAND else cause, *args, **more)

    patch.setattr(Watchdog, "control_taken", control_taken)


def a_tip_is_retracted_when_a_person_acts(patch: Patch) -> None:
    patch.setattr(safety_commands, "leave_to_person", lambda draft: None)
    real = Watchdog.control_taken

    def control_taken(self: Watchdog, cause: Cause, *args: Any, **more: Any) -> Watchdog:
        return real(self, Cause.DEAD if cause is Cause.BY_HAND else cause, *args, **more)

    patch.setattr(Watchdog, "control_taken", control_taken)


def what_waits_for_the_microscope_is_sent_to_a_person(patch: Patch) -> None:
    patch.setattr(Forwarder, "without_own_actions", lambda self: (self, False))


def a_holder_keeps_control_when_a_person_acts(patch: Patch) -> None:
    _rows(patch, ArbitrationEvent.BY_HAND, _not_doing(ControlChange.TAKE))


def values_outside_the_limits_are_measured_with(patch: Patch) -> None:
    patch.setattr(LimitChecker, "outside", lambda self, changed: "")


PANEL_MUTANTS = [
    a_stop_by_hand_is_ignored,
    a_withdrawn_tip_is_no_reason_to_wait,
    a_scan_is_stopped_when_a_person_acts,
    a_tip_is_retracted_when_a_person_acts,
    what_waits_for_the_microscope_is_sent_to_a_person,
    a_holder_keeps_control_when_a_person_acts,
    values_outside_the_limits_are_measured_with,
]
MUTANTS = [
    the_tip_is_never_retracted,
    danger_without_a_retract_is_never_logged,
    no_person_is_called_after_a_retract,
    other_problems_are_solved_with_a_tip_that_is_away,
    the_end_does_not_wait_for_the_tip,
    the_end_never_comes,
    limits_are_not_checked,
    limits_are_decided_at_arrival,
    forgotten_ids_are_new,
    every_component_has_every_role,
    answers_are_logged_twice,
    every_fiftieth_answer_is_not_logged,
    changes_of_control_are_not_logged,
    entries_are_held_back,
    entries_are_published_at_once,
    entries_backwards,
    entries_are_not_kept_over_a_kill,
    starts_are_not_saved_before_they_are_sent,
    flag_leaves_control,
    two_in_control,
    any_component_while_flagged,
    manual_lets_in,
    manual_leaves_control,
    solver_stays_when_solved,
    any_component_commands,
    the_dead_keep_control,
    no_lease,
    restarts_of_the_holder_are_not_counted,
    no_holder_is_ever_dead,
    an_impostor_is_let_in,
    ids_are_forgotten,
    nothing_expires,
    any_answer_will_do,
    a_former_holder_commands_on,
    published_before_saved,
    the_translator_is_closed_with_the_tip_in_danger,
    the_translator_is_never_closed,
    keys_are_not_looked_at,
    unreadable_packets_pass,
    times_go_back,
    doubles_of_the_translator_pass,
    replay_by_one_newest_time,
    replay_envelope_by_envelope,
]


_FURTHER_NIGHTS = 60
"""Nights after the chosen ones. A change of the code changes all nights, and it must not need new seeds each time."""


def _nights() -> None:
    # first the nights of `make test`: which mutants these find, `make test` finds; `make simulate` has the others
    in_danger = (ends_in_danger(seed, is_frozen=True) for seed in range(10, 30))
    for night in (*FINDERS, *in_danger, *map(bad_night, range(100, 100 + _FURTHER_NIGHTS))):
        Night(night).run()


def _scenarios() -> None:
    for rules, steps in SCENARIOS.values():
        ForbiddenBench(rules).run(steps)


def _panel_nights() -> None:
    for night in (*PANEL_NIGHTS, *map(panel_night, range(100, 100 + _FURTHER_NIGHTS))):
        Night(night).run()


def _drift_nights() -> None:
    # nights of a client that does not wait, and little else: a move takes the microscope's time
    for seed in range(2, 26, 4):
        night = replace(bad_night(seed), cast=("person", "burster", "adjuster"), hours=2.0, ends=True, faults=())
        DriftNight(night).run()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.__name__)
def test_a_broken_scheduler_is_found(mutant: Callable[[Patch], None], monkeypatch: Patch) -> None:
    mutant(monkeypatch)
    with pytest.raises((InvariantViolated, WireError)):
        _nights()


@pytest.mark.parametrize("mutant", PANEL_MUTANTS, ids=lambda mutant: mutant.__name__)
def test_a_scheduler_that_disturbs_a_person_is_found(mutant: Callable[[Patch], None], monkeypatch: Patch) -> None:
    mutant(monkeypatch)
    with pytest.raises(InvariantViolated):
        _panel_nights()


@pytest.mark.parametrize("mutant", FORBIDDEN_MUTANTS, ids=lambda mutant: mutant.__name__)
def test_a_broken_decision_about_forbidden_states_is_found(mutant: Callable[[Patch], None], monkeypatch: Patch) -> None:
    mutant(monkeypatch)
    with pytest.raises(InvariantViolated):
        _scenarios()


def test_limits_decided_at_arrival_are_found_in_sample_coordinates(monkeypatch: Patch) -> None:
    _drift_nights()
    limits_are_decided_at_arrival(monkeypatch)
    with pytest.raises(InvariantViolated):
        _drift_nights()


def test_actions_that_are_not_saved_are_found_in_sample_coordinates(monkeypatch: Patch) -> None:
    """Where the sample moves, a repeated action is sent to another place: to a translator it is a new one."""

    def nights() -> None:
        for seed in (0, 6):
            DriftNight(bad_night(seed)).run()

    nights()
    sent_actions_are_not_saved(monkeypatch)
    with pytest.raises(InvariantViolated):
        nights()
