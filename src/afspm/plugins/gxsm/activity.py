"""State of GXSM, derived from polls: GXSM reports neither the start nor the end of a measurement.

Recordings of Gxsm3 and Gxsm4, and the source, agree: the number in the file names (`chfname(0)`) rises when a scan
begins, saved or not, and the lines (`y_current`) begin again. Either ends the scan before. A scan was complete if the
row scanned last differs from the row that the memory held before; otherwise it is not published.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final

from afspm.basics import Clock, Refused
from afspm.driver import SCAN, Activity, ControllerLost, Kept, TipWay, as_list
from afspm.model import ControlResponse, Region, ScopeState, ScopeStatus
from afspm.plugins.gxsm.errors import GxsmError
from afspm.plugins.gxsm.hardware import ABORT, AUTOSAVE, STATUS, Doing, Hardware, decoded, execute
from afspm.plugins.gxsm.link import Asking
from afspm.plugins.gxsm.result_files import OLD_COLUMNS, GxsmFiles, endings
from afspm.plugins.gxsm.scan_memory import (
    Rows,
    has_layers,
    has_new_row,
    has_old_columns,
    is_unfinished,
    looked_at,
    only,
)
from afspm.plugins.gxsm.settings import ScanFrame, subscan

SETTLES_S: Final = 0.3
"""Duration of GXSM's own work after the end of a scan; a file saved earlier has no end time."""
SHOWS_S: Final = 1.0
"""Longest delay until a started measurement shows in the status bits; measured: up to 0.3 s."""
_CHANNELS: Final = 40
_NO_CHANNEL: Final = "EE:"
_MOVED: Final = (
    "the frame was moved or turned during the scan, at GXSM's panel (opening a file sets it, too) or by another program"
)
_MULTI_LAYER: Final = "Multi Layer is on at GXSM's panel, and makes several scans of one: switch it off"
_REPEATS: Final = (
    "right after each of the last two scans of this run GXSM has begun another one by itself: Repeat, Movie or Multi "
    "Layer is on at its panel: switch it off"
)
_MOST_REPEATS: Final = 2
_ONLY_A_PART: Final = "SubScan is on at GXSM's panel and scans a part of the frame ({}): switch it off"


@dataclass(frozen=True)
class Saving:
    """The way of saving scans and spectra.

    Attributes:
        by_us: True if the translator triggers the saving of its own scans. GXSM saves all other scans by itself.
        scan_dir: folder of scans; None: the folder that GXSM reports for channels.
        probe_dir: folder of spectra; None: the folder of scans.
        switches_autosave: True if the translator switches Auto Save: off for its own scans, on at other times.
    """

    by_us: bool
    scan_dir: Path | None = None
    probe_dir: Path | None = None
    switches_autosave: bool = False


@dataclass
class LineWatch:
    """The last line reported by GXSM, and the direction of the lines; a reversed direction means another scan.

    The first change has no direction: GXSM reports the last line of the previous scan until the first line is complete.
    """

    line: int
    has_moved: bool = False
    step: int = 0
    stride: int = 0

    def is_near(self, last_row: int) -> bool:
        """Return whether the next look would have come after the last row."""
        return abs(last_row - self.line) <= self.stride + 1

    def turned(self, line: int, rows: int) -> bool:
        """Register a reported line; return True if this line reverses the direction."""
        # Gxsm4's simulator reports line -296 at the start of its first scan
        if line == self.line or not 0 <= line < rows:
            return False
        step = 1 if line > self.line else -1
        turned = self.step not in (0, step)
        self.line, self.stride = line, 0 if turned else abs(line - self.line)
        if self.has_moved:
            self.step = 0 if turned else step
        self.has_moved = True
        return turned


