"""State of Studio, and the measurements in progress.

No command of the lowest licence reports whether a scan runs, so Studio counts its own signals, and the driver reads the
counts. Curves, approach and withdrawal have no signals; their commands return at the end.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

from afspm.basics import AfspmError, Clock, Refused
from afspm.driver import (
    ANSWERS_S,
    SCAN,
    Activity,
    ControllerLost,
    Entry,
    FilePrecision,
    FolderFiles,
    Kept,
    LongCall,
    as_list,
)
from afspm.model import ControlResponse, Region, Scan, ScopeState, ScopeStatus, Spectrum
from afspm.plugins.nanosurf import commands
from afspm.plugins.nanosurf.link import StudioError
from afspm.plugins.nanosurf.session import Session
from afspm.plugins.nanosurf.settings import TipPlace

FORCE: Final = "force"
_LEAST: Final = 0.45
"""Duration of a complete scan, as the least share of its lines' time: a line may be one pass, not two
(! line-both-ways)."""
_LEARNT: Final = 0.95
"""The same, as a share of the duration of a complete scan of these lines: its way to the first line varies."""
_PARTIAL: Final = "Studio saved the scan without its last lines, and no request had stopped it"
_MOVED: Final = (  # (! frame-in-scan)
    "its frame was changed at Studio's panel, and whether that moves a running scan is unknown"
)


@dataclass(frozen=True)
class ScanTime:
    """The frame of a scan, and the duration of its lines.

    Attributes:
        line_s: experiment seconds of a line, forward and backward; 0 if unknown.
    """

    region: Region
    lines: int
    line_s: float


class NanosurfFiles(FolderFiles):
    """Studio's files: one file for each measurement."""

    pattern = "*.nhf"
    precision = FilePrecision(part=1e-9, angle_rad=1e-9)

    @property
    def running(self) -> Entry | None:
        """The running measurement."""
        found: Entry | None = self._kept["running"]
        return found

    def shortest_s(self, lines: int, line_s: float) -> float:
        """Return the shortest duration that a complete scan of these lines can have, experiment time."""
        known = self._kept.get("complete")
        learnt_s = _LEARNT * known["lasted_s"] if known and known["lines"] == [lines, line_s] else 0.0
        return float(max(_LEAST * lines * line_s, learnt_s))

    def check(self, path: Path, one: Scan | Spectrum, measured: Entry) -> None:
        """Learn the duration of a complete scan from its file: at least the time for which it was seen to run."""
        if measured["what"] == SCAN:
            key, lasted_s = measured["lines"], measured["seen_s"] - measured["begun_s"]
            known = self._kept.get("complete")
            if known and known["lines"] == key:  # a paused scan lasts longer
                lasted_s = min(lasted_s, known["lasted_s"])
            self._kept["complete"] = {"lines": key, "lasted_s": lasted_s}


