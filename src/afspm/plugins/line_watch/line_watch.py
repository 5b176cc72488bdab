"""`LineWatch`: the component that detects tip changes in the lines of a running scan."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from afspm import Component, Events, PublishedEvent
from afspm.basics import NS_PER_S, RequestError, UnitError, convert
from afspm.components import Array, ChannelPairing, HeightPair, MissingChannels, Publication, tip_verdict
from afspm.model import (
    HEIGHT,
    HEIGHT_RETRACE,
    ChannelName,
    ControlState,
    Feedback,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.plugins.line_watch.line_judge import (
    Alarm,
    AlarmLevel,
    Kind,
    LineJudge,
    ScanJudge,
    WholeScan,
    confidence,
)
from afspm.wire.messages import SpatialROIWithScoreList, WatchCounts

COUNTS = "WatchCounts"  # how many scans were watched: see `proto/lines.proto`
KEPT_TIMES = 16  # number of scans learnt from whose times are saved: a restarted process may receive them again
NOISIER = 1.12  # relative noise of the newest lines above which it is reported
_READ_WITHIN_S = 2.0  # a busy controller may answer later: then bias and speed count as unknown
_CARRIED = (names.TIP_BIAS_VOLTAGE, names.SCAN_SPEED)
_SCANS_WITHOUT_LINES = 3  # a short scan may end before its first lines are published


@dataclass
class _Lines:
    """The lines of the running scan.

    Attributes:
        began_ns: start time of the scan, as published with its lines.
        judge: judge of the lines; None if the scan is not judged.
        pictures: heights by channel, [y, x] in m; NaN where not received.
        taken: indices of the judged rows, in the order of judgement.
        is_disturbed: whether the feedback was changed or a problem was flagged since the start of the scan.
        is_noisier: whether more noise than usual was reported.
    """

    began_ns: int | None
    judge: ScanJudge | None
    pictures: dict[str, Array] = field(default_factory=dict)
    taken: list[int] = field(default_factory=list)
    is_disturbed: bool = False
    is_noisier: bool = False

    @property
    def downwards(self) -> bool:
        return len(self.taken) > 1 and self.taken[-1] < self.taken[0]


@dataclass
class _Finished:
    """The newest complete scan, from which the judge learns when the next scan begins.

    Attributes:
        is_whole: whether no alarm was raised, no problem flagged, and no feedback changed during the scan.
        is_trusted: whether the tip counts as good so far.
        is_doubted: whether an alarm is the only reason against it.
    """

    pair: HeightPair
    kind: Kind
    downwards: bool = False
    is_whole: bool = True
    is_trusted: bool = True
    is_doubted: bool = False


class _LaterStates:
    """The states of the microscope that were published after the packet being handled."""

    def __init__(self, events: Events) -> None:
        self._events = events
        self._kept: list[PublishedEvent] = []

    def since(self, packet_ns: int) -> list[PublishedEvent]:
        """Return the states after a time; forget the states before it."""
        self._kept += self._events.waiting()
        self._kept = [one for one in self._kept if (one.time_ns or 0) > packet_ns]
        return self._kept


class _MissingLines:
    """A reporter of successive scans without any lines.

    Args:
        started_ns: the start of this component: the lines of earlier scans are not cached.
    """

    def __init__(self, log: logging.Logger, started_ns: int) -> None:
        self._log, self._started_ns = log, started_ns
        self._has_begun = False
        self._count = 0

    def on_state(self, status: ScopeStatus, time_ns: int) -> None:
        if time_ns > self._started_ns:
            self._has_begun |= status.state is ScopeState.SCANNING

    def on_scan(self, *, has_lines: bool) -> None:
        if has_lines:
            self._count = 0
        elif self._has_begun:
            self._count += 1
            if self._count == _SCANS_WITHOUT_LINES:
                what = "no lines came of the last %d scans: nothing is watched. Does the microscope publish lines?"
                self._log.warning(what, self._count)
        self._has_begun = False


class LineWatch(Component):
    """A watch on running scans, which publishes the row at which their lines show that the tip has changed.

    With `action = "stop"` an alarm of the higher level also flags `tip-shape-changed`: the scheduler stops the scan, so
    its remaining time is saved. Each line is compared with an earlier scan of the place at the predicted drift; without
    an earlier scan, nothing is judged. The component learns from the first scans of each size, angle, number of pixels
    and setting of bias, speed and feedback, so the tip must be good then: the first scan judged is the fourth of a
    place, at later places the second. A scan teaches nothing if an alarm was raised, a problem flagged or the feedback
    changed during the scan, or if a `TipClassifier` judges it as bad. But two successive scans of a place that agree
    with each other replace the earlier scan from which they differ, as after the arrival of an adsorbate.

    The component publishes a `TipVerdict` with the row of the alarm, the first row with the change, and a confidence.
    After each complete scan it publishes `WatchCounts`: how many scans it watched so far, and how many lines came late.
    The confidence is 1 - exp(-5 evidence), where the evidence is relative to the threshold: an assumed decay, which
    ranks alarms and is no measured probability. A `ScanSeries` with `missed = "rest"` then measures only the rest of
    the scan. The microscope must publish lines of running scans. The experiment needs a `TipClassifier`, which
    judges complete scans: after an alarm, it finds when the tip is good again.

    Args:
        channel: channel of the heights, by role or name.
        retrace_channel: channel of their retrace; empty if not recorded.
        action: "look" only publishes the verdict, for a person; "stop" also flags the problem, so that the scan is
            stopped. How many good scans are stopped, see `docs/how-to/watch-running-scans.md`.
        problem: problem to flag.
    """

    flags: ClassVar = ("tip-shape-changed",)
    publishes: ClassVar = (tip_verdict.OF_LINES, COUNTS)
    listens: ClassVar = (
        "ScanLines", "Scan2d", "ScopeStateMsg", "ControlState", "ZCtrlParameters", tip_verdict.MESSAGE,
    )  # fmt: skip

    def __init__(
        self,
        channel: Annotated[ChannelName, HEIGHT] = HEIGHT,
        retrace_channel: Annotated[ChannelName, HEIGHT] = HEIGHT_RETRACE,
        action: Literal["stop", "look"] = "look",
        problem: str = "tip-shape-changed",
    ) -> None:
        self.channels = tuple(filter(None, (channel, retrace_channel)))
        self.pairing = ChannelPairing(channel, retrace_channel)
        self.action, self.problem = action, problem
        self.judge = LineJudge()
        self._lines: _Lines | None = None
        self._finished: _Finished | None = None
        self._doubted: WholeScan | None = None  # the newest complete scan, if it raised an alarm
        self._seen_ns: int | None = None  # time of the newest complete scan
        self._problems: tuple[int, ...] | None = None  # not known yet
        self._condition = ""
        self._carried = ""  # bias and speed of the newest scan
        self._refused: set[str] = set()
        self._not_judged: set[str] = set()  # reasons that were logged

    def on_start(self) -> None:
        self.expected = MissingChannels(self.channels, self.log)
        self._missing_lines = _MissingLines(self.log, self.clock.now_ns())
        self._later_states = _LaterStates(self.scope.events("ScopeStateMsg"))
        self._late = ExitStack()
        self._counts = WatchCounts(**self.memory.get("counts", {}))
        self._await_lines()
        if "line_judge" in self.memory:
            self.judge.restore(self.memory["line_judge"])

    def on_end(self) -> None:
        self._late.close()
        counts = self._counts
        what = "%d of %d complete scans were watched; %d lines came after the end of their scan"
        self.log.info(what, counts.watched, counts.complete, counts.late_lines)

    def on_control(self, control_state: ControlState) -> None:
        was, before = self._is_flagged, self._problems
        self._problems = control_state.problems
        if self._is_flagged and not was:
            self._finished = self._doubted = None  # perhaps with the bad tip
        if was and not self._is_flagged:
            self.log.info("the tip is another one now: earlier scans are no measure of it")
            self._forget()
        if self._problems and not before and self._lines is not None:
            self._lines.is_disturbed, self._lines.judge = True, None

    def on_feedback(self, feedback: Feedback) -> None:
        condition = "/".join(
            f"{value:.6g}"
            for value in (feedback.setpoint, feedback.proportional_gain, feedback.integral_gain)
            if value is not None
        )
        if self._lines is not None and condition != self._condition and not self._lines.is_disturbed:
            self.log.info("the feedback was changed during the scan: its further lines are not judged")
            self._lines.is_disturbed, self._lines.judge = True, None
        self._condition = condition

    def on_spatial_roi_with_score_list(self, message: SpatialROIWithScoreList) -> None:
        verdict, finished = tip_verdict.read_verdict(message), self._finished
        if verdict is None or finished is None or finished.pair.trace.time_ns != verdict[0]:
            return
        if verdict[1] == tip_verdict.BAD:
            finished.is_trusted = finished.is_doubted = False
        elif verdict[1] == tip_verdict.GOOD:
            finished.is_trusted = finished.is_whole  # also of a test scan that ends a repair

    def on_scan_lines(self, lines: ScanLines) -> None:
        with self.clock.late():
            self._take_lines(lines)
            self._await_lines()

    def _await_lines(self) -> None:
        # a fast simulated clock waits from the publication of lines until they are judged
        self._late.close()
        self._late.enter_context(self.clock.late(Publication.LINES))

    def _take_lines(self, lines: ScanLines) -> None:
        channel = next((one for one in self.channels if lines.is_of(one)), None)
        if channel is None:
            return
        try:
            values = lines.values * convert(1.0, lines.unit, "m")
        except UnitError as error:
            self._refuse(lines.channel, error)
            return
        if self._lines is None or self._lines.began_ns != lines.began_ns:
            self._begin(lines)
        running = self._lines
        assert running is not None
        picture = running.pictures.setdefault(channel, np.full(lines.shape, np.nan))
        if picture.shape != lines.shape:
            return  # of a scan whose lines carry no time
        picture[lines.first_row : lines.first_row + len(values)] = values
        self._judge(lines, running)

    def on_scan(self, scan: Scan) -> None:
        self.expected.see(scan)
        pair = self.pairing.add(scan)
        if pair is None:
            return
        running, self._lines = self._lines, None
        if scan.time_ns is not None and scan.time_ns <= self.memory.get("forgotten_ns", -1):
            return
        self._seen_ns = scan.time_ns
        if scan.time_ns is not None and scan.time_ns <= self.memory.get("newest_ns", -1):
            if scan.time_ns in self.memory.get("learnt_ns", ()):
                self._learn(_Finished(pair, self._kind(pair.trace)), again=True)
            return
        self._missing_lines.on_scan(has_lines=running is not None)
        self._learn_finished()
        is_whole = running is None or not (running.is_disturbed or (running.judge is not None and running.judge.alarm))
        downwards = running is not None and running.downwards
        self._count(running, scan.time_ns)
        has_no_problem = self._problems == () and (running is None or not running.is_disturbed)
        self._finished = _Finished(
            pair, self._kind(scan), downwards, is_whole, is_whole and has_no_problem, not is_whole and has_no_problem
        )

    def _count(self, running: _Lines | None, time_ns: int | None) -> None:
        # published while the run goes on: what a component publishes at its end is not in the record
        counts = self._counts
        counts.complete += 1
        counts.watched += running is not None and running.judge is not None
        numbers = {"complete": counts.complete, "watched": counts.watched, "late_lines": counts.late_lines}
        self.memory["counts"] = numbers  # a restart does not begin again at 0
        counts.timestamp.FromNanoseconds(self.clock.now_ns() if time_ns is None else time_ns)
        self.publish(counts, f"{COUNTS}_{self.name}")

    def on_state(self, status: ScopeStatus) -> None:
        self._missing_lines.on_state(status, (self.packet and self.packet.time_ns) or 0)

    def _forget(self) -> None:
        self._doubted = None
        self.judge.forget_places()
        # a restarted process receives the earlier scans again; only a test scan that ended the repair shows this tip
        finished = self._finished
        shows_tip = finished is not None and finished.is_trusted and finished.pair.trace.time_ns == self._seen_ns
        if self._seen_ns is not None:
            self.memory["forgotten_ns"] = self._seen_ns - 1 if shows_tip else self._seen_ns

    @property
    def _is_flagged(self) -> bool:
        return self.scope.problems.number(self.problem) in (self._problems or ())

    def _begin(self, lines: ScanLines) -> None:
        self._learn_finished()
        self._later_states.since(self._packet_ns)
        self._lines = _Lines(lines.began_ns, None)
        if self._problems == ():  # the scans of a repair are not the experiment's
            self._carried = self._bias_and_speed()
            kind = Kind.of(lines.region, lines.shape, self._condition_of(self._carried))
            self._lines.judge = self.judge.begin(
                lines.region, kind, self._time_s(lines.began_ns), channels=len(self.channels)
            )
            lacking = self.judge.lacking(lines.region, kind, channels=len(self.channels))
            if lacking and lacking not in self._not_judged:
                self._not_judged.add(lacking)
                self.log.info("the lines of this scan, and of others alike, are not judged: %s", lacking)

    def _judge(self, lines: ScanLines, running: _Lines) -> None:
        # a line is judged when all its channels have come; lines come in the order of the scan
        newest = range(lines.first_row, lines.first_row + len(lines.values))
        if running.taken:
            downwards = newest.stop <= running.taken[-1]
        else:  # the first lines of a scan may be many
            downwards = newest.start > 0 and newest.stop == lines.shape[0]
        for row in reversed(newest) if downwards else newest:
            line = [running.pictures[channel][row] for channel in self.channels if channel in running.pictures]
            if row in running.taken or len(line) < len(self.channels) or not all(map(_is_there, line)):
                continue
            running.taken.append(row)
            if running.judge is None:
                continue
            self._counts.late_lines += self._is_over()
            alarm = running.judge.add(row, line)
            if alarm is not None:
                self._announce(lines, running, alarm)
            if not (running.is_noisier or running.judge.alarm) and running.judge.noise >= NOISIER:
                running.is_noisier = True
                what = "row %d: the noise is %.2f times the noise of earlier scans"
                self.log.warning(what, row, running.judge.noise)

    def _announce(self, lines: ScanLines, running: _Lines, alarm: Alarm) -> None:
        stops = alarm.level is AlarmLevel.STOP and self.action == "stop"
        is_late = stops and self._is_late()
        stops = stops and not is_late
        self.log.warning(
            "row %d: %s%s", alarm.row, alarm.why, "; the scan is not worth finishing" if stops else "; have a look"
        )
        verdict = tip_verdict.LineVerdict(
            lines.region,
            lines.shape,
            lines.channel,
            lines.began_ns,
            alarm.row,
            alarm.since_row,
            running.downwards,
            confidence(alarm.evidence),
            stops,
            alarm.why,
        )
        # published first: a series that loses its scan looks for the row
        self.publish(tip_verdict.line_verdict_message(verdict), f"{tip_verdict.OF_LINES}_{self.name}")
        if is_late:
            self.log.warning("row %d came late: the scan is over already, and nothing is flagged", alarm.row)
        elif stops:
            self.scope.flag(self.problem)

    def _is_late(self) -> bool:
        # On a busy computer lines wait here, while the scan may end, the next one begin, and others find and repair the
        # tip. A flag would then stop a scan whose lines are not judged yet.
        return bool(self.scope.control_state.problems) or self._is_over()

    def _is_over(self) -> bool:
        if self.scope.state is not ScopeState.SCANNING:
            return True
        # states arrive while the packets before them still wait to be handled
        later = self._later_states.since(self._packet_ns)
        return any(event.message.state is not ScopeState.SCANNING for event in later)

    @property
    def _packet_ns(self) -> int:
        return (self.packet.time_ns if self.packet is not None else None) or 0

    def _learn_finished(self) -> None:
        finished, self._finished = self._finished, None
        if finished is None:
            return
        before, self._doubted = self._doubted, None
        if not (finished.is_trusted or finished.is_doubted):
            return
        if finished.is_trusted:
            self._learn(finished)
            return
        self._doubted = self._whole(finished)
        if before is not None and self._doubted is not None and self.judge.agree(before, self._doubted):
            self.log.info("two scans differ from the earlier one and agree: the newest is the reference from now on")
            self._doubted = None
            self._learn(finished, is_changed=True)

    def _learn(self, finished: _Finished, *, again: bool = False, is_changed: bool = False) -> None:
        scan, time_ns = self._whole(finished), finished.pair.trace.time_ns
        if scan is None:
            return
        only = again or is_changed
        self.judge.learn(scan.picture, scan.region, scan.kind, scan.at_s, downwards=scan.downwards, again=only)
        if not again and time_ns is not None:
            self.memory["newest_ns"] = time_ns
            self.memory["learnt_ns"] = [*self.memory.get("learnt_ns", ()), time_ns][-KEPT_TIMES:]
            self.memory["line_judge"] = self.judge.state()
            self.memory.save()

    def _whole(self, finished: _Finished) -> WholeScan | None:
        trace, retrace = finished.pair.trace, finished.pair.retrace
        try:
            picture = [one.values * convert(1.0, one.unit, "m") for one in (trace, retrace) if one is not None]
        except UnitError as error:
            self._refuse(trace.channel, error)
            return None
        return WholeScan(picture, trace.region, finished.kind, self._time_s(trace.time_ns), finished.downwards)

    def _bias_and_speed(self) -> str:
        # each measurement may carry its own; they are published at its end alone
        found = dict[str, float]()
        for name in _CARRIED:
            with suppress(RequestError):  # a microscope without it, or one that does not answer now
                found[name] = float(self.scope.get(name, timeout_s=_READ_WITHIN_S))
        return _carried_text(found)

    def _condition_of(self, carried: str) -> str:
        return f"{self._condition} {carried}".strip()

    def _kind(self, scan: Scan) -> Kind:
        if not (carried := _carried_text(scan.picture_settings) or self._carried):
            carried = self._carried = self._bias_and_speed()  # of a scan before this process was started
        return Kind.of(scan.region, scan.shape, self._condition_of(carried))

    def _time_s(self, time_ns: int | None) -> float:
        return self.clock.now_s() if time_ns is None else time_ns / NS_PER_S

    def _refuse(self, channel: str, error: UnitError) -> None:
        if channel not in self._refused:
            self._refused.add(channel)
            self.log.error("%s is not a height, so nothing is judged: %s", channel, error)


def _carried_text(values: Mapping[str, float]) -> str:
    return "/".join(f"{values[name]:.3g}" for name in _CARRIED if name in values)


def _is_there(values: Array) -> bool:
    return bool(np.isfinite(values).any())