@dataclass
class ScanProgress:
    """The observed progress of the running scan.

    Attributes:
        endings: endings of the channels' file names; empty before the lines are read for the first time.
        name: path of the first channel's file, whose number rises with each scan; empty before the first poll.
        watch: direction of the lines; None before the first poll.
        goes_up: True if the top row of the picture is scanned last; None: unknown.
        settles_until_s, ended_ns: end of GXSM's own work after the scan, and end of the scan.
        lines: direction of the lines, counted from the last line of the previous scan; None before the first count.
        follows: True if the scan started before a poll showed the end of the previous scan.
        was_near_end: True if the last poll before the next scan showed this one at its end.
    """

    endings: list[str] = field(default_factory=list)
    name: str = ""
    watch: LineWatch | None = None
    goes_up: bool | None = None
    settles_until_s: float = 0.0
    ended_ns: int = 0
    lines: LineWatch | None = None
    follows: bool = False
    was_near_end: bool = False


@dataclass(frozen=True)
class ConnectedGxsm:
    """A connected GXSM: link, kind of hardware, frame.

    Attributes:
        ask: link with type-checked answers.
        hardware: kind of hardware driver, which defines the meaning of the status bits.
        frame: frame of the next scan.
        reports_subscan: True if GXSM has parameters for the part of the frame that *SubScan* scans.
    """

    ask: Asking
    hardware: Hardware
    frame: ScanFrame
    reports_subscan: bool = False

    @property
    def ends_early(self) -> bool:
        """True if the hardware may end a scan after its first line by itself."""
        return self.hardware is Hardware.SIMULATOR

    def doing(self) -> Doing:
        """Return the state that GXSM reports.

        Raises:
            BadReply: the value is not a set of bits.
        """
        return decoded(self.hardware, self.ask.numbers("rtquery", STATUS))


class AutosaveSwitch:
    """The switch of GXSM's Auto Save: on for scans from the panel, off for the translator's own scans.

    With *Repeat* on at the panel, no poll falls between two scans, and the next scan overwrites GXSM's memory: only
    GXSM itself can save there. Auto Save off for the whole run lost these scans, and those of a person while the
    translator was down. The price is a whole-looking file for each scan stopped at the panel.

    Attributes:
        on: state set by this translator; None: unknown.
    """

    def __init__(self, ask: Asking, *, is_used: bool) -> None:
        self._ask, self._is_used = ask, is_used
        self.on: bool | None = None

    def switch(self, *, on: bool) -> None:
        if self._is_used and self.on is not on:
            self._ask.call("action", AUTOSAVE[on])
            self.on = on


