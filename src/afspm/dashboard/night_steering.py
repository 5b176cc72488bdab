"""The one action on a recorded night: to write notes."""

from __future__ import annotations

import logging
from concurrent.futures import Future, ThreadPoolExecutor

from afspm.clock import ExperimentClock
from afspm.dashboard.access import Access, Visitor
from afspm.dashboard.actions import Action, ActionResult, Actions, Steering, not_signed_in
from afspm.dashboard.night import Night
from afspm.errors import AfspmError
from afspm.model.events import PERSON
from afspm.record.notes import append_note
from afspm.record.report import REPORT_FILE, write


class NightActions(Actions):
    """The actions of one person on a recorded night."""

    def __init__(self, night: Night, who: str) -> None:
        self._night = night
        self._who = who

    def note(self, text: str, scan_ns: int | None = None, time_ns: int | None = None) -> ActionResult:
        """Append a note to the record; the report is then written again."""
        written_ns = ExperimentClock.real().now_ns()
        append_note(self._night.folder, self._who, text, written_ns, scan_ns, time_ns)
        self._night.reload()
        if (self._night.folder / REPORT_FILE).exists():
            write(self._night.folder)
        return ActionResult("Noted.")


class NightSteering(Steering):
    """Carries out notes, one after the other."""

    def __init__(self, night: Night, access: Access, name: str) -> None:
        self._night = night
        self._access = access
        self._name = name
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="notes")
        self._log = logging.getLogger("afspm.dashboard")

    def do(self, visitor: Visitor, action: Action) -> Future[ActionResult]:
        person = self._access.person_of(visitor)
        return self._thread.submit(self._note, f"{self._name}{PERSON}{person}", action) if person else not_signed_in()

    def close(self) -> None:
        self._thread.shutdown()

    def _note(self, who: str, action: Action) -> ActionResult:
        try:
            return action(NightActions(self._night, who))
        except AfspmError as error:
            return ActionResult(str(error), ok=False)
