"""The services that the routes of the gateway share."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from starlette.requests import Request

from afspm.model import Frame, Response
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.gateway.events import EventHistory
from afspm.plugins.web.gateway.guard import PERSON
from afspm.plugins.web.gateway.measurements import Measurements
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest, of_error, refused
from afspm.plugins.web.gateway.stream import StreamCount
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.persons import Persons
from afspm.plugins.web.watch import Bell, Watch
from afspm.transport import StopRequested

T = TypeVar("T")
MOST_WAITING = 16
"""Largest number of waiting requests of one name."""
READER = ".reader"
"""Name for reads without a person's name; no person's name begins with a dot."""


@dataclass
class GatewayServices:
    """The shared services of the routes, including connections for requests."""

    watch: Watch
    bell: Bell
    archive: Archive
    history: EventHistory
    measurements: Measurements
    persons: Persons
    experiment: str
    simulated: bool
    frame: Frame
    streams: StreamCount = field(default_factory=StreamCount)
    waiting: Counter[str] = field(default_factory=Counter)

    def person_of(self, asked: Request) -> str:
        """Return the name in a request; empty: the client may only read."""
        person: str = getattr(asked.state, PERSON, "")
        return person

    def who(self, asked: Request) -> str:
        """Return the scheduler's name for a request's client. Raises RefusedRequest for a request without a name."""
        if not (person := self.person_of(asked)):
            raise RefusedRequest(RefusalCode.NAME_NEEDED, "the record keeps a name with each action")
        return self.persons.name_of(person)

    async def do(
        self,
        asked: Request,
        action: Callable[[PersonCommands], T],
        *,
        urgent: bool = False,
        meanwhile: bool = False,
    ) -> T:
        """Carry out an action under the client's name.

        Args:
            urgent: earlier requests of this client stop waiting for a free microscope.
            meanwhile: the action is carried out even while an earlier request waits for a free microscope.

        Raises:
            RefusedRequest: the client gave no name, too many of its requests wait, or the action failed.
        """
        self.who(asked)
        return await self._carry_out(self.person_of(asked), action, urgent=urgent, meanwhile=meanwhile)

    async def command(
        self,
        asked: Request,
        action: Callable[[PersonCommands], Response],
        *,
        urgent: bool = False,
        meanwhile: bool = False,
    ) -> Response:
        """Send a request to the scheduler, and return the response. Raises RefusedRequest for a refusal."""
        return _success(await self.do(asked, action, urgent=urgent, meanwhile=meanwhile))

    async def read(self, action: Callable[[PersonCommands], T]) -> T:
        """Carry out an action that only reads, under the gateway's own name for readers."""
        return await self._carry_out(READER, action)

    async def _carry_out(
        self, person: str, action: Callable[[PersonCommands], T], *, urgent: bool = False, meanwhile: bool = False
    ) -> T:
        if self.waiting[person] >= MOST_WAITING and person != READER:
            raise RefusedRequest(RefusalCode.TOO_MANY, f"{MOST_WAITING} requests of {person} wait already")
        self.waiting[person] += 1
        try:
            # shielded: a client that disconnects does not cancel its request to the scheduler
            submitted = self.persons.submit(person, action, urgent=urgent, meanwhile=meanwhile)
            return await asyncio.shield(asyncio.wrap_future(submitted))
        except (
            Exception,
            StopRequested,
        ) as error:  # any error becomes a refusal; StopRequested: the experiment ended meanwhile
            raise of_error(error) from error
        finally:
            self.waiting[person] -= 1


def _success(response: Response) -> Response:
    if not response.ok:
        raise refused(response)
    return response
