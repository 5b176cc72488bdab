"""`QuietHours`: a pause of the experiment between two times of the day."""

from __future__ import annotations

import datetime as dt
from typing import ClassVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from afspm.basics.errors import ConfigError, ControlLost, NoResponse, Refused
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
_PUBLISHED_WITHIN_S = 10.0
_MOVED_WITHIN_S = 600.0  # real time: an approach may take minutes
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
    `quiet-hours`, which takes control from all others, withdraws the tip if it should, and sets MANUAL. A measurement
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
    period_s = 5.0

    def __init__(self, begin: str, end: str, zone: str = "", withdraw: bool = False) -> None:
        self.hours = DailyHours(_time(begin, "begin"), _time(end, "end"), _zone(zone))
        if self.hours.begin == self.hours.end:
            raise ConfigError(f"{begin} to {end} leaves no time for the experiment", where="end")
        self.withdraw = withdraw
        self.needs_actions = (names.RETRACT, names.ENGAGE) if withdraw else ()

    def on_start(self) -> None:
        self.memory.setdefault("phase", WORKS)

    def on_state(self, status: ScopeStatus) -> None:
        if status.state is ScopeState.FREE:  # between two scans, which a tick would seldom meet
            self._act()

    def on_tick(self) -> None:
        self._act()

    def on_control(self, control_state: ControlState) -> None:
        is_manual = self._is_manual  # the newest: an older state must not look like a change
        was_manual = self.memory.get("was_manual", False)
        if is_manual is not was_manual:
            self._note(was_manual=is_manual)
        if was_manual and not is_manual and self.memory["phase"] != RETURNS:
            end = self._end()
            if end is not None:
                self._let_go(end, "a person lets the run continue")
            if self.memory["phase"] != WORKS:
                self._note(phase=RETURNS)
        self._act()

    def on_journal_entries(self, entries: JournalEntries) -> None:
        if self.memory["phase"] not in (PAUSED, LEFT) or self.memory.get("touched"):
            return
        for entry in entries.entries:
            if entry.time_ns > self.memory["paused_ns"] and is_act(entry, self.name):
                self._note(touched=f"{entry.who}: {entry.what}")
                return

    # --- decisions

    def _act(self) -> None:
        end, is_manual = self._end(), self._is_manual
        is_due = end is not None and end.timestamp() > self.memory.get("not_before_s", 0.0)
        if self.memory["phase"] == PAUSES:  # this process was killed in between
            self._note(phase=PAUSED if is_manual else WAITS)
        if self.memory["phase"] == WORKS and is_due and not is_manual and self._is_free:
            self._note(phase=WAITS)
            self.scope.flag(QUIET_HOURS)
            self.scope.wait_until(self._is_flagged, timeout_s=_PUBLISHED_WITHIN_S)
        if self.memory["phase"] == WAITS and not is_due:
            self._note(phase=RETURNS)
        if self.memory["phase"] == WAITS and end is not None and not is_manual and self._is_free:
            self._pause(end)
        elif self.memory["phase"] == PAUSED and end is None:
            self._go_on()
        if self.memory["phase"] == RETURNS and not self._is_manual and self._is_tip_back():
            self.scope.clear(QUIET_HOURS)
            if self.memory.get("alarmed"):
                self.log.info("%s%s", NO_LONGER_TRUE, _ALARM)
            self._note(phase=WORKS, alarmed=False, withdrawn=False)
            self.log.info("the run goes on")

    def _pause(self, end: dt.datetime) -> None:
        try:
            with self.scope.control(solving=QUIET_HOURS, timeout_s=_ASKS_FOR_S):
                not_withdrawn = self._withdraw()
                self._note(phase=PAUSES, paused_ns=self.clock.now_ns(), touched=not_withdrawn)
                if why := self._set_mode(ControlMode.MANUAL):
                    self.log.error("the mode stays AUTOMATED, and the flag alone keeps all from measuring: %s", why)
        except ControlLost as lost:
            if self._is_flagged():
                self.log.debug("waiting for control: %s", lost.what)
                return
            self._let_go(end, "a person cleared quiet-hours")
            self._note(phase=RETURNS)
            return
        self._note(phase=PAUSED, was_manual=self._is_manual)
        how = " with the tip withdrawn" if self.memory.get("withdrawn") else ""
        self.log.info("paused%s until %s; `afspm continue` lets the run go on before", how, _clock_time(end))

    def _withdraw(self) -> str:
        # returns why the tip could not be withdrawn
        if not self.withdraw or ((tip := self.scope.tip) is not None and tip.engaged is False):
            return ""
        self._note(withdrawn=True)  # before, since after a kill it may be so
        try:
            self._move(names.RETRACT)
        except (Refused, NoResponse) as error:
            self.log.critical("the tip could not be withdrawn for the pause: %s", error.what)
            return f"the tip could not be withdrawn for the pause: {error.what}"
        return ""

    def _go_on(self) -> None:
        why = self.memory.get("touched", "")
        if not why:
            if not self._is_flagged():  # else others would measure before the tip is back
                self.scope.flag(QUIET_HOURS)
            why = self._set_mode(ControlMode.AUTOMATED)
        if why:
            self._leave(why)
        else:
            self._note(phase=RETURNS, was_manual=False)

    def _is_tip_back(self) -> bool:
        if not self.memory.get("withdrawn"):
            return True
        try:
            if not self._is_flagged():
                self.scope.flag(QUIET_HOURS)
                self.scope.wait_until(self._is_flagged, timeout_s=_PUBLISHED_WITHIN_S)
            with self.scope.control(solving=QUIET_HOURS, timeout_s=_ASKS_FOR_S):
                if self._is_to_engage:
                    self._move(names.ENGAGE)
                    if (tip := self.scope.tip) is not None and tip.engaged is False:
                        raise NoResponse("the microscope says that the tip is still withdrawn", where=self.name)
        except ControlLost as lost:
            self.log.debug("waiting for control: %s", lost.what)
            return False
        except (Refused, NoResponse) as error:
            self._set_mode(ControlMode.MANUAL)
            self._leave(f"the tip could not be brought back: {error.what}")
            return False
        return True

    def _leave(self, why: str) -> None:
        self._note(phase=LEFT, alarmed=True, was_manual=self._is_manual)
        self.log.critical("%s: %s; `afspm continue` lets it go on", _ALARM, why)

    def _let_go(self, end: dt.datetime, who: str) -> None:
        self._note(not_before_s=end.timestamp())
        self.log.info("%s in the quiet hours: it goes on, also after %s", who, _clock_time(end))

    def _set_mode(self, mode: ControlMode) -> str:
        # returns why it was refused
        try:
            self.scope.set_mode(mode)
        except Refused as refused:
            return refused.reason
        self.scope.wait_until(lambda: self.scope.mode is mode, timeout_s=_PUBLISHED_WITHIN_S)
        return ""

    def _move(self, action: str) -> None:
        with self.scope.events("ScopeStateMsg", timeout_s=_MOVED_WITHIN_S) as states:
            self.scope.action(action)
            was_busy = False
            for event in states:
                if event.message.state is ScopeState.FREE and was_busy:
                    return
                was_busy = was_busy or event.message.state is not ScopeState.FREE
        raise NoResponse(f"{action} did not end within {_MOVED_WITHIN_S:g} s", where=self.name)

    # --- knowledge

    def _end(self) -> dt.datetime | None:
        return self.hours.end_after(dt.datetime.fromtimestamp(self.clock.now_s(), dt.UTC))

    def _note(self, **known: object) -> None:
        self.memory.update(known)
        self.memory.save()

    def _is_flagged(self) -> bool:
        return self.scope.is_flagged(QUIET_HOURS)

    @property
    def _is_manual(self) -> bool:
        return self.scope.control_state.mode is ControlMode.MANUAL

    @property
    def _is_free(self) -> bool:
        return self.scope.state is ScopeState.FREE

    @property
    def _is_to_engage(self) -> bool:
        if not self.memory.get("withdrawn"):
            return False
        tip = self.scope.tip
        if tip is None or tip.engaged is None:  # a person who used the microscope has looked at the tip
            return not self.memory.get("touched")
        return not tip.engaged


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
    """Return whether an entry is an act at the microscope, or a command or change of mode by another than `me`."""
    if entry.event is ControlEvent.BY_HAND:
        return True
    if entry.who == me or entry.response != ControlResponse.SUCCESS:
        return False
    sets = entry.request == ControlRequest.PARAM and bool(entry.subject)
    return sets or entry.request in _COMMANDS