class GxsmActivity(Activity):
    """Measurements, moves and saving of one GXSM.

    Args:
        gxsm: the connection.
        files: the files of measurements.
        set_frame: returns the set frame of the next scan, and (rows, columns).
        kept: persistent, JSON-able: arrival time of the tip.
        shows_s: longest delay until a poll shows a started measurement, experiment time.
        saving: folders, and the use of Auto Save.
    """

    program: ClassVar[str] = "GXSM"

    def __init__(
        self,
        gxsm: ConnectedGxsm,
        files: GxsmFiles,
        kept: Kept,
        clock: Clock,
        log: logging.Logger,
        *,
        set_frame: Callable[[], tuple[Region, tuple[int, int]]],
        shows_s: float,
        saving: Saving,
    ) -> None:
        super().__init__(files, clock, log)
        self.gxsm = gxsm
        self._set_frame = set_frame
        self._files = files
        self._shows_s = shows_s
        self._saving = saving
        self._autosave = AutosaveSwitch(gxsm.ask, is_used=saving.switches_autosave)
        self._way = TipWay(kept, clock)
        self._looked_ns = 0  # time of the last poll
        self._shows_until_s = 0.0
        self._scan = ScanProgress()
        self._repeats = 0  # scans of the run in a row after which GXSM has begun another one by itself
        self._seen_last: tuple[tuple[int, int], Rows | None] = (0, 0), None

    # --- start and stop ---

    def require_channels(self) -> None:
        """Raise ControllerLost if GXSM reports no channel, although it reported channels earlier in this run.

        After a restart Gxsm4 has no channels. A scan would only open a dialog, which takes all later starts, too.
        """
        if self._files.channels and all(self._reported(channel) is None for channel in range(_CHANNELS)):
            self._files.end_with_gxsm()
            hint = (
                "set the channels at its panel, close its dialog about them, and start a scan there:"
                " GXSM reports a channel only from its first scan on"
            )
            raise ControllerLost("GXSM reports no channel, as after a restart; nothing is begun", hint=hint)

    def look(self) -> None:
        """Register the files that are there before a measurement: they are not its results."""
        folder = self._folder()
        self._files.look(folder, self._saving.probe_dir or folder)

    def start_scan(self) -> None:
        """Start a scan.

        Raises:
            Refused: *SubScan* restricts the scan to a part of the frame, or GXSM repeats scans by itself.
            ControllerLost: see `require_channels`.
        """
        self.require_channels()
        if self._repeats >= _MOST_REPEATS:
            self._repeats = 0  # a person may have switched it off; GXSM does not report it
            raise Refused(ControlResponse.ACTION_ERROR, _REPEATS)
        part = self._part(self._set_frame()[1])
        if part:
            raise Refused(ControlResponse.ACTION_ERROR, _ONLY_A_PART.format(part))
        self._autosave.on = None  # unknown: a person may have switched Auto Save at the panel
        self._autosave.switch(on=False)
        self._begin_scan(self._clock.now_ns(), own=True)
        self._scan.lines = LineWatch(int(self.gxsm.ask.number("y_current")))
        rows, columns = self._set_frame()[1]
        # a scan that is stopped or does not start is recognised by rows that still hold the previous scan
        looked = {0, rows - 1, *self._third_rows(rows)}
        self._files.looked(looked_at(self.gxsm.ask, len(self._channels()), looked, columns), None)
        self._shows_until_s = self._clock.now_s() + self._shows_s
        # returns 0 at once, even if no scan starts (no channel is set, or a scan is running)
        self.gxsm.ask.call("startscan")

    def start_curve(self, kind: str, position_m: tuple[float, float], way_s: float) -> None:
        """Start to move the tip; `status` starts the spectrum once the tip has arrived.

        Args:
            position_m: (x, y).
            way_s: longest duration of the move, experiment time.

        Raises:
            Refused: the position is outside the scan frame.
        """
        self.gxsm.frame.move_tip(position_m)
        self.sets_out(way_s)
        self._begin_curve(kind, position_m)
        self.curve_awaited = kind

    def stop_scan(self) -> None:
        self.gxsm.ask.call("stopscan")
        self.stopped()

    def stop_curve(self) -> None:
        """Stop the spectrum; before its start, cancel the spectrum and let the tip finish its move."""
        if not self.curve_awaited:
            self.gxsm.ask.call("action", ABORT)
        self.stopped()

    def sets_out(self, way_s: float) -> None:
        """Register a move of at most `way_s`, experiment time, which starts when the previous move has ended."""
        self._way.sets_out(way_s, after_last_way=True)

    def next_change_s(self) -> float | None:
        """Return the time of the next expected change, in experiment time; None: no change is expected.

        Changes are the arrival of the tip, the deadline of a visible start, the end of settling, and the deadline of
        awaited files.
        """
        now_s = self._clock.now_s()
        times = (self._way.arrives_s, self._shows_until_s, self._scan.settles_until_s, self._files.next_s() or 0.0)
        return min((at_s for at_s in times if at_s > now_s), default=None)

    # --- what goes on ---

    def endings(self) -> list[str]:
        """Return the endings of the running scan's file names.

        Empty until a poll shows the scan: up to then, GXSM still reports the names of the previous scan.
        """
        if self._files.what != SCAN or self._shows_until_s > 0.0:
            return []
        if not self._scan.endings:
            self._scan.endings = [next(iter(endings([Path(path)])), "") for path in self._channels()]
        return self._scan.endings

    def lines_done(self) -> int:
        """Return the index of GXSM's current line: at least as many lines of the running scan are complete.

        0 until the lines are seen to go down. In a scan from bottom to top GXSM's index says how many are left.
        """
        line, rows = int(self.gxsm.ask.number("y_current")), self._files.scanning[1][0]
        if self._scan.lines is None:
            self._scan.lines = LineWatch(line)
        was_up = self._scan.lines.step < 0
        self._scan.lines.turned(line, rows)
        if self._scan.lines.step < 0 and not was_up:
            self._log.info("this scan goes from bottom to top: its lines are published only with the whole scan")
        return line if self._scan.lines.step > 0 else 0

    def status(self) -> ScopeStatus:
        """Return the present state; register starts and ends of measurements, and start an awaited spectrum."""
        doing, now_s = self.gxsm.doing(), self._clock.now_s()
        # RPSPMC has one bit for scans, spectra and its own vector programs, which also move the tip
        led = self.gxsm.hardware is Hardware.RPSPMC and self._way.is_on
        if self.curve_awaited and doing.measuring and not led:
            return self._forestalled()
        if self.curve_awaited:
            if not doing.moving and not self._way.is_on:
                self._take_curve(now_s)
            return ScopeStatus(ScopeState.SPEC)
        if doing.measuring and not (led and not self._files.what):
            return self._measuring(doing)
        self._looked_ns = self._clock.now_ns()
        moving = doing.moving or self._way.is_on
        # the spectrum may have been stopped before its start, while the tip was still moving
        if self._stopping and (moving or (self._autosave.on is False and not self._is_settled(now_s))):
            return ScopeStatus(ScopeState.INTERRUPTED)
        self._stopping = False
        what = self._files.what
        if what and now_s < self._shows_until_s:
            return ScopeStatus(ScopeState.SCANNING if what == SCAN else ScopeState.SPEC)
        if what == SCAN and not self._is_settled(now_s):
            return ScopeStatus(ScopeState.SCANNING)
        if what:
            self._repeats = 0 if what == SCAN and self._files.is_own else self._repeats
            self.end()
        self._autosave.switch(on=True)
        if doing.approaching:
            return ScopeStatus(ScopeState.COARSE_MOTOR)
        return ScopeStatus(ScopeState.MOVING) if moving else self.at_rest()

    def _measuring(self, doing: Doing) -> ScopeStatus:
        is_moved = self._watch_place()
        if self._files.what == SCAN and doing.scanning and self._is_another():
            self._follow()
            if is_moved:  # in either of the two
                self._files.spoil(_MOVED)
        self._shows_until_s = self._scan.settles_until_s = 0.0
        if not self._files.what and not self._stopping:  # started at the panel
            self.begin(SCAN if doing.scanning else "VP")
        if self._files.what:
            self._files.ran()
        if self._files.what == SCAN and self._files.before is None:
            self._look_at_memory()
        self._looked_ns = self._clock.now_ns()
        curve = doing.probing and (self._files.what not in ("", SCAN) or not doing.scanning)
        return ScopeStatus(ScopeState.SPEC if curve else ScopeState.SCANNING, doing.paused or None)

    def _watch_place(self) -> bool:
        # GXSM moves the tip with the frame at once, and its files have the frame of the scan's start alone.
        if self._files.what != SCAN or self.gxsm.frame.place() == self._files.place:
            return False
        if not self._files.spoiled:
            self._log.warning("%s: this scan will not be published", _MOVED)
        self._files.spoil(_MOVED)
        return True

    def _part(self, shape: tuple[int, int]) -> str:
        return subscan(self.gxsm.ask, shape) if self.gxsm.reports_subscan else ""

    def _is_another(self) -> bool:
        # A repeated scan starts sooner than the next poll, so no poll shows the end of its predecessor. Two facts
        # reveal the new scan: a new number in the file names, and lines that start from the beginning.
        before, name = self._scan.name, self.gxsm.ask.text("chfname", 0)
        self._scan.name = name
        # after saving, GXSM reports the next free number if the first number was taken: no sign of another scan
        is_another = bool(before) and name != before and not self._files.is_written(Path(self._absolute(name)))
        if self._files.is_own:  # Repeat is off: no scan follows by itself
            return is_another
        line, watch = int(self.gxsm.ask.number("y_current")), self._scan.watch
        if watch is None:
            self._scan.watch = LineWatch(line)
            return is_another
        if watch.step:
            self._scan.goes_up = watch.step < 0
        self._scan.was_near_end = watch.is_near(self._last_row())
        return watch.turned(line, self._files.scanning[1][0]) or is_another

    def _follow(self) -> None:
        # GXSM's memory already holds the next scan: only files that GXSM saved show whether the previous scan was
        # complete.
        self._log.warning("another scan was begun at GXSM's panel before the last one was seen to end")
        self._repeats += self._files.is_own
        channels, folder, before = self._channels(), self._folder(), self._before()
        if self._files.is_own and has_layers(self.gxsm.ask):
            self._files.spoil(_MULTI_LAYER)
        name, ended_ns, now_ns = self._scan.name, self._scan.ended_ns, self._clock.now_ns()
        near_end = self._scan.was_near_end
        self._files.end(ended_ns or now_ns, now_ns, channels, folder, is_whole=None, before=before, near_end=near_end)
        self._begin_scan(self._looked_ns, own=False)
        self._autosave.switch(on=True)
        self._scan.name, self._scan.follows = name, True
        self._seen_last = (0, 0), None

    def _look_at_memory(self) -> None:
        # Near its last row the scan may already have overwritten the previous scan there: no comparison is possible.
        rows, columns = self._files.scanning[1]
        found = looked_at(self.gxsm.ask, len(self._channels()), (0, rows - 1), columns)
        line = int(self.gxsm.ask.number("y_current"))
        if abs(line - self._last_row()) > 1:
            self._files.looked(found, line)

    def _last_row(self) -> int:
        goes_up = self._files.upwards if self._scan.goes_up is None else self._scan.goes_up
        return 0 if goes_up else self._files.scanning[1][0] - 1

    def _third_rows(self, rows: int) -> set[int]:
        # In either direction. GXSM's simulator ends a scan by itself if its first line takes long, with some channels
        # of the second line in memory: only a scan of more lines was ended by a person.
        return {2, rows - 3} - {0, 1, rows - 2, rows - 1} if self.gxsm.ends_early else set()

    def _before(self) -> Rows | None:
        # Rows of the previous scan that must have changed when this scan is complete.
        if self._files.before is None:
            return None
        rows, line = self._files.before
        if line is None:
            return only(rows, 0, self._files.scanning[1][0] - 1)
        last = self._last_row()
        return only(rows, last) if abs(line - last) > 1 else None

    def _is_settled(self, now_s: float) -> bool:
        if not self._scan.settles_until_s:
            self._scan.settles_until_s, self._scan.ended_ns = now_s + SETTLES_S, self._clock.now_ns()
            self._watch_place()
        return now_s >= self._scan.settles_until_s

    def _forestalled(self) -> ScopeStatus:
        # The spectrum must not be taken: it would end up in the measurement that a person has started meanwhile.
        self.curve_awaited = ""
        self._way.give_up()
        self.forget()
        return self.fail("the spectrum was not taken: another measurement began while the tip moved")

    def _take_curve(self, now_s: float) -> None:
        action, self.curve_awaited = execute(self.curve_awaited), ""
        self._shows_until_s = now_s + self._shows_s
        self.gxsm.ask.call("action", action)

    def begin(self, what: str) -> None:
        """Register a measurement that the panel started since the last poll."""
        if what != SCAN:
            self._begin_curve(what, self.gxsm.frame.tip())
            return
        self._begin_scan(self._looked_ns, own=False)
        self._autosave.switch(on=True)
        self._is_another()  # the first observation, for comparison with later ones

    def _begin_scan(self, begun_ns: int, *, own: bool) -> None:
        self._stopping, self._scan = False, ScanProgress()
        region, shape = self._set_frame()
        taken = {"frame": as_list(region), "shape": list(shape), "place": self.gxsm.frame.place()}
        by_gxsm = not (own and self._saving.by_us)
        self._files.begin(SCAN, self._folder(), begun_ns, taken, own=own, by_gxsm=by_gxsm)
        if not own and (part := self._part(shape)):  # an own scan of a part was refused
            self._files.spoil(_ONLY_A_PART.format(part))

    def _begin_curve(self, kind: str, position_m: tuple[float, float]) -> None:
        self._stopping = False
        folder = self._saving.probe_dir or self._folder()
        self._files.begin(kind, folder, 0, {"position": list(position_m)})

    def stopped(self) -> None:
        self._shows_until_s = 0.0
        super().stopped()

    def end(self) -> None:
        if self._files.what != SCAN:
            now_ns = self._clock.now_ns()
            self._files.end(now_ns, now_ns)
            return
        is_whole = self._is_whole()
        has_third_row = is_whole is False and self._has_third_row()
        if is_whole and not self._files.spoiled and not self._files.is_saved_by_gxsm:
            try:
                # `autosave` returns the line, not a path; a second call would save the scan again
                self.gxsm.ask.call("autosave")
            except GxsmError as error:
                self._log.error("the scan can't be saved: %s", error)
        # not earlier: up to 40 ms after a start GXSM still reports the paths of the previous scan
        channels, folder = self._channels(), self._folder()
        now_ns, ended_ns = self._clock.now_ns(), self._scan.ended_ns
        self._files.end(ended_ns, now_ns, channels, folder, is_whole=is_whole, has_third_row=has_third_row)

    def _is_whole(self) -> bool | None:
        # None: the scan followed another scan at once, and no poll came early enough to read the previous rows.
        before, (_, shape) = self._before(), self._files.scanning
        if before is None and self._seen_last[0] == shape:  # a short scan from the panel
            before = self._seen_last[1]
        columns = shape[1] if before is None else before["columns"]
        after = looked_at(self.gxsm.ask, len(self._channels()), (0, shape[0] - 1), columns)
        self._seen_last = shape, after
        if before is None:
            return None if self._scan.follows else True
        if has_old_columns(before, after):
            self._files.spoil(OLD_COLUMNS)
        return not is_unfinished(before, after)

    def _has_third_row(self) -> bool:
        if self._files.before is None:
            return False
        rows = self._files.scanning[1][0]
        before = only(self._files.before[0], *self._third_rows(rows))
        after = looked_at(self.gxsm.ask, len(self._channels()), self._third_rows(rows), before["columns"])
        return has_new_row(before, after)

    def _folder(self) -> Path | None:
        # Before the first scan GXSM reports no folder, and saves to the folder in which it was started.
        if self._saving.scan_dir:
            return self._saving.scan_dir
        channels = self._channels(1)
        return Path(channels[0]).parent if channels else self.gxsm.ask.working_folder()

    def _channels(self, most: int = _CHANNELS) -> list[str]:
        found: list[str] = []
        for channel in range(most):
            # GXSM has no list of channels: the first unused number ends it
            path = self._reported(channel)
            if path is None:
                break
            found.append(self._absolute(path))
        return found

    def _reported(self, channel: int) -> str | None:
        path = self.gxsm.ask.text("chfname", channel)  # "EE: invalid channel" for an unused number
        return None if path.startswith(_NO_CHANNEL) else path

    def _absolute(self, path: str) -> str:
        # "./name" is relative to the folder in which GXSM was started.
        folder = None if path.startswith("/") else self.gxsm.ask.working_folder()
        return path if folder is None else str(folder / path)
