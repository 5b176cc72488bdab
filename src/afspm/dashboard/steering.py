"""Connections to the scheduler, one for each person, through which actions are carried out."""

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
from afspm.dashboard.actions import ActionResult, Actions
from afspm.dashboard.watch import Watch
from afspm.errors import AfspmError
from afspm.launch import Launch
from afspm.model.events import PERSON
from afspm.process.context import new_session
from afspm.transport.network import Network
from afspm.transport.port import ParentGone
from afspm.transport.zmq_port import ZmqPort

MOST_PERSONS = 32
Action = Callable[[Actions], ActionResult]


@dataclass
class _Person:
    """A person's connection to the scheduler, used by one thread."""

    thread: ThreadPoolExecutor
    actions: Actions | None = None
    port: ZmqPort | None = None

    def close(self) -> None:
        if self.port is not None:
            self.port.wake_up(ParentGone())
            self.thread.submit(self.port.close)
        self.thread.shutdown(wait=False)


class Steering:
    """Carries out what persons ask for, each in the own name, one thing after the other for each.

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

    def do(self, visitor: Visitor, action: Action) -> Future[ActionResult]:
        """Carry out an action in the name of a person, who must have one and not have signed out."""
        person = check_name(visitor.person)
        if not person or not self._access.is_signed_in(visitor):
            done: Future[ActionResult] = Future()
            done.set_result(ActionResult("Sign in first: what is done is in the record with a name.", ok=False))
            return done
        with self._lock:
            one = self._persons.get(person)
            if one is None:
                while len(self._persons) >= MOST_PERSONS:
                    self._persons.popitem(last=False)[1].close()
                one = self._persons[person] = _Person(ThreadPoolExecutor(1, thread_name_prefix="person"))
            self._persons.move_to_end(person)
        return one.thread.submit(self._carry_out, person, one, action)

    def close(self) -> None:
        """End all connections; what is under way ends without an answer."""
        with self._lock:
            persons, self._persons = list(self._persons.values()), OrderedDict()
        for one in persons:
            one.close()

    def _carry_out(self, person: str, one: _Person, action: Action) -> ActionResult:
        try:
            if one.actions is None:
                one.port, one.actions = self._connect(person)
            result = action(one.actions)
        except AfspmError as error:
            result = ActionResult(str(error), ok=False)
        except Exception as error:
            self._log.exception("an action of %s failed", person)
            result = ActionResult(f"that failed: {type(error).__name__}: {error}", ok=False)
        self._log.debug("%s: %s%s", person, result.text, "" if result.ok else " (not done)")
        return result

    def _connect(self, person: str) -> tuple[ZmqPort, Actions]:
        launch = self._launch
        name = f"{launch.name}{PERSON}{person}"
        network = Network.from_launch(launch.name, launch.keys)
        port = ZmqPort(network, name, self._clock, control=launch.sockets.control)
        link = ExperimentLink.of_launch(launch, port, new_session(launch.run), name=name, log=self._log)
        return port, Actions(link, self._watch)
