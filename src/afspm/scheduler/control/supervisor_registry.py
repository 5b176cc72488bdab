"""The registry of supervisors: their processes, and the open restart orders of each supervisor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm import wire
from afspm.basics.formatting import duration_text
from afspm.basics.frozen import replace
from afspm.model import (
    Note,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    Proposal,
    RelayedMessage,
    component_of,
)
from afspm.model.events import (
    LONGEST_ANNOUNCEMENT,
    LONGEST_PROCESS_NAME,
    PERSON,
    SUPERVISOR,
    LogLines,
    MeasurementSettings,
    is_process_name,
)
from afspm.scheduler.events import Codec, RequestIn
from afspm.scheduler.saved_state import SavedSupervisor

SILENT_S = 10.0
"""A supervisor without a report for this time, real, gets no more orders: the orders would be lost."""
CLOCKS_DIFFER_S = 5.0
"""Difference between a supervisor's clock and the scheduler's, real, above which a warning is logged."""
_STEADY_S = 1.0  # a larger change of the difference between two reports is the delay of one
_MOST = 64  # supervisors: names come from peers, and memory must stay bounded
OVER = (ProcessCondition.ENDED, ProcessCondition.GIVEN_UP)
"""Conditions of a process that has ended for good."""


@dataclass(frozen=True)
class KnownSupervisor:
    """A supervisor with its last report and its open orders.

    Attributes:
        processes: the names of the processes in its last report.
        reported_s: real time of its last report; None: no report since a restart of the scheduler.
        orders: processes that the supervisor has to restart.
        over: for each process that has ended for good, its number of starts and the real time at which its end was
            first reported.
        states: the states of its processes in its last report.
        clock: the time of its last report by its own clock, and the lead of this time over the scheduler's clock at the
            arrival, both ns of experiment time.
        warned: whether a difference of the clocks was logged.
    """

    processes: tuple[str, ...] = ()
    reported_s: float | None = None
    orders: tuple[str, ...] = ()
    over: Mapping[str, tuple[int, float]] = field(default_factory=dict)
    states: tuple[ProcessState, ...] = ()
    clock: tuple[int, int] | None = None
    warned: bool = False


@dataclass(frozen=True)
class SupervisorRegistry:
    """The supervisors by name, in the order of their last reports; the newest is last."""

    supervisors: Mapping[str, KnownSupervisor] = field(default_factory=dict)

    def saved(self) -> dict[str, SavedSupervisor]:
        return {
            name: SavedSupervisor(
                report.processes, report.orders, {process: starts for process, (starts, _) in report.over.items()}
            )
            for name, report in self.supervisors.items()
        }

    @classmethod
    def restored(cls, saved: Mapping[str, SavedSupervisor]) -> SupervisorRegistry:
        """Return the registry from `saved`; the times at which processes ended are lost (-inf)."""
        return cls(
            {
                name: KnownSupervisor(
                    report.processes,
                    None,
                    report.orders,
                    {process: (starts, -math.inf) for process, starts in report.over.items()},
                )
                for name, report in saved.items()
            }
        )

    def states_of(self, supervisor: str) -> tuple[ProcessState, ...]:
        """Return the states of a supervisor's processes in its last report."""
        known = self.supervisors.get(supervisor)
        return known.states if known is not None else ()

    def starts_of(self, process: str) -> int | None:
        """Return how often a process has been started, by the newest report about it; None without a report."""
        newest = reversed(list(self.supervisors.values()))
        return next((state.starts for one in newest for state in one.states if state.name == process), None)

    def over_since_s(self, process: str) -> float | None:
        """Return the real time since which a process has ended for good.

        Returns:
            -inf if it ended before a restart of the scheduler. None if it has not ended, or if another supervisor
            recently reported a process of this name that has not ended.
        """
        having = [supervisor for supervisor in self.supervisors.values() if process in supervisor.processes]
        since_s = max(
            (supervisor.over[process][1] for supervisor in having if process in supervisor.over), default=None
        )
        if since_s is None:
            return None
        others = [supervisor for supervisor in having if process not in supervisor.over]
        goes_on = any(
            supervisor.reported_s is None or supervisor.reported_s > since_s - SILENT_S for supervisor in others
        )
        return None if goes_on else since_s

    def orders_for(self, supervisor: str) -> tuple[SupervisorRegistry, tuple[str, ...]]:
        """Remove and return a supervisor's open orders: the processes that the supervisor has to restart."""
        known = self.supervisors.get(supervisor)
        if known is None or not known.orders:
            return self, ()
        # removed before the supervisor has acted: if both processes die, a restart is lost rather than done twice
        return replace(self, supervisors={**self.supervisors, supervisor: replace(known, orders=())}), known.orders

    def order(self, process: str, now_s: float) -> tuple[SupervisorRegistry, str]:
        """Order the restart of a process; also return the reason if the order is impossible, else "".

        The order goes to the supervisor that reported the process last.
        """
        having = {name: supervisor for name, supervisor in self.supervisors.items() if process in supervisor.processes}
        if not having:
            known = sorted({process for supervisor in self.supervisors.values() for process in supervisor.processes})
            return self, f"there is no process {process!r}; known: {', '.join(known) or 'none'}"
        # after a restart of the scheduler the next report is still to come: the supervisor counts as alive
        name, newest = max(having.items(), key=lambda item: now_s if item[1].reported_s is None else item[1].reported_s)
        if newest.reported_s is not None and now_s - newest.reported_s > SILENT_S:
            return (
                self,
                f"the supervisor of {process} has sent no report for {duration_text(now_s - newest.reported_s)}",
            )
        if process in newest.orders:
            return self, ""
        ordered = replace(newest, orders=(*newest.orders, process))
        return replace(self, supervisors={**self.supervisors, name: ordered}), ""

    def reported(self, name: str, states: tuple[ProcessState, ...], now_s: float) -> SupervisorRegistry:
        """Store a supervisor's report on its processes."""
        known = self.supervisors.get(name, KnownSupervisor())
        over: dict[str, tuple[int, float]] = {}
        # without keys any peer may report, and all see it; only a supervisor's report may end the holder's control
        for state in states if component_of(name) == SUPERVISOR else ():
            if state.condition in OVER:
                starts, since_s = known.over.get(state.name, (-1, now_s))
                over[state.name] = (state.starts, since_s if starts == state.starts else now_s)
        processes = tuple(state.name for state in states)
        newest = replace(known, processes=processes, reported_s=now_s, over=over, states=states)
        others = [(other, supervisor) for other, supervisor in self.supervisors.items() if other != name]
        return replace(self, supervisors=dict([*others, (name, newest)][-_MOST:]))

    def clock_compared(self, name: str, time_ns: int, now_ns: int, speed: float) -> tuple[SupervisorRegistry, str]:
        """Compare the time of a supervisor's newest report with the present time; also return a warning, or "".

        The translator of a real microscope that is started alone has the clock of its computer, and so have its scans.
        A single report may be late, e.g. repeated after a lost link; two reports with the same difference are not.

        Args:
            speed: experiment seconds per real second.
        """
        known = self.supervisors[name]
        ahead_ns, real_ns = time_ns - now_ns, max(1.0, speed) * 1e9
        before_ns, ahead_before_ns = known.clock or (time_ns, ahead_ns)
        is_steady = time_ns != before_ns and abs(ahead_ns - ahead_before_ns) <= _STEADY_S * real_ns
        differs = is_steady and abs(ahead_ns) > CLOCKS_DIFFER_S * real_ns
        newest = replace(known, clock=(time_ns, ahead_ns), warned=known.warned or differs)
        registry = replace(self, supervisors={**self.supervisors, name: newest})
        if known.warned or not differs:
            return registry, ""
        way = "ahead of" if ahead_ns > 0 else "behind"
        return registry, (
            f"the clock of {name.partition(PERSON)[2] or name} is {duration_text(abs(ahead_ns) / 1e9)} {way} the "
            "scheduler's clock, so the times of scans there are wrong by as much, and drift is followed late or early: "
            "let both computers take their time from the network (NTP), then start that part again"
        )


