"""`Notifier`: the component that notifies people during the experiment; in every experiment with [notify].

Notifications come from a component and not from a thread of the supervisor: a failure there would end the experiment,
while a component is restarted, and keeps undelivered notifications on disk.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal

from afspm.basics.errors import ConfigError
from afspm.basics.formatting import duration_text
from afspm.basics.plain_data import Plain
from afspm.basics.units import Duration, PositiveDuration
from afspm.client.component import Component
from afspm.components import notifications
from afspm.components.notifications import (
    BY_HAND,
    CRITICAL,
    GIVEN_UP,
    MOST_TRIES,
    MOST_WAITING,
    OCCASIONS,
    SOLVED,
    UNSOLVED,
    USUAL,
    NotDelivered,
    Notification,
    Targets,
)
from afspm.model import ControlMode, ControlState, JournalEntries, ProcessCondition, ProcessStates
from afspm.model.events import LOGGED_AS, LogLines
from afspm.model.problems import QUIET_HOURS
from afspm.record.run_json import experiment_name

MOST_TOLD = 1000
"""Limit on the remembered notifications: a component that logs ever new texts must not fill the memory."""
LAST_TRIES = 2  # the end of the experiment does not wait for more


class Notifier(Component):
    """Notifications by command or webhook, of problems, failures and a run that waits; and pings while the run goes on.

    [notify] of the experiment file adds this component to an experiment. The component only subscribes, and delays no
    other process. A failed delivery is retried at growing intervals, for about 25 minutes; retries continue after a
    restart. A notification may arrive twice if the answer of the webhook is lost, or if this process is killed right
    after the delivery. The end of the experiment is reported by `afspm run` itself, which knows the reason of the end.

    Args:
        program: a command with arguments, which [notify] calls `command`. It is run in the experiment file's folder;
            the JSON is on its standard input.
        webhook: address for a POST of the JSON; "$NAME" is taken from the environment.
        on: occasions: "unsolved-problem", "given-up", "critical", "by-hand" (the run waits for a person at the panel);
            by default these. "solved": a problem that counted as unsolved is solved. ("end" is left to `afspm run`.)
        unsolved_after: experiment time after which a flagged problem counts as unsolved.
        folder: working directory of the command; [notify] sets it to the experiment file's folder.
        ping: address for a bare GET request at regular times, so that silence is noticed elsewhere; "$NAME" is taken
            from the environment.
        every: real time between two pings.
    """

    listens: ClassVar = ("ControlState", "JournalEntries", "ProcessStates", "LogLines")
    notifies: ClassVar[bool] = True
    period_s = 1.0
    period_time: Literal["experiment", "real"] = "real"

    def __init__(
        self,
        program: list[str] | None = None,
        webhook: str = "",
        on: list[str] | None = None,
        unsolved_after: Duration = 900.0,
        folder: str = "",
        ping: str = "",
        every: PositiveDuration = 300.0,
    ) -> None:
        self.targets = Targets(tuple(program or ()), webhook, folder)
        self.on = tuple(USUAL if on is None else on)
        self.unsolved_after = unsolved_after
        self.ping, self.every = ping, every
        if not self.targets.ways and not ping:
            hint = "it needs a `command`, a `webhook` or a `ping`"
            raise ConfigError("there is no recipient", where="[notify]", hint=hint)
        if unknown := [one for one in self.on if one not in OCCASIONS]:
            raise ConfigError(f"[notify] on: {unknown[0]!r} never happens", hint=f"known: {', '.join(OCCASIONS)}")

    def on_start(self) -> None:
        self.memory.setdefault("flagged", {})
        self.memory.setdefault("told", [])
        self.memory.setdefault("waiting", [])
        self._due_s: dict[str, float] = {}
        self._ping_due_s, self._is_silent = self.clock.monotonic_s(), False
        try:
            if self.ping:
                notifications.address(self.ping, key="ping")
        except ConfigError as error:  # notifications go on without pings
            self.log.error("no pings are sent: %s", error)
            self.ping = ""
        try:
            if self.targets.webhook:
                notifications.address(self.targets.webhook)  # a wrong address fails at the start, not in the night
        except ConfigError as error:
            if not self.targets.command:
                raise
            self.log.error("only the command is called: %s", error)
            self.targets = replace(self.targets, webhook="")

    def on_control(self, control_state: ControlState) -> None:
        since_ns = self.packet.time_ns if self.packet and self.packet.time_ns is not None else self.clock.now_ns()
        before: dict[str, int] = self.memory["flagged"]
        quiet = self.scope.problems.get(QUIET_HOURS)  # no problem to anyone
        flagged = {str(number) for number in control_state.problems if number != quiet}
        for number in before.keys() - flagged:
            lasted_ns = since_ns - before[number]
            if lasted_ns >= self.unsolved_after * 1e9:
                text = f"{self.scope.problems.name(int(number))} is solved, after {duration_text(lasted_ns * 1e-9)}"
                self._queue_once(SOLVED, f"{number} {before[number]}", text)
        now = {number: before.get(number, since_ns) for number in flagged}
        if now != before:
            self.memory["flagged"] = now
            self.memory.save()

    def on_journal_entries(self, entries: JournalEntries) -> None:
        for entry in entries.entries:
            if entry.mode is ControlMode.MANUAL and entry.reason:
                self._queue_once(BY_HAND, str(entry.time_ns), f"the run waits for a person: {entry.reason}")

    def on_process_states(self, states: ProcessStates) -> None:
        for state in states.processes:
            if state.condition is ProcessCondition.GIVEN_UP:
                how = f": {state.last_exit}" if state.last_exit else ""
                self._queue_once(GIVEN_UP, f"{state.name} {state.starts}", f"{state.name} is given up{how}")

    def on_log_lines(self, lines: LogLines) -> None:
        first: dict[str, str] = {}  # first CRITICAL line of each process; later ones belong to it
        for line in lines.lines:
            if line.level == "CRITICAL" and line.name not in (LOGGED_AS, self.name):
                first.setdefault(line.name, line.text)
        for name, text in first.items():
            self._queue_once(CRITICAL, f"{name} {text}", f"{name}: {text}")

    def on_tick(self) -> None:
        now_ns = self.clock.now_ns()
        for number, since_ns in self.memory["flagged"].items():
            if now_ns - since_ns >= self.unsolved_after * 1e9:
                name, since = self.scope.problems.name(int(number)), duration_text((now_ns - since_ns) * 1e-9)
                text = f"{name} has been flagged for {since}, and is not solved"
                self._queue_once(UNSOLVED, f"{number} {since_ns}", text)
        self._deliver_what_is_due()
        if self.ping and self.clock.monotonic_s() >= self._ping_due_s:
            self._send_ping()

    def _send_ping(self) -> None:
        # not kept over a restart, and not repeated: the next one follows soon enough
        try:
            notifications.ping(notifications.address(self.ping, key="ping"))
        except (NotDelivered, ConfigError) as error:
            if not self._is_silent:
                self.log.warning("a ping failed; later failures are not logged: %s", error)
            self._is_silent = True
        else:
            if self._is_silent:
                self.log.info("pings arrive again")
            self._is_silent = False
        self._ping_due_s = self.clock.monotonic_s() + self.every

    def on_end(self) -> None:
        for waiting in self.memory["waiting"][-LAST_TRIES:]:
            self._try(waiting)

    def _queue_once(self, what: str, which: str, text: str) -> None:
        key = f"{what} {which}"
        if what not in self.on or key in self.memory["told"]:
            return
        self.log.warning("%s", text)
        run = Path(self.run_dir)
        notice = Notification(what, experiment_name(run, run.name), str(run), self.clock.now_ns(), text, self.simulated)
        new = [{"notice": dict(vars(notice)), "way": way, "tries": 0} for way in self.targets.ways]
        self.memory["waiting"] = [*self.memory["waiting"], *new][-MOST_WAITING:]
        self.memory["told"] = [*self.memory["told"], key][-MOST_TOLD:]
        self.memory.save()

    def _deliver_what_is_due(self) -> None:
        for waiting in tuple(self.memory["waiting"]):
            if self.clock.monotonic_s() >= self._due_s.get(_key(waiting), 0.0):
                self._try(waiting)
                return  # one a tick: packets are processed in between

    def _try(self, waiting: Plain) -> None:
        key, way = _key(waiting), waiting["way"]
        try:
            self.targets.deliver(Notification(**waiting["notice"]), way)
        except (NotDelivered, ConfigError) as error:
            waiting["tries"] += 1
            self._due_s[key] = self.clock.monotonic_s() + notifications.delay_s(waiting["tries"])
            if waiting["tries"] < MOST_TRIES:
                self.log.info("the %s failed; retrying: %s", way, error)
                self.memory.save()
                return
            self.log.error("gave up a notification: %s", error)
        self.memory["waiting"] = [one for one in self.memory["waiting"] if _key(one) != key]
        self.memory.save()
        self._due_s.pop(key, None)


def _key(waiting: Plain) -> str:
    notice = waiting["notice"]
    return f"{waiting['way']} {notice['what']} {notice['time_ns']} {notice['text']}"
