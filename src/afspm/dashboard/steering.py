"""What persons do: each asks the scheduler in the own name, and is told what came of it."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from afspm.client.link import ExperimentLink
from afspm.clock import Clock
from afspm.dashboard.access import Access, Visitor, check_name
from afspm.dashboard.acts import Acts, Outcome
from afspm.dashboard.watch import Watch
from afspm.errors import AfspmError
from afspm.launch import Launch
from afspm.model.events import PERSON
from afspm.process.context import new_session
from afspm.transport.network import Network
from afspm.transport.port import ParentGone
from afspm.transport.zmq_port import ZmqPort

MOST_PERSONS = 32
Act = Callable[[Acts], Outcome]


@dataclass
class _Person:
    """A person's connection to the scheduler, used by one thread."""

    thread: ThreadPoolExecutor
    acts: Acts | None = None
    port: ZmqPort | None = None


class Steering:
    """Carries out what persons ask for, one thing after the other for each.

    Args:
        launch: the line that the dashboard was started with; persons reach the scheduler as it does, with its keys.
        access: knows who has signed in.
    """

    def __init__(self, launch: Launch, clock: Clock, watch: Watch, access: Access) -> None:
        self._launch = launch
        self._access = access
        self._clock = clock
        self._watch = watch
        self._lock = threading.Lock()
        self._persons: OrderedDict[str, _Person] = OrderedDict()
        self._log = logging.getLogger("afspm.dashboard")

    def do(self, visitor: Visitor, act: Act) -> Future[Outcome]:
        """Carry out an act in the name of a person, who must have one and not have signed out."""
        person = check_name(visitor.person)
        if not person or not self._access.is_signed_in(visitor):
            done: Future[Outcome] = Future()
            done.set_result(Outcome("Sign in first: what is done is in the record with a name.", ok=False))
            return done
        with self._lock:
            one = self._persons.get(person)
            if one is None:
                self._forget_some()
                one = self._persons[person] = _Person(ThreadPoolExecutor(1, thread_name_prefix="person"))
            self._persons.move_to_end(person)
        return one.thread.submit(self._carry_out, person, one, act)

    def close(self) -> None:
        """End all connections; what is under way ends without an answer."""
        with self._lock:
            persons, self._persons = list(self._persons.values()), OrderedDict()
        for one in persons:
            _close(one)

    def _carry_out(self, person: str, one: _Person, act: Act) -> Outcome:
        try:
            if one.acts is None:
                one.port, one.acts = self._connect(person)
            outcome = act(one.acts)
        except AfspmError as error:
            outcome = Outcome(str(error), ok=False)
        except Exception as error:
            self._log.exception("an act of %s failed", person)
            outcome = Outcome(f"that failed: {type(error).__name__}: {error}", ok=False)
        self._log.debug("%s: %s%s", person, outcome.text, "" if outcome.ok else " (not done)")
        return outcome

    def _connect(self, person: str) -> tuple[ZmqPort, Acts]:
        launch = self._launch
        name = f"{launch.name}{PERSON}{person}"
        network = Network.from_launch(launch.name, launch.keys)
        port = ZmqPort(network, name, self._clock, control=launch.sockets.control)
        link = ExperimentLink.of_launch(launch, port, new_session(launch.run), name=name, log=self._log)
        return port, Acts(link, self._watch)

    def _forget_some(self) -> None:
        while len(self._persons) >= MOST_PERSONS:
            _close(self._persons.popitem(last=False)[1])


def _close(one: _Person) -> None:
    if one.port is not None:
        one.port.wake_up(ParentGone())
        one.thread.submit(one.port.close)
    one.thread.shutdown(wait=False)
