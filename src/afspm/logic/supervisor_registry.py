"""What others have the scheduler publish, and what supervisors are ordered to do in return."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from afspm.formatting import duration_text
from afspm.logic.events import Codec, RequestIn
from afspm.model import (
    LogLines,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Progress,
    RelayedMessage,
    component_of,
    is_process_name,
)
from afspm.model.events import LONGEST_PROCESS_NAME, PERSON

SUPERVISOR = "supervisor"
"""Whose key it takes, where there are keys, to speak of processes; each supervisor adds ":" and what tells it apart."""
LOGGED_AS = "afspm"
"""The name that its own lines have in the log."""
LONGEST = 256 * 1024
"""Bytes that may be told at a time."""
SILENT_S = 10.0
"""A supervisor that has not been heard of for so long, real time, is given no more orders."""
_MOST = 64  # supervisors
OVER = (ProcessCondition.ENDED, ProcessCondition.GIVEN_UP)
"""Conditions of a process that does not run and is not started again."""


@dataclass(slots=True)
class _Supervisor:
    """One, by the name it asks under; `told_s` is None for one that was known before a restart of ours.

    Attributes:
        states: as it told them last.
        over: of its processes those that are over, with how often each was started before and since when that is known.
    """

    processes: tuple[str, ...]
    told_s: float | None = None
    orders: list[str] = field(default_factory=list)
    over: dict[str, tuple[int, float]] = field(default_factory=dict)
    states: tuple[ProcessState, ...] = ()


class SupervisorRegistry:
    """Knows which supervisor has which processes, and what each is still to be ordered."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._supervisors: dict[str, _Supervisor] = {}

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, as plain JSON."""
        return {
            name: [
                list(one.processes),
                list(one.orders),
                {process: starts for process, (starts, _) in one.over.items()},
            ]
            for name, one in self._supervisors.items()
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self._supervisors = {}
        for name, (processes, orders, *rest) in state.items():  # what a scheduler wrote that was older has no rest
            over = {str(process): (int(starts), -math.inf) for process, starts in (rest[0] if rest else {}).items()}
            self._supervisors[str(name)] = _Supervisor(tuple(map(str, processes)), None, list(map(str, orders)), over)

    def envelope(self, event: RequestIn, now_s: float) -> tuple[str, str]:
        """The envelope under which to publish what is told, or "" and why it is not."""
        told = event.request.subject
        if not isinstance(told, RelayedMessage):
            return "", "nothing is told"
        if len(told.payload) > LONGEST:
            return "", f"{len(told.payload)} bytes are told at once, at most {LONGEST} may be"
        thing = self._codec.decode_packet(told.message, told.payload)
        if isinstance(thing, Progress) and told.message == "Progress":
            mine = thing.name in (event.name, component_of(event.name))
            return _named(told.message, thing.name) if mine else ("", f"{event.name} is not {thing.name}")
        if not isinstance(thing, ProcessStates | LogLines) or type(thing).__name__ != told.message:
            return "", f"a {told.message[:80]} is not published for others, or can't be read"
        if event.user not in (None, SUPERVISOR):
            return "", f"it takes the key of {SUPERVISOR!r} to speak of processes, not that of {event.user}"
        if wrong := [name for name in _names(thing) if not is_process_name(name)]:
            return "", f"{wrong[0][:LONGEST_PROCESS_NAME]!r} can't be the name of a process"
        if isinstance(thing, LogLines):
            return told.message, ""
        envelope, why = _named(told.message, thing.supervisor)
        if not why:
            self._know(event.name, thing.processes, now_s)
        return envelope, why

    def states_of(self, supervisor: str) -> tuple[ProcessState, ...]:
        """How it is with the processes of a supervisor, as it told last."""
        known = self._supervisors.get(supervisor)
        return known.states if known is not None else ()

    def over_since_s(self, process: str) -> float | None:
        """Since when, real time, it is known that a process has ended, or is given up, and is not started again.

        -inf: that was known before a restart of ours. None: it is not so, or a supervisor that was heard of lately has
        a process of this name that is not over.
        """
        having = [one for one in self._supervisors.values() if process in one.processes]
        since_s = max((one.over[process][1] for one in having if process in one.over), default=None)
        if since_s is None:
            return None
        others = [one for one in having if process not in one.over]
        goes_on = any(one.told_s is None or one.told_s > since_s - SILENT_S for one in others)
        return None if goes_on else since_s

    def orders_for(self, supervisor: str) -> list[str]:
        """Processes that a supervisor is to start anew; it has been told of them then."""
        known = self._supervisors.get(supervisor)
        if known is None:
            return []
        orders, known.orders = known.orders, []
        return orders

    def order(self, process: str, now_s: float) -> str:
        """Have a process started anew; returns why that can't be, or ""."""
        having = {name: one for name, one in self._supervisors.items() if process in one.processes}
        if not having:
            known = sorted({process for one in self._supervisors.values() for process in one.processes})
            return f"no supervisor has a process {process!r}; known: {', '.join(known) or 'none'}"
        newest = max(having.values(), key=lambda one: now_s if one.told_s is None else one.told_s)
        if newest.told_s is not None and now_s - newest.told_s > SILENT_S:
            return f"the supervisor of {process} has not been heard of for {duration_text(now_s - newest.told_s)}"
        if process not in newest.orders:
            newest.orders.append(process)
        return ""

    def _know(self, name: str, processes: tuple[ProcessState, ...], now_s: float) -> None:
        known = self._supervisors.pop(name, None) or _Supervisor(())
        known.processes, known.told_s = tuple(state.name for state in processes), now_s
        known.states = processes
        before, known.over = known.over, {}
        # without keys anybody may tell, for all to see; that changes control only if it comes from a supervisor
        for state in processes if component_of(name) == SUPERVISOR else ():
            if state.condition in OVER:
                starts, since_s = before.get(state.name, (-1, now_s))
                known.over[state.name] = (state.starts, since_s if starts == state.starts else now_s)
        self._supervisors[name] = known  # the one heard of last is last
        if len(self._supervisors) > _MOST:
            del self._supervisors[next(iter(self._supervisors))]


def _names(thing: ProcessStates | LogLines) -> list[str]:
    """The names of the processes that are spoken of."""
    return [one.name for one in (thing.lines if isinstance(thing, LogLines) else thing.processes)]


def _named(message: str, whose: str) -> tuple[str, str]:
    if not all(map(is_process_name, whose.split(PERSON))):
        return "", f"a {message} does not say whose it is: {whose[:LONGEST_PROCESS_NAME]!r}"
    return f"{message}_{whose}", ""
