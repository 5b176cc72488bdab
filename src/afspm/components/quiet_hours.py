"""`QuietHours`: a pause of the experiment between two times of the day."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from contextlib import suppress
from typing import ClassVar, Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from afspm.basics import ControlLost
from afspm.basics.errors import ConfigError, NoResponse, Refused
from afspm.client.component import Component
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    JournalEntries,
    JournalEntry,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.model.events import NO_LONGER_TRUE
from afspm.model.problems import QUIET_HOURS

WORKS, WAITS, PAUSES, PAUSED, RETURNS, LEFT = "works", "waits", "pauses", "paused", "returns", "left to a person"
_ASKS_FOR_S = 2.0  # real time; then other packets are handled before it asks again
_PUBLISHED_WITHIN_S = 10.0  # for the state that follows from what it asked
_ACCEPTED_WITHIN_S = 30.0  # for an action of the microscope to begin
_MOVED_WITHIN_S = 600.0  # real time: an approach may take minutes
_SET_BACK_WITHIN_S = 60.0
_SETTLED_TICKS = 3
SCHEDULER = "scheduler"
_ALARM = "the quiet hours are over, and the run waits for a person"
_COMMANDS = frozenset(
    {
        ControlRequest.ACTION,
        ControlRequest.SET_SCAN_PARAMS,
        ControlRequest.SET_ZCTRL_PARAMS,
        ControlRequest.SET_PROBE_POS,
        ControlRequest.SET_CONTROL_MODE,
    }
)


class QuietHours(Component):
    """A component that pauses the experiment between two times of the day, such as from 22:00 to 7:00.

    At the begin a running scan or curve is finished, and so is the repair of a problem. Then the component flags
    `quiet-hours`, which takes control from all others, waits until the settings of measurements are set back, withdraws
    the tip if it should, and sets MANUAL. A measurement
    that another component starts in just this moment is stopped, and repeated after the pause.

    At the end the component sets AUTOMATED, brings the tip back, and clears the flag: the others go on. It does so only
    if no person has commanded or paused the microscope since the pause began, also not at its panel, and if
    `afspm continue` would be accepted. Otherwise the mode stays MANUAL, with a CRITICAL line that says why, until a
    person lets the run continue.

    A person may continue at any time: the run then goes on until the hours begin the next time. A run that is started
    within the hours pauses at once.

    Args:
        begin, end: local times, such as "22:00" and "07:00", of the same day or over midnight.
        zone: time zone, such as "Europe/Vienna"; by default the zone of this computer. The hours follow summer time.
        withdraw: whether to withdraw the tip for the pause; the microscope must be able to bring it back (`x-engage`).
    """

    solves: ClassVar = (QUIET_HOURS,)
    flags: ClassVar = (QUIET_HOURS,)
    listens: ClassVar = ("ControlState", "ScopeStateMsg", "JournalEntries")
    period_s = 1.0
    period_time: Literal["experiment", "real"] = "real"

    def __init__(self, begin: str, end: str, zone: str = "", withdraw: bool = False) -> None:
        self.hours = DailyHours(_time(begin, "begin"), _time(end, "end"), _zone(zone))
        if self.hours.begin == self.hours.end:
            raise ConfigError(f"{begin} to {end} leaves no time for the experiment", where="end")
        self.withdraw = withdraw
        self.needs_actions = (names.RETRACT, names.ENGAGE) if withdraw else ()

    def on_start(self) -> None:
        self.memory.setdefault("phase", WORKS)
        self.memory.setdefault("since_ns", 0)
        self._ticks = self._over = 0

    def on_tick(self) -> None:
        self._ticks += 1
        self._over = 0 if self._end() else self._over + 1
        tip = self.scope.tip
        if self.memory["phase"] == PAUSED and self.memory.get("withdrawn") and tip is not None and tip.engaged is True:
            self._touched("the tip was brought back", tip=True)
        self._act()

    def on_state(self, status: ScopeStatus) -> None:
        is_busy = status.state not in (ScopeState.FREE, ScopeState.UNDEFINED)
        time_ns = None if self.packet is None else self.packet.time_ns
        if is_busy and self._is_away and time_ns is not None and time_ns > self.memory.get("still_ns", 0):
            self._touched(f"the microscope was busy ({status.state.name})", tip=True)
        elif not is_busy:  # between two scans, which a tick would seldom meet
            self._act()

    def on_control(self, control_state: ControlState) -> None:
        is_manual = self._is_manual  # the newest: an older state must not look like a change
        was_manual = self.memory.get("was_manual", False)
        if is_manual is not was_manual:
            self._note(was_manual=is_manual)
        if was_manual and not is_manual:
            end = self._end()
            if end is not None:
                self._let_go(end, "a person lets the run continue")
            if self.memory["phase"] != WORKS:
                self._note(phase=RETURNS)
        self._act()

    def on_journal_entries(self, entries: JournalEntries) -> None:
        for entry in entries.entries if self._is_away else ():
            if (entry.sent_ns or entry.time_ns) > self.memory["since_ns"] and is_act(entry, self.name):
                is_of_tip = entry.event is ControlEvent.BY_HAND or entry.request == ControlRequest.ACTION
                self._touched(f"{entry.who}: {entry.what}", tip=is_of_tip)

    def _touched(self, how: str, *, tip: bool) -> None:
        first = self.memory.get("touched") or how
        self._note(touched=first, tip_touched=self.memory.get("tip_touched", False) or tip)

    # --- decisions

    def _act(self) -> None:
        end, is_manual = self._end(), self._is_manual
        is_due = end is not None and end.timestamp() > self.memory.get("not_before_s", 0.0)
        phase = self.memory["phase"]
        if phase == PAUSES:  # this process was killed in between
            self._note(phase=PAUSED if is_manual else WAITS, held=is_manual)
        elif phase == PAUSED and is_manual and self.memory.get("held") and not self._is_flagged():
            if not self.memory.get("touched"):
                self._touched("a person cleared quiet-hours", tip=True)
        elif phase in (PAUSED, LEFT) and not is_manual and (self.memory.get("held") or not self._is_flagged()):
            self._note(phase=RETURNS)  # a person let the run continue while this process was away, or cleared the flag
        elif phase == WORKS and is_due and not is_manual and self._is_free:
            self._note(phase=WAITS)
            self.scope.flag(QUIET_HOURS)
            self.scope.wait_until(self._is_flagged, timeout_s=_PUBLISHED_WITHIN_S)
        elif phase == RETURNS and is_due and not is_manual:  # it could not get control for all the day
            self._note(phase=WAITS)
        if self.memory["phase"] == WAITS:
            if is_due and end is not None and not is_manual and self._is_free:
                self._pause(end)
            elif not is_due and is_manual:
                self._leave("a person paused it")
            elif not is_due:
                self._note(phase=RETURNS)
        # a tick later every act from within the hours is in the journal, and what was kept for a new process is handled
        is_over = end is None and min(self._over, self._ticks) >= _SETTLED_TICKS
        if self.memory["phase"] == PAUSED and is_over:
            self._go_on()
        if self.memory["phase"] == RETURNS and not self._is_manual and self._is_free:
            self._return()

    def _pause(self, end: dt.datetime) -> None:
        def withdraw() -> str:
            # answered after a start that was on its way, and after the scheduler's stop of it
            self.scope.supports(names.STOP_SCAN)
            if not self.scope.wait_until(lambda: self._is_free, timeout_s=_PUBLISHED_WITHIN_S):
                raise ControlLost("the microscope is not free yet", where=self.name)
            with suppress(NoResponse):  # what stays in force is in the log, as MANUAL begins
                self.scope.set_back(timeout_s=_SET_BACK_WITHIN_S)
            self._note(since_ns=self.clock.now_ns(), touched="", tip_touched=False)
            why = self._withdraw()
            if not self.scope.in_control:
                raise ControlLost("control was lost before the pause", where=self.name)
            self._note(phase=PAUSES, still_ns=self.clock.now_ns(), touched=why, tip_touched=bool(why))
            return self._set_mode(ControlMode.MANUAL)

        refused = self._in_control(withdraw)
        if refused is None:
            if not self._is_flagged() and self.memory["phase"] == WAITS:
                self._let_go(end, "a person cleared quiet-hours")
                self._note(phase=RETURNS)
            return
        if refused:
            self.log.error("the mode stays AUTOMATED, and the flag alone keeps all from measuring: %s", refused)
        self._over = 0
        self._note(phase=PAUSED, was_manual=self._is_manual, held=not refused)
        how = " with the tip withdrawn" if self.memory.get("withdrawn") else ""
        self.log.info("paused%s until %s; `afspm continue` lets the run go on before", how, _clock_time(end))

    def _withdraw(self) -> str:
        # returns why the tip could not be withdrawn
        if not self.withdraw or ((tip := self.scope.tip) is not None and tip.engaged is False):
            return ""
        self._note(withdrawn=True)  # before, since after a kill it may be so
        if why := self._move(names.RETRACT):
            why = f"the tip could not be withdrawn for the pause: {why}"
            self.log.critical("%s (%s)", why, self._date())
        return why

    def _go_on(self) -> None:
        why = self.memory.get("touched", "")
        if not why:
            if not self._is_flagged():  # else others would measure before the tip is back
                self.scope.flag(QUIET_HOURS)
                self.scope.wait_until(self._is_flagged, timeout_s=_PUBLISHED_WITHIN_S)
            why = self._set_mode(ControlMode.AUTOMATED) if self._is_manual else ""
        if why:
            self._leave(why)
        else:
            self._note(phase=RETURNS, was_manual=False)

    def _return(self) -> None:
        if self._is_flagged():
            why = self._in_control(self._bring_back)
            if why is None:
                return
            if why:
                self._set_mode(ControlMode.MANUAL)
                self._leave(why)
                return
        elif self.memory.get("withdrawn") and not self._is_back_by_hand:
            self.scope.flag(QUIET_HOURS)  # and at the next tick the tip is brought back
            return
        if self.memory.get("alarmed"):
            self.log.info("%s%s", NO_LONGER_TRUE, _ALARM)
        self._note(phase=WORKS, alarmed=False, withdrawn=False, touched="", tip_touched=False)
        self.log.info("the run goes on")

    def _bring_back(self) -> str:
        # returns why the tip could not be brought back
        if self.memory.get("withdrawn"):
            tip = self.scope.tip
            is_engaged = None if tip is None else tip.engaged
            if is_engaged is None and self.memory.get("tip_touched"):
                return (
                    "the microscope does not report its tip, which was moved by hand: bring it to the sample,"
                    " and clear quiet-hours"
                )
            if is_engaged is not True and (why := self._move(names.ENGAGE)):
                return f"the tip could not be brought back: {why}"
            self._note(withdrawn=False)
        self.scope.clear(QUIET_HOURS)
        return ""

    def _leave(self, why: str) -> None:
        self._note(phase=LEFT, alarmed=True, was_manual=self._is_manual, held=self._is_manual)
        # with the date, since people are called once for each text
        self.log.critical("%s: %s (%s); `afspm continue` lets it go on", _ALARM, why, self._date())

    def _let_go(self, end: dt.datetime, who: str) -> None:
        self._note(not_before_s=end.timestamp())
        self.log.info("%s in the quiet hours: it goes on, also after %s", who, _clock_time(end))

    def _in_control(self, do: Callable[[], str]) -> str | None:
        # returns what `do` returns; None: control was not given, or lost, and it is tried again
        found: str | None = None
        try:
            with self.scope.control(solving=QUIET_HOURS, timeout_s=_ASKS_FOR_S, unbroken=True):
                found = do()
        except (ControlLost, NoResponse, Refused) as error:
            self.log.debug("waiting for control: %s", error.what)
        return found

    def _set_mode(self, mode: ControlMode) -> str:
        # returns why it was refused
        try:
            self.scope.set_mode(mode)
        except Refused as refused:
            return refused.reason
        self.scope.wait_until(lambda: self.scope.mode is mode, timeout_s=_PUBLISHED_WITHIN_S)
        return ""

    def _move(self, action: str) -> str:
        # returns why the action was not carried out
        with self.scope.events("ScopeStateMsg", timeout_s=_MOVED_WITHIN_S) as states:
            try:
                self.scope.action(action, timeout_s=_ACCEPTED_WITHIN_S)
            except (Refused, NoResponse) as error:
                return error.what
            has_begun = False
            for event in states:
                state = event.message.state
                if has_begun and state is ScopeState.FREE:
                    return self._where_it_should_be(action)
                if has_begun and state in (ScopeState.INTERRUPTED, ScopeState.UNDEFINED):
                    return f"{action} was broken off"
                has_begun = has_begun or state in (ScopeState.COARSE_MOTOR, ScopeState.MOVING, ScopeState.BUSY_PARAM)
        return f"{action} did not end within {_MOVED_WITHIN_S:g} s"

    def _where_it_should_be(self, action: str) -> str:
        # the tip is published some readings after the state; a controller that does not report it is believed
        wrong = action == names.RETRACT

        def is_there() -> bool:
            tip = self.scope.tip
            return tip is None or tip.engaged is not wrong

        if self.scope.wait_until(is_there, timeout_s=_PUBLISHED_WITHIN_S):
            return ""
        return f"the microscope reports that the tip is {'at the sample' if wrong else 'withdrawn'} after {action}"

    # --- knowledge

    def _end(self) -> dt.datetime | None:
        return self.hours.end_after(dt.datetime.fromtimestamp(self.clock.now_s(), dt.UTC))

    def _date(self) -> str:
        return dt.datetime.fromtimestamp(self.clock.now_s(), dt.UTC).astimezone(self.hours.zone).date().isoformat()

    def _note(self, **known: object) -> None:
        self.memory.update(known)
        self.memory.save()

    def _is_flagged(self) -> bool:
        return self.scope.is_flagged(QUIET_HOURS)

    @property
    def _is_away(self) -> bool:
        return self.memory["phase"] in (PAUSES, PAUSED, RETURNS, LEFT)

    @property
    def _is_manual(self) -> bool:
        return self.scope.control_state.mode is ControlMode.MANUAL

    @property
    def _is_free(self) -> bool:
        return self.scope.state is ScopeState.FREE

    @property
    def _is_back_by_hand(self) -> bool:
        # the flag was cleared: where the microscope does not report its tip, a person's word for it
        tip = self.scope.tip
        return bool(self.memory.get("tip_touched")) if tip is None or tip.engaged is None else tip.engaged


class DailyHours:
    """The time between two local times, of each day.

    Args:
        zone: None: the zone of this computer.
    """

    def __init__(self, begin: dt.time, end: dt.time, zone: dt.tzinfo | None) -> None:
        self.begin, self.end, self.zone = begin, end, zone

    def end_after(self, now: dt.datetime) -> dt.datetime | None:
        """Return the local end of the hours that `now` is in; None: it is in none."""
        today = now.astimezone(self.zone).date()
        for day in (today - dt.timedelta(days=1), today):
            last = day if self.begin < self.end else day + dt.timedelta(days=1)
            begins, ends = self._local(day, self.begin), self._local(last, self.end)
            # compared as instants: of a night in which the clocks change, local times may come twice or never
            if begins.timestamp() <= now.timestamp() < ends.timestamp():
                return ends
        return None

    def _local(self, day: dt.date, time: dt.time) -> dt.datetime:
        naive = dt.datetime.combine(day, time)
        return naive.astimezone() if self.zone is None else naive.replace(tzinfo=self.zone)


def _time(text: str, where: str) -> dt.time:
    try:
        if len(text) != len("22:00"):
            raise ValueError
        return dt.time.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"{text!r} is not a time of the day", where=where, hint='as in "22:00"') from None


def _zone(name: str) -> dt.tzinfo | None:
    if not name:
        return None
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        hint = 'as in "Europe/Vienna"; Windows needs the package tzdata for it'
        raise ConfigError(f"there is no time zone {name!r}", where="zone", hint=hint) from None


def _clock_time(time: dt.datetime) -> str:
    return time.strftime("%H:%M on %A")


def is_act(entry: JournalEntry, me: str) -> bool:
    """Return whether an entry is an act at the microscope, or a command or change of mode by another than `me`.

    A command without an answer counts, since it may have been carried out; a stop by the scheduler does not.
    """
    if entry.event is ControlEvent.BY_HAND:
        return True
    if entry.who == me or entry.response not in (ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE):
        return False
    if entry.who == SCHEDULER:
        return entry.subject == names.RETRACT
    sets = entry.request == ControlRequest.PARAM and bool(entry.subject)
    return sets or entry.request in _COMMANDS
