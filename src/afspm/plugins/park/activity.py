"""State of SmartScan, and the measurements in progress."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

from afspm.basics import AfspmError, Clock, Refused
from afspm.driver import ANSWERS_S, SCAN, Activity, Kept, LongCall, as_list
from afspm.model import XY, ControlResponse, Region, ScopeState, ScopeStatus
from afspm.plugins.park.link import SmartScanError
from afspm.plugins.park.result_files import ParkFiles
from afspm.plugins.park.session import Session
from afspm.plugins.park.settings import MOVE, way_to

START, STOP, STOP_CURVE = "scan.triggerImageScan()", "scan.stop()", "spect.stop()"
CURVES: Final = {"force": "fd", "IV": "iv"}
"""Kinds of curves, with SmartScan's names."""
APPROACH: Final = '(spm.approach.start("q+s"), 0)'
_WHOLE: Final = 0.9
"""Part of a scan's expected duration, before which a scan that ends was stopped."""
_ENDED_FIRST: Final = ("scan.stop", "spect.stop", "approach.stop")
_STATES: Final = {MOVE: ScopeState.MOVING, **dict.fromkeys(CURVES, ScopeState.SPEC)}


@dataclass
class ScanDuration:
    """The duration of a scan, which shows that it was stopped: SmartScan reports no progress.

    Attributes:
        began_s: experiment time right before the start.
        at_least_s: duration by the slowest lines seen so far; 0 if unknown. Whether a change moves a running scan is
            unknown (! frame-in-scan); if it made the scan faster, and it left no file, a person is at work.
        is_under_way: whether SmartScan has reported the scan as running.
        ended_early: how much too early it ended, in words; empty: not, or not yet.
    """

    began_s: float = 0.0
    at_least_s: float = 0.0
    is_under_way: bool = False
    ended_early: str = ""

    def see(self, rows: int, lines_per_s: float) -> None:
        if rows > 0 and lines_per_s > 0.0:
            self.at_least_s = max(self.at_least_s, rows / lines_per_s)

    def end(self, now_s: float) -> None:
        lasted_s = now_s - self.began_s
        if lasted_s < _WHOLE * self.at_least_s:
            took = f"after {lasted_s:.0f} s instead of {self.at_least_s:.0f} s, and left no complete file"
            self.ended_early = f"SmartScan ended it without a request of the run, {took}"