class StudioActivity(Activity):
    """The running measurement or move, started by a request or at Studio's panel.

    Args:
        kept: persistent, JSON-able: name of the running approach or withdrawal.
        folder: returns the local path of Studio's files.
        scan_time: returns frame and lines as they are set.
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
        scan_time: Callable[[], ScanTime],
        clock: Clock,
        log: logging.Logger,
    ) -> None:
        super().__init__(files, clock, log)
        self._session, self._files, self._place = session, files, place
        self._folder, self._scan_time = folder, scan_time
        self._by_hand, self._is_short = "", False
        self._started = 0
        self._kept = kept
        if what := kept.pop("call", ""):
            # Studio reports the end of a command only on the connection of this command
            log.error("contact with Studio was lost during the %s: look if it has ended, and where the tip is", what)
            self._failed = True

    def status(self) -> ScopeStatus:
        """Return the present state. Register measurements that began or ended, and take a curve that awaits the tip."""
        seen = self._session.scanning()
        scanning, running = seen.running, self._files.running
        if running is not None and running["what"] == SCAN and seen.started > running["started"]:
            # between two looks it was stopped at the panel and another one begun, which may be over as well
            scanning = True
            self.follow("")
        self._started = seen.started
        call = self._running_call()
        curve = call is not None and call.what == FORCE
        if self._stopping and curve:
            with suppress(Refused):
                # again: the first stop may have overtaken the start, on another connection
                self._session.do(commands.STOP_CURVE)
        self.follow(SCAN if scanning else FORCE if curve else "")
        if scanning:
            self._watch_scan()
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
        self._by_hand, self._is_short = "", False
        if what != SCAN:
            self._files.begin(what, self._folder(), {"position": list(self._place.xy_m())})
            return
        time, now_s = self._scan_time(), self._clock.now_s()
        facts = {"lines": [time.lines, time.line_s], "begun_s": now_s, "first_s": None, "seen_s": now_s}
        facts["started"] = self._started
        self._files.begin(what, self._folder(), {"frame": as_list(time.region), **facts})
        self._files.see_frame(time.region)

    def _watch_scan(self) -> None:
        running = self._files.running
        if running is None:  # stopped by a request
            return
        running["seen_s"] = self._clock.now_s()
        running["first_s"] = running["first_s"] or running["seen_s"]
        was_moved = self.is_moved
        self._files.see_frame(self._scan_time().region)
        if self.is_moved and not was_moved:
            self._log.warning("this scan will not be published: %s", _MOVED)

    @property
    def is_moved(self) -> bool:
        """True if the frame of the running scan was changed at the panel."""
        running = self._files.running
        return running is not None and bool(running.get("new_frame"))

    def end(self) -> None:
        running = self._files.running
        if running is not None and running["what"] == SCAN:
            self._by_hand = self._why_by_hand(running)
        self._files.end(self._clock.now_ns())

    def _why_by_hand(self, running: Entry) -> str:
        # Studio reports only that no scan runs any more. A scan that ends within its first line may have failed.
        lines, line_s = running["lines"]
        self._is_short = running["first_s"] is None or running["seen_s"] - running["first_s"] < line_s
        if self._is_short:
            return ""
        # by the lines as it was begun: a person who has made it faster since, and whose scan left no file, is at work
        shortest_s = self._files.shortest_s(lines, line_s)
        lasted_s = self._clock.now_s() - running["begun_s"]
        if lasted_s >= shortest_s:
            return ""
        return f"the scan ended after {lasted_s:.0f} s of at least {shortest_s:.0f} s, and no request had stopped it"

    def at_rest(self, state: ScopeState = ScopeState.FREE) -> ScopeStatus:
        if self._files.broken_off and not self._is_short:
            self._by_hand = self._by_hand or _PARTIAL
        return super().at_rest(state)

    def stopped_by_hand(self) -> str:
        """Return once the evidence that a person stopped the last scan; empty: there is none."""
        found, self._by_hand = self._by_hand, ""
        return found

    def start_scan(self) -> None:
        """Start a scan of the frame.

        Raises:
            Refused: Studio reports an error, or shows no scan within `settles_s`.
        """
        # A short scan may be over before the next poll: then the count of started scans has risen.
        before = self._session.scanning().started
        self._started = before + 1

        def is_seen() -> bool:
            seen = self._session.scanning()
            return seen.running or seen.started > before or self._files.has_file()

        self.started(SCAN, lambda: self._session.do(commands.START), is_seen)

    def start_curve(self) -> None:
        """Move the tip to its target position, where `status` takes a force curve on arrival.

        Raises:
            Refused: Studio does not move the tip.
        """
        self._stopping = False
        try:
            self._place.go()
        except Refused as refused:
            raise self.not_started(refused) from refused
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
            self._move("withdrawal", commands.WITHDRAW, self._session.stop_all)
        except ControllerLost as lost:
            # A Studio may serve one client only; the first connection then waits for the end of the withdrawal.
            self._log.warning("there is no further connection (%s): the tip is withdrawn by the first", lost)
            self._session.run(f"{self._session.stop_all} {self._session.path(commands.WITHDRAW)}() return 0")

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
