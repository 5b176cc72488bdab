"""Connections to the scheduler in the names of persons, each with its own thread."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

from afspm.basics import Clock, Launch
from afspm.client import ExperimentLink
from afspm.model import PERSON
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.watch import Watch
from afspm.transport import Network, ParentGone, ZmqPort, new_session

MOST_PERSONS = 32  # each takes a thread and a connection
T = TypeVar("T")


@dataclass
class Person:
    """A person's connection to the scheduler, used by one thread.

    Attributes:
        urgent: number of submitted urgent actions that have not started yet.
        meanwhile: submitted actions that the present action carries out while it waits for a free microscope.
    """

    thread: ThreadPoolExecutor
    urgent: int = 0
    meanwhile: deque[Callable[[], None]] = field(default_factory=deque)
    commands: PersonCommands | None = None
    port: ZmqPort | None = None

    def close(self) -> None:
        if self.port is not None:
            self.port.wake_up(ParentGone())
            # in its own thread: a ZeroMQ socket may be used by one thread only
            self.thread.submit(self.port.close)
        self.thread.shutdown(wait=False)


Connect = Callable[[str, Person], tuple[ZmqPort | None, PersonCommands]]
"""Connects a person by name, for the thread of the person's actions."""


class Persons:
    """Thread-safe connections that send each person's requests to the scheduler in order, under the person's name.

    Args:
        launch: launch line of the component, with the scheduler's addresses and keys.
        connect: connects a person; None: over a socket to the scheduler.
    """

    def __init__(self, launch: Launch, clock: Clock, watch: Watch, connect: Connect | None = None) -> None:
        self._launch = launch
        self._clock = clock
        self._watch = watch
        self._connect = connect or self._connect_to_scheduler
        self._lock = threading.Lock()
        self._persons: OrderedDict[str, Person] = OrderedDict()

    def submit(
        self,
        person: str,
        action: Callable[[PersonCommands], T],
        *,
        urgent: bool = False,
        meanwhile: bool = False,
    ) -> Future[T]:
        """Start an action in the person's thread and name, and return its future.

        Args:
            urgent: earlier actions of this person stop waiting for a free microscope, and are refused.
            meanwhile: an earlier action that waits for a free microscope carries out this action, and waits on.
        """
        with self._lock:
            one = self._persons.get(person)
            if one is None:
                # the connection idle for longest is closed; its next request connects again
                while len(self._persons) >= MOST_PERSONS:
                    self._persons.popitem(last=False)[1].close()
                one = self._persons[person] = Person(ThreadPoolExecutor(1, thread_name_prefix="person"))
            self._persons.move_to_end(person)
            one.urgent += urgent
            if meanwhile:
                future = self._put_meanwhile(person, one, action)
            else:
                future = one.thread.submit(self._carry_out, person, one, action, urgent)
        if urgent or meanwhile:
            self._watch.wake()
        return future

    def name_of(self, person: str) -> str:
        """Return the scheduler's name for a person."""
        return f"{self._launch.name}{PERSON}{person}"

    def close(self) -> None:
        """End all connections; pending actions end without an answer."""
        with self._lock:
            persons, self._persons = list(self._persons.values()), OrderedDict()
        for one in persons:
            one.close()

    def _put_meanwhile(self, person: str, one: Person, action: Callable[[PersonCommands], T]) -> Future[T]:
        future: Future[T] = Future()

        def carry_out() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(self._carry_out(person, one, action, urgent=False))
            except BaseException as error:  # any error is the result of this action, not of the action that waits
                future.set_exception(error)

        def carry_out_rest() -> None:
            while one.meanwhile:
                one.meanwhile.popleft()()

        one.meanwhile.append(carry_out)
        one.thread.submit(carry_out_rest)  # if no action waits, or the last one has just ended
        return future

    def _carry_out(self, person: str, one: Person, action: Callable[[PersonCommands], T], urgent: bool) -> T:
        with self._lock:
            one.urgent -= urgent
        if one.commands is None:
            one.port, one.commands = self._connect(person, one)
        return action(one.commands)

    def _connect_to_scheduler(self, person: str, one: Person) -> tuple[ZmqPort, PersonCommands]:
        launch, name = self._launch, self.name_of(person)
        network = Network.from_launch(launch.name, launch.keys)
        port = ZmqPort(network, name, self._clock, control=launch.sockets.control)
        link = ExperimentLink.of_launch(launch, port, new_session(launch.run), name=name)
        return port, PersonCommands(link, self._watch, lambda: one.urgent > 0, one.meanwhile)
