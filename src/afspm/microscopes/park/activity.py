"""The state of SmartScan, and what is awaited of it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from afspm.clock import Clock
from afspm.errors import Refused
from afspm.microscopes.park.link import SmartScanError
from afspm.microscopes.park.result_files import ParkFiles
from afspm.microscopes.park.session import Session
from afspm.microscopes.park.settings import MOVE, way_to
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.translator.long_call import LongCall
from afspm.translator.result_files import SCAN, XY, as_list

START, STOP, STOP_CURVE = "scan.triggerImageScan()", "scan.stop()", "spect.stop()"
CURVES: Final = {"force": "fd", "IV": "iv"}
"""Kinds of curves, and what SmartScan calls them."""
APPROACH: Final = '(spm.approach.start("q+s"), 0)'
_ENDED_FIRST: Final = ("scan.stop", "spect.stop", "approach.stop")
_STATES: Final = {MOVE: ScopeState.MOVING, **dict.fromkeys(CURVES, ScopeState.SPEC)}
_ANSWERS_S: Final = 0.5
"""So long, in real time, an expression may take before it counts as one that takes long: an error has come by then."""
_SETTLES_S: Final = 2.0
"""So long, in real time, a scan that was begun may take to be seen running."""


class Activity:
    """The measurement or move that runs, begun by a request or at SmartScan's panel.

    Args:
        folder: gives the folder of SmartScan's files as seen from here.
        frame_in_force: as it was set.
    """

    def __init__(
        self,
        session: Session,
        files: ParkFiles,
        folder: Callable[[], Path],
        frame_in_force: Callable[[], Region],
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        self._session, self._files = session, files
        self._folder, self._frame_in_force = folder, frame_in_force
        self._clock, self._log = clock, log
        self._call: LongCall | None = None
        self._curve_at: XY | None = None  # of a curve to be taken once the tip is there
        self._stopping = self._failed = False

    def status(self) -> ScopeStatus:
        """Return what it is doing now; what has ended is awaited from here on."""
        call = self._watched_call()
        curve = call is not None and call.what in CURVES  # it may count as a scan, too (!)
        scanning = not curve and self._session.scanning()
        self._stopping = self._stopping and (scanning or curve)
        if self._stopping and curve:
            with suppress(Refused):
                self._session.do(STOP_CURVE)  # the first may have overtaken the script, which has another connection
        if self._files.what and not scanning and not curve:
            self._files.end(self._clock.now_ns())
        if scanning and not self._stopping and not self._files.what:
            self._begin_scan()  # at the panel
        if scanning:
            return ScopeStatus(ScopeState.SCANNING)
        if call is not None:
            return ScopeStatus(_STATES.get(call.what, ScopeState.COARSE_MOTOR))
        failed, self._failed = self._failed, False
        return ScopeStatus(ScopeState.INTERRUPTED if failed or self._files.broken_off else ScopeState.FREE)

    def start_scan(self) -> None:
        """Scan the frame. Raises Refused: SmartScan does not."""
        self._stopping = False
        self._begin_scan()
        try:
            self._session.do(START)
            self._settle()
        except Refused:
            self._files.forget()
            raise

    def start_curve(self, kind: str, place_m: XY) -> None:
        """Take a curve where the tip was sent: after a scan, it goes there first."""
        self._stopping = False
        self.begun(self._session.begin(kind, way_to(place_m)))
        self._curve_at = place_m

    def approach(self) -> None:
        """Bring the tip to the sample."""
        self.begun(self._session.begin("approach", APPROACH))

    def evaluate(self, expression: str) -> None:
        """Evaluate an expression; one that has no value soon keeps the microscope busy. Raises SmartScanError."""
        call = self._session.begin("command", f"({expression}, 0)", _ANSWERS_S)
        try:
            goes_on = call.running()
        except BaseException:
            call.close()
            raise
        if goes_on:
            self.begun(call)
        else:
            call.close()

    def withdraw(self, lift_um: float) -> None:
        """Take the tip away, whatever is going on: the scanner first, and then the stage."""
        self.stopped()
        self.close()
        ended = " ".join(f"try {{ spm.{one}(); }} catch (ignored) {{}}" for one in _ENDED_FIRST)
        away = f"spm.zscanner.retractAll(); if ({lift_um!r} > 0) {{ spm.zstage.move({lift_um!r}, 1); }}"
        self.begun(self._session.begin("withdrawal", f"(function() {{ {ended} {away} return 0; }})()"))

    def begun(self, call: LongCall) -> None:
        """Watch a script that takes long, instead of the one before."""
        self.close()
        self._call = call

    def stopped(self) -> None:
        """Note that what is running was told to stop: nothing comes of it, but a tip on its way goes on."""
        if self._call is not None and self._curve_at is not None:
            self._call.what = MOVE
        self._stopping, self._curve_at = True, None
        self._files.forget()

    def close(self) -> None:
        """Wait no longer for what takes long."""
        self._curve_at = None
        if self._call is not None:
            self._call.close()
            self._call = None

    # --- inside ---

    def _begin_scan(self) -> None:
        self._files.begin(SCAN, self._folder(), {"frame": as_list(self._frame_in_force())})

    def _settle(self) -> None:
        """Wait until a scan is seen running, or has ended already. Raises Refused."""
        until_s = self._clock.monotonic_s() + _SETTLES_S
        while self._clock.monotonic_s() < until_s:
            if self._session.scanning() or self._files.has_file():
                return
        raise Refused(ControlResponse.ACTION_ERROR, "SmartScan did not begin the scan that it was asked for")

    def _take_curve(self, kind: str, place_m: XY) -> None:
        self._files.begin(kind, self._folder(), {"position": list(place_m)})
        self._call = self._session.begin(kind, f'(spm.spect.start("{CURVES[kind]}", "here"), 0)')

    def _watched_call(self) -> LongCall | None:
        """Return the script that takes long, while it does. Raises ControllerLost."""
        call, place_m = self._call, self._curve_at
        if call is None:
            return None
        try:
            if call.running():
                return call
        except SmartScanError as error:
            self._log.error("the %s failed: %s", call.what, error)
            self._failed, place_m = True, None
            if call.what == self._files.what:
                self._files.forget()
        self.close()
        if place_m is not None:
            self._take_curve(call.what, place_m)
        return self._call