class SmartScanActivity(Activity):
    """The running measurement or move, started by a request or at SmartScan's panel.

    Args:
        kept: persistent, JSON-able: name of the running script, which goes on after the connection is lost.
        folder: returns the local path of SmartScan's files.
        frame_in_force: returns the frame as it was set.
    """

    program: ClassVar[str] = "SmartScan"
    settles_s: ClassVar[float] = 2.0
    call_failures: ClassVar[tuple[type[AfspmError], ...]] = (SmartScanError,)

    def __init__(
        self,
        session: Session,
        files: ParkFiles,
        kept: Kept,
        folder: Callable[[], Path],
        frame_in_force: Callable[[], Region],
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        super().__init__(files, clock, log)
        self._session, self._files = session, files
        self._folder, self._frame_in_force = folder, frame_in_force
        self._curve_at: XY = (0.0, 0.0)
        self._lasts = ScanDuration()
        self._kept = kept
        # removed here, and stored again by the next poll: after a failed poll the script is not resumed for ever
        if what := kept.pop("call", ""):
            self.call = session.resumed(what)

    def status(self) -> ScopeStatus:
        """Return the present state. Register measurements that began or ended, and take a curve that awaits the tip."""
        call = self._running_call()
        curve = call is not None and call.what in CURVES  # (! curve-as-scan)
        scanning = not curve and self._session.scanning()
        if self._stopping and curve:
            with suppress(Refused):
                # again: the first stop may have overtaken the start, on another connection
                self._session.do(STOP_CURVE)
        if scanning:
            self.follow(self._files.what or SCAN)
            self._goes_on()
            return ScopeStatus(ScopeState.SCANNING)
        if not self.curve_awaited:
            self.follow(call.what if call is not None and curve else "")
        if call is not None:
            return ScopeStatus(_STATES.get(call.what, ScopeState.COARSE_MOTOR))
        return self.at_rest()

    def begin(self, what: str) -> None:
        self._lasts = ScanDuration(self._clock.now_s())
        place = {"frame": as_list(self._frame_in_force())} if what == SCAN else {"position": list(self._curve_at)}
        self._files.begin(what, self._folder(), place)

    def end(self) -> None:
        if self._files.what == SCAN:
            self._frame_in_force()
            self._lasts.end(self._clock.now_s())
        self._files.end(self._clock.now_ns())

    def see_frame(self, region: Region, rows: int, lines_per_s: float) -> None:
        """Register a frame that was read; it counts while a scan is seen running."""
        if self._lasts.is_under_way:
            self._files.see_frame(region)
        self._lasts.see(rows, lines_per_s)

    def stopped_by_hand(self) -> str:
        return super().stopped_by_hand() or self._lasts.ended_early

    def start_scan(self) -> None:
        """Start a scan of the frame.

        Raises:
            Refused: SmartScan reports an error, or shows no scan within `settles_s`.
        """
        self.started(SCAN, lambda: self._session.do(START), lambda: self._session.scanning() or self._files.has_file())
        self._goes_on()

    def start_curve(self, kind: str, place_m: XY) -> None:
        """Move the tip to `place_m`, (x, y) in m, where `status` takes a curve of this kind on arrival."""
        self._stopping = False
        # A scan leaves the scanner away from the target: the curve needs a move first.
        self.watch(self._session.begin(kind, way_to(place_m)))
        self.curve_awaited, self._curve_at = kind, place_m

    def approach(self) -> None:
        """Approach the sample. Raises Refused: ACTION_ERROR: SmartScan reports an error within 0.5 s."""
        self.watch(self._session.start("approach", APPROACH, ControlResponse.ACTION_ERROR))

    def evaluate(self, expression: str) -> None:
        """Evaluate an expression. An expression that takes longer than 0.5 s keeps the microscope busy.

        Raises:
            SmartScanError: the expression failed within 0.5 s. ControllerLost.
        """
        call = self._session.begin("command", f"({expression}, 0)", ANSWERS_S)
        try:
            goes_on = call.running()
        except BaseException:  # Ctrl-C, too: nothing else closes this connection
            call.close()
            raise
        if goes_on:
            self.watch(call)
        else:
            call.close()

    def withdraw(self, lift_um: float) -> None:
        """Stop scan, curve and approach, and withdraw the tip: by the scanner, then by the stage if `lift_um` > 0.

        Raises:
            Refused: ACTION_ERROR: SmartScan reports an error within 0.5 s.
        """
        self.stopped()
        self.close()
        # an error of a stop must not prevent the withdrawal
        ended = " ".join(f"try {{ spm.{one}(); }} catch (ignored) {{}}" for one in _ENDED_FIRST)
        away = f"spm.zscanner.retractAll(); if ({lift_um!r} > 0) {{ spm.zstage.move({lift_um!r}, 1); }}"
        script = f"(function() {{ {ended} {away} return 0; }})()"
        # a refused withdrawal must not count as done
        self.watch(self._session.start("withdrawal", script, ControlResponse.ACTION_ERROR))

    def watch(self, call: LongCall) -> None:
        self.curve_awaited = ""
        super().watch(call)
        self._kept["call"] = call.what

    def stopped(self) -> None:
        """Register a stop: the running measurement has no result. A move of the tip continues."""
        if self.call is not None and self.curve_awaited:
            # The script of a move can't be stopped: the tip is busy until it arrives.
            self.call.what = MOVE
        super().stopped()

    # --- inside ---

    def _goes_on(self) -> None:
        if self._files.what == SCAN and not self._lasts.is_under_way:
            self._lasts.is_under_way = True
            self._frame_in_force()  # which calls `see_frame`

    def _running_call(self) -> LongCall | None:
        # The move to a curve and the curve are two scripts: the curve starts when the move has ended.
        call = self.watched_call()
        if call is None and self.curve_awaited:
            kind, self.curve_awaited = self.curve_awaited, ""
            self.begin(kind)
            self.call = call = self._session.begin(kind, f'(spm.spect.start("{CURVES[kind]}", "here"), 0)')
        self._kept["call"] = "" if call is None else call.what
        return call
