"""State of Studio, and the measurements in progress."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Final

from afspm.basics.clock import Clock
from afspm.basics.errors import AfspmError, Refused
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.plugins.nanosurf import commands
from afspm.plugins.nanosurf.link import StudioError
from afspm.plugins.nanosurf.session import Session
from afspm.plugins.nanosurf.settings import TipPlace
from afspm.translator.activity import Activity
from afspm.translator.driver_base import ControllerLost
from afspm.translator.folder_files import FolderFiles
from afspm.translator.long_call import ANSWERS_S, LongCall
from afspm.translator.result_files import SCAN, FilePrecision, as_list
from afspm.translator.state import Kept

FORCE: Final = "force"


class NanosurfFiles(FolderFiles):
    """Studio's files: one file for each measurement."""

    pattern = "*.nhf"
    precision = FilePrecision(part=1e-9, angle_rad=1e-9)


class StudioActivity(Activity):
    """The running measurement or move, started by a request or at Studio's panel.

    Args:
        kept: persistent, JSON-able: name of the running approach or withdrawal.
        folder: returns the local path of Studio's files.
        frame_in_force: returns the frame as it was set.
    """

    program: ClassVar[str] = "Studio"
    settles_s: ClassVar[float] = 2.0
    call_failures: ClassVar[tuple[type[AfspmError], ...]] = (StudioError,)

    def __init__(
        self,
        session: Session,
        files: NanosurfFiles,
        place: TipPlace,
        kept: Kept,
        folder: Callable[[], Path],
        frame_in_force: Callable[[], Region],
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        super().__init__(files, clock, log)
        self._session, self._files, self._place = session, files, place
        self._folder, self._frame_in_force = folder, frame_in_force
        self._kept = kept
        if what := kept.pop("call", ""):
            # Studio reports the end of a command only on the connection of this command
            log.error("contact with Studio was lost during the %s: look if it has ended, and where the tip is", what)
            self._failed = True

    def status(self) -> ScopeStatus:
        """Return the present state. Register measurements that began or ended, and take a curve that awaits the tip."""
        scanning = self._session.scanning().running
        call = self._running_call()
        curve = call is not None and call.what == FORCE
        if self._stopping and curve:
            with suppress(Refused):
                # again: the first stop may have overtaken the start, on another connection
                self._session.do(commands.STOP_CURVE)
        self.follow(SCAN if scanning else FORCE if curve else "")
        if scanning:
            return ScopeStatus(ScopeState.SCANNING)
        if call is not None:
            return ScopeStatus(ScopeState.SPEC if curve else ScopeState.COARSE_MOTOR)
        arrived = self._place.arrived()
        if self.curve_awaited:
            if arrived:
                self.curve_awaited = ""
                self._take_curve()
            return ScopeStatus(ScopeState.SPEC)
        return self.at_rest() if arrived else ScopeStatus(ScopeState.MOVING)

    def begin(self, what: str) -> None:
        place = {"frame": as_list(self._frame_in_force())} if what == SCAN else {"position": list(self._place.xy_m())}
        self._files.begin(what, self._folder(), place)

    def end(self) -> None:
        self._files.end(self._clock.now_ns())

    def start_scan(self) -> None:
        """Start a scan of the frame.

        Raises:
            Refused: ACTION_ERROR: Studio reports an error, or shows no scan within `settles_s`.
        """
        # A short scan may be over before the next poll: then the count of started scans has risen.
        before = self._session.scanning().started

        def is_seen() -> bool:
            seen = self._session.scanning()
            return seen.running or seen.started > before or self._files.has_file()

        self.started(SCAN, lambda: self._session.do(commands.START), is_seen)

    def start_curve(self) -> None:
        """Move the tip to its target position, where `status` takes a force curve on arrival.

        Raises:
            Refused: ACTION_ERROR: Studio does not move the tip.
        """
        self._stopping = False
        self._place.go()
        self.curve_awaited = FORCE

    def _take_curve(self) -> None:
        # Studio takes the curves of its grid, at the grid's place on the panel: a grid of one curve is put at the tip.
        try:
            self._session.put(dict(zip(commands.GRID, (*self._place.xy_m(), 1, 1), strict=True)))
        except Refused as refused:
            self._log.error("no curve was taken: %s", refused)
            self._failed = True
            return
        self.begin(FORCE)
        self.watch(self._session.begin(FORCE, commands.TAKE_CURVE))

    def approach(self) -> None:
        """Approach the sample. Raises Refused: ACTION_ERROR: Studio reports an error within 0.5 s."""
        self._move("approach", commands.APPROACH)

    def withdraw(self) -> None:
        """Stop scan, curve and approach, and withdraw the tip.

        Raises:
            Refused: ACTION_ERROR: Studio reports an error within 0.5 s. StudioError, ControllerLost.
        """
        self.stopped()
        self.close()
        self._kept["call"] = ""
        try:
            self._move("withdrawal", commands.WITHDRAW, commands.STOP_ALL)
        except ControllerLost as lost:
            # A Studio may serve one client only; the first connection then waits for the end of the withdrawal.
            self._log.warning("there is no further connection (%s): the tip is withdrawn by the first", lost)
            self._session.run(f"{commands.STOP_ALL} {commands.WORKFLOW}.{commands.WITHDRAW}() return 0")

    def _move(self, what: str, command: str, first: str = "") -> None:
        # a refused withdrawal must not count as done
        call = self._session.begin(what, command, first, ANSWERS_S)
        call.require_accepted(StudioError, "Studio", ControlResponse.ACTION_ERROR)
        self.watch(call)
        self._kept["call"] = what

    def _running_call(self) -> LongCall | None:
        call = self.call
        if (running := self.watched_call()) is not None or call is None:
            return running
        self._kept["call"] = ""
        message = call.value[0].get("message") if call.value and isinstance(call.value[0], dict) else None
        if message:
            self._log.info("the %s has ended: %s", call.what, message)
        return None