@dataclass(frozen=True)
class Announcement:
    """A message for publication in the name of a process.

    Attributes:
        envelope: the envelope of the packet; empty if the message is refused.
        why: the reason of the refusal.
        reported: the states of a supervisor's processes, if the message reports them.
        may_repeat: whether the same content may be published twice: a component's result may be equal to its last.
    """

    envelope: str
    why: str = ""
    reported: ProcessStates | None = None
    may_repeat: bool = False


def announcement(event: RequestIn, codec: Codec) -> Announcement:
    """Check a message of a process for publication.

    Progress, notes, proposals and settings must name their sender. With keys, only the supervisor's key may report
    processes and log lines.
    """
    subject = event.request.subject
    if not isinstance(subject, RelayedMessage):
        return Announcement("", "an empty announcement")
    if len(subject.payload) > LONGEST_ANNOUNCEMENT:
        return Announcement("", f"an announcement of {len(subject.payload)} bytes: at most {LONGEST_ANNOUNCEMENT}")
    thing = codec.decode_packet(subject.message, subject.payload)
    if isinstance(thing, Progress) and subject.message == "Progress":
        mine = thing.name in (event.name, component_of(event.name))
        return _named(subject.message, thing.name) if mine else Announcement("", f"{event.name} is not {thing.name}")
    if isinstance(thing, Note) and subject.message == "Note":
        mine = thing.who == event.name
        return Announcement(subject.message) if mine else Announcement("", f"{event.name} is not {thing.who[:80]!r}")
    if isinstance(thing, Proposal) and subject.message == "Proposal":
        mine = thing.who == event.name
        return Announcement(subject.message) if mine else Announcement("", f"{event.name} is not {thing.who[:80]!r}")
    if isinstance(thing, MeasurementSettings) and subject.message == "MeasurementSettings":
        mine = thing.who == event.name
        return Announcement(subject.message) if mine else Announcement("", f"{event.name} is not {thing.who[:80]!r}")
    if thing is not None and wire.is_relayed(subject.message):
        return replace(_named(subject.message, component_of(event.name)), may_repeat=True)
    if not isinstance(thing, ProcessStates | LogLines) or type(thing).__name__ != subject.message:
        return Announcement("", f"a {subject.message[:80]} can't be relayed, or can't be read")
    if event.user not in (None, SUPERVISOR):
        return Announcement("", f"only the key of {SUPERVISOR!r} may report processes, not the key of {event.user}")
    spoken_of = thing.lines if isinstance(thing, LogLines) else thing.processes
    if wrong := [process.name for process in spoken_of if not is_process_name(process.name)]:
        return Announcement("", f"{wrong[0][:LONGEST_PROCESS_NAME]!r} can't be the name of a process")
    if isinstance(thing, LogLines):
        return Announcement(subject.message)
    named = _named(subject.message, thing.supervisor)
    return named if named.why else replace(named, reported=thing)


def _named(message: str, whose: str) -> Announcement:
    if not all(map(is_process_name, whose.split(PERSON))):
        return Announcement("", f"a {message} does not name its owner: {whose[:LONGEST_PROCESS_NAME]!r}")
    return Announcement(f"{message}_{whose}")
