"""The state of Studio, and what is awaited of it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from afspm.clock import Clock
from afspm.errors import Refused
from afspm.microscopes.nanosurf import commands
from afspm.microscopes.nanosurf.link import StudioError
from afspm.microscopes.nanosurf.session import Session
from afspm.microscopes.nanosurf.settings import TipPlace
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.translator.driver import ControllerLost
from afspm.translator.folder_files import FolderFiles
from afspm.translator.long_call import LongCall
from afspm.translator.result_files import SCAN, FilePrecision, as_list

FORCE: Final = "force"
_SETTLES_S: Final = 2.0
"""So long, in real time, a scan that was begun may take to be seen running."""


class NanosurfFiles(FolderFiles):
    """Studio's files: one for each measurement."""

    pattern = "*.nhf"
    precision = FilePrecision(part=1e-9, angle_rad=1e-9)


class Activity:
    """The measurement or move that runs, begun by a request or at Studio's panel.

    Args:
        folder: gives the folder of Studio's files as seen from here.
        frame_in_force: as it was set.
    """

    def __init__(
        self,
        session: Session,
        files: NanosurfFiles,
        place: TipPlace,
        folder: Callable[[], Path],
        frame_in_force: Callable[[], Region],
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        self._session, self._files, self._place = session, files, place
        self._folder, self._frame_in_force = folder, frame_in_force
        self._clock, self._log = clock, log
        self._call: LongCall | None = None
        self._stopping = self._failed = self._takes_on_arrival = False

    def status(self) -> ScopeStatus:
        """Return what it is doing now; what has ended is awaited from here on."""
        scanning = self._session.scanning().running
        self._end_call()
        what = SCAN if scanning else "" if self._call is None else self._call.what
        curve = self._call is not None and what == FORCE
        self._stopping = self._stopping and (scanning or curve)
        if self._stopping and curve:
            with suppress(Refused):
                self._session.do(commands.STOP_CURVE)  # the first may have overtaken the start: see `Session.begin`
        if self._files.what not in ("", what):
            self._files.end(self._clock.now_ns())
        if scanning and not self._stopping and self._files.what != SCAN:
            self._begin_scan()  # at the panel
        if scanning:
            return ScopeStatus(ScopeState.SCANNING)
        if self._call is not None:
            return ScopeStatus(ScopeState.SPEC if what == FORCE else ScopeState.COARSE_MOTOR)
        return self._at_rest()

    def _at_rest(self) -> ScopeStatus:
        """Nothing is measured: the tip may be on its way."""
        arrived = self._place.arrived()
        if self._takes_on_arrival:
            if arrived:
                self._takes_on_arrival = False
                self._take_curve()
            return ScopeStatus(ScopeState.SPEC)
        if not arrived:
            return ScopeStatus(ScopeState.MOVING)
        failed, self._failed = self._failed, False
        return ScopeStatus(ScopeState.INTERRUPTED if failed or self._files.broken_off else ScopeState.FREE)

    def start_scan(self) -> None:
        """Scan the frame. Raises Refused: Studio does not."""
        self._stopping = False
        before = self._session.scanning().started
        self._begin_scan()
        try:
            self._session.do(commands.START)
            self._settle(before)
        except Refused:
            self._files.forget()
            raise

    def _begin_scan(self) -> None:
        """A scan begins, or was found running."""
        self._files.begin(SCAN, self._folder(), {"frame": as_list(self._frame_in_force())})

    def _settle(self, before: int) -> None:
        """Wait until a scan is seen running, or has ended already. Raises Refused."""
        until_s = self._clock.monotonic_s() + _SETTLES_S
        while self._clock.monotonic_s() < until_s:
            seen = self._session.scanning()
            if seen.running or seen.started > before or self._files.has_file():
                return
        raise Refused(ControlResponse.ACTION_ERROR, "Studio did not begin the scan that it was asked for")

    def start_curve(self) -> None:
        """Take a force curve where the tip was sent: after a scan, it goes there first. Raises Refused."""
        self._stopping = False
        self._place.go()
        self._takes_on_arrival = True

    def _take_curve(self) -> None:
        """Take one curve where the tip is: Studio takes those of its grid, wherever that is on the panel."""
        x, y = self._place.xy_m()
        try:
            self._session.put(dict(zip(commands.GRID, (x, y, 1, 1), strict=True)))
        except Refused as refused:
            self._log.error("no curve was taken: %s", refused)
            self._failed = True
            return
        self._files.begin(FORCE, self._folder(), {"position": [x, y]})
        self._call = self._session.begin(FORCE, commands.TAKE_CURVE)

    def approach(self) -> None:
        """Bring the tip to the sample."""
        self._call = self._session.begin("approach", commands.APPROACH)

    def withdraw(self) -> None:
        """Take the tip away, whatever is going on."""
        self.stopped()
        self.close()
        try:
            self._call = self._session.begin("withdrawal", commands.WITHDRAW, commands.STOP_ALL)
        except ControllerLost as lost:
            self._log.warning("there is no further connection (%s): the tip is withdrawn by the first", lost)
            self._session.run(f"{commands.STOP_ALL} {commands.WORKFLOW}.{commands.WITHDRAW}() return 0")

    def stopped(self) -> None:
        """Note that what is running was told to stop: nothing comes of it."""
        self._stopping, self._takes_on_arrival = True, False
        self._files.forget()

    def close(self) -> None:
        """Wait no longer for what takes long."""
        if self._call is not None:
            self._call.close()
            self._call = None

    def _end_call(self) -> None:
        """Take notice of the end of what takes long. Raises ControllerLost."""
        call = self._call
        if call is None:
            return
        try:
            if call.running():
                return
        except StudioError as error:
            self._log.error("the %s failed: %s", call.what, error)
            self._failed = True
            if call.what == FORCE:
                self._files.forget()
        self.close()
        message = call.value[0].get("message") if call.value and isinstance(call.value[0], dict) else None
        if message:
            self._log.info("the %s has ended: %s", call.what, message)
