"""Scans by plan: one region repeatedly, a list of regions, or a grid. A restart repeats no scan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import UTC
from typing import Any, Literal

from afspm.basics import Angle, ControlLost, RequestError
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import ConfigError, InvalidValue, Refused, UnitError
from afspm.basics.formatting import counted, day_and_time
from afspm.basics.units import Duration, Length, Period, convert, si
from afspm.client.component import Component
from afspm.client.events import PublishedEvent
from afspm.client.parameter_text import to_parameter
from afspm.components import tip_verdict
from afspm.components.pace import Pace
from afspm.components.scan_plan import (
    XY,
    PlanRest,
    PlanStep,
    RefusedPlaces,
    Retakes,
    RoundSchedule,
    ScanPlan,
    grid_centers,
    rounds_within,
)
from afspm.model import Region, ScanSet, ScopeState, ScopeStatus, names
from afspm.model.parameter_names import UNITS_OF_REQUESTS
from afspm.model.planned_work import PlannedWork, planned_rounds

Pixels = tuple[int, int]
VERDICT_WITHIN_S = 10.0
"""Limit on the wait for the verdict on the last scan, in real time."""
# parameters that every scan with a region needs of the microscope
FRAME = (names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y, names.SCAN_SIZE_X, names.SCAN_SIZE_Y)


Missed = Literal["extend", "catch-up", "skip", "rest"]
_MISSED: dict[Missed, str] = {
    "extend": "to be taken at the end",
    "rest": "to be taken at the end",
    "catch-up": "to be taken now, one after the other",
    "skip": "skipped",
}


class PlannedScans(Component):
    """The scans of a plan. Derive from this class for a plan of your own; set `plan` (and `beat_s`) in `__init__`.

    Each scan has a key, so a restart after a kill neither repeats nor omits a scan. While control is lost (to the
    repair of a tip, to a person) the scan waits; an interruption is logged. Scans are left out only as `missed` and
    `ends_on_time` define, and where one of several regions is refused: an error in the log and a note say so. If all
    regions are refused, or ten in a row, the component ends with the reason.

    Args:
        keep_control: whether to keep control between scans; by default others may measure meanwhile.
        end_when_done: whether to end the whole experiment after the last scan.
        parameters: the settings of each scan, e.g. {scan-speed = "2 um/s"}: set right before it, and set back for the
            measurements of other components.
        settle: experiment time after a change of bias, setpoint or gains, before a scan begins; by default as in
            [control].
        missed: treatment of scans that were due while control was lost (MANUAL, the repair of a tip). "extend": they
            are taken after the others, with the same period; "catch-up": at once, one after the other; "skip": never;
            "rest": as "extend", and of a scan that a `LineWatch` stopped only the rows since the change are taken.
        retakes: how often a complete scan is taken again if a component, such as `TipClassifier`, judges it to show a
            bad tip: after the repair, before the next scan, with the bad one left in the record. 0: never.

    Attributes:
        plan: the regions, and the number of rounds.
        beat_s: experiment time between the starts of two rounds; 0: no pause.
        ends_on_time: whether rounds that are left out because a round takes longer than the period count as taken, so
            that the plan ends on time. Rounds missed while no process ran, before a restart, don't count.
    """

    needs_actions = (names.START_SCAN,)
    plan: ScanPlan
    beat_s = 0.0
    ends_on_time = False

    def __init__(
        self,
        keep_control: bool = False,
        end_when_done: bool = False,
        parameters: dict[str, str | float] | None = None,
        missed: Missed = "extend",
        retakes: int = 0,
        settle: Duration | None = None,
    ) -> None:
        if retakes < 0:
            raise ConfigError(f"{retakes} retakes", where="retakes", hint="0 or more")
        self.retakes, self.settle = retakes, settle
        self.keep_control, self.end_when_done, self.missed = keep_control, end_when_done, missed
        self.parameters = checked_parameters(parameters, "parameters")
        self.needs_parameters = (*FRAME, *self.parameters)

    def planned_work(self, speed_m_s: float | None) -> PlannedWork | None:
        plan = self.plan
        if plan.shape is None:
            return None
        speed_m_s = speed_in_force(self.parameters, speed_m_s)
        late = self.ends_on_time
        work = planned_rounds(plan.regions, plan.shape, plan.rounds, self.beat_s, speed_m_s, skips_late=late)
        return replace(work, ends_experiment=self.end_when_done)

    def run(self) -> None:
        self._began_s = self.clock.now_s()
        self._round_began_s: float | None = None  # None: the round was interrupted, or begun before a restart
        self.memory.setdefault("start_s", self._began_s)
        rhythm = RoundSchedule(float(self.memory["start_s"]), self.beat_s)
        self.memory.save()
        self._pace = Pace(self.scope, self.memory)
        done = int(self.memory.get("done", 0))
        if done and done != self._total:
            self.log.info("going on with scan %d%s", done + 1, self._of_total())
        self._retakes = Retakes(self.retakes, self.memory)
        self._refused = RefusedPlaces(len(self.plan.regions), self.memory)
        self._verdicts = self.scope.events(tip_verdict.MESSAGE) if self.retakes else None
        with (
            self.scope.control() if self.keep_control else nullcontext(),
            self.scope.settings(self.parameters, settle=self.settle),
        ):
            for step in self.plan.steps(done):
                if not self._await(step, rhythm):
                    break
                # a scan that was running at a restart comes first: nothing was due when it began
                if step.index != done or self._retakes.due:
                    self._retake()
                self._take(step)
            self._retake()
            while self._is_last_bad():
                self._retake()
        left_out, refused = (self.plan.total or 0) - (self._total or 0), self._refused.number
        taken = "the scan is" if self._total == 1 else f"all {self._total} scans are"
        if refused or left_out:
            taken = f"{(self._total or 0) - refused} of {self.plan.total} scans are"
        self.log.info("%s taken%s", taken, f"; the time of {left_out} had passed" if left_out else "")
        if self.end_when_done:
            self.scope.end_experiment()

    def _await(self, step: PlanStep, rhythm: RoundSchedule) -> bool:
        if not step.starts_round or self.memory.get("begun") == step.index:
            return True
        if not self.beat_s:  # no round has a time of its own, so there is nothing to wait for or to keep
            return self._total is None or step.index < self._total
        due_s = rhythm.next_due_s(self.memory.get("done_s"))
        before_s = float(self.memory.get("due_s", due_s))
        left_out = rhythm.left_out(max(before_s, self._began_s), due_s)
        if self._total is not None:  # periods after the planned end had no scan
            left_out = min(left_out, max(0, self._total - step.index) // len(self.plan.regions))
        too_slow = rhythm.too_slow_for(left_out, float(self.memory.get("pace_s", 0.0)))
        if too_slow and not self.memory.setdefault("is_slow", False):
            self.memory["is_slow"] = True
            self.log.warning(
                "a round takes %.0f s, longer than its period of %.0f s", self.memory["pace_s"], self.beat_s
            )
        self._add("missed", too_slow if self.ends_on_time else 0)
        self._on_missed(left_out - too_slow)
        if self.memory.get("owed"):
            self._add("owed", -1)
            due_s -= self.beat_s  # begun at once, in place of a missed round
        is_left = self._total is None or step.index < self._total
        if is_left:
            self.scope.sleep(max(0.0, due_s - self.clock.now_s()))
            self.memory["begun"] = step.index
        # saved before the request: a scan interrupted by a kill still belongs to this beat
        self.memory["due_s"] = due_s
        with self.clock.late():
            self.memory.save()
        return is_left

    def _on_missed(self, rounds: int) -> None:
        if not rounds:
            return
        if self.missed == "skip":
            self._add("missed", rounds)
        elif self.missed == "catch-up":
            self._add("owed", rounds)
        count = rounds * len(self.plan.regions)
        # for want of control, or because this computer was slow
        message = f"{counted(count, 'scan')} could not begin in time; {_MISSED[self.missed]}"
        self.log.warning("%s", message)
        self._note(message)

    def _add(self, counter: str, rounds: int) -> None:
        self.memory[counter] = int(self.memory.get(counter, 0)) + rounds

    def _take(self, step: PlanStep) -> None:
        if step.starts_round:
            self._round_began_s = self.clock.now_s()
        try:
            scans = self._measured(step)
        except Refused as refused:
            self._refused.add(refused)
            self._leave_out(step, refused)
            self._round_began_s = None
            self.memory["done"], self.memory["done_s"] = step.index + 1, self.clock.now_s()
            self._pace.note()
            self.memory.save(synced=False)
            self._tell_progress(step.index + 1)
            return
        self._refused.accepted()
        if scans.interruptions:
            self._round_began_s = None
        if self._round_began_s is not None and (step.index + 1) % len(self.plan.regions) == 0:
            round_s = self.clock.now_s() - self._round_began_s
            # the fastest round counts, since a slower round may have waited for control
            self.memory["pace_s"] = min(round_s, float(self.memory.get("pace_s", round_s)))
        self.memory["done"], self.memory["done_s"] = step.index + 1, self.clock.now_s()
        self._pace.note()
        self._save_taken(step, 0, scans)
        self._tell_progress(step.index + 1)
        self._log_taken(step, scans)

    def _tell_progress(self, done: int) -> None:
        if (total := self._total) is not None:
            # as fast as so far, but not faster than `every` allows
            least_s = self.beat_s / len(self.plan.regions)
            self.scope.progress(done, total, left_s=self._pace.left_s(done, total, least_s))

    def _leave_out(self, step: PlanStep, refused: Refused) -> None:
        message = f"scan {step.index + 1} is left out: {refused.reason}"
        self.log.error("%s", message)
        self._note(message)

    def _note(self, message: str) -> None:
        with suppress(RequestError):  # a scheduler of another make may have no notes
            self.scope.note(message)

    def _retake(self) -> None:
        self._judge()
        while (due := self._retakes.due) is not None:
            index, again = due
            step = self.plan.step(index).again(again)
            self._round_began_s = None  # a repetition would count as the pace of a round
            self.log.warning("scan %d showed a bad tip, and is taken again", index + 1)
            self.memory.save()  # before the request: a restart requests the same scan first
            try:
                scans = self._measured(step)
            except Refused as refused:
                self._retakes.add(index, again, ())
                self._leave_out(step, refused)
            else:
                self._save_taken(step, again, scans)
                self._log_taken(step, scans, " again")
            self._judge()

    def _judge(self) -> None:
        messages = [event.message for event in self._verdicts.waiting()] if self._verdicts else ()
        verdicts = (tip_verdict.read_verdict(message) for message in messages)
        for index in self._retakes.judge(verdict for verdict in verdicts if verdict is not None):
            self.log.warning("scan %d showed a bad tip again, and is left so", index + 1)

    def _is_last_bad(self) -> bool:
        if self.retakes:
            is_judged = self.scope.wait_until(self._newest_is_judged, timeout_s=VERDICT_WITHIN_S)
            if not is_judged and not self._retakes.has_verdicts:
                self.log.warning("no scan was taken again, as no verdict has arrived: does a component judge scans?")
        return self._retakes.due is not None

    def _newest_is_judged(self) -> bool:
        self._judge()
        return not self._retakes.awaits_newest

    def _measured(self, step: PlanStep) -> ScanSet:
        return self._scan_rest(step) if self.missed == "rest" and step.shape else self._scan(step)

    def _save_taken(self, step: PlanStep, again: int, scans: ScanSet) -> None:
        self._retakes.add(step.index, again, (scan.time_ns for scan in scans.values()))
        rest = self._rest_of(step)
        if rest is not None:
            del self.memory["rest"]
        if self.memory.save(synced=False):  # if not saved, a restart requests the same scan
            self.scope.forget((rest.of(step) if rest else step).key)
        for interruption in scans.interruptions:
            self.log.warning("%s was interrupted, and taken again: %s", step.key, interruption)

    def _log_taken(self, step: PlanStep, scans: ScanSet, again: str = "") -> None:
        at = "" if scans.time_ns is None else f" at {day_and_time(scans.time_ns, UTC)}"
        self.log.info("scan %d%s%s%s", step.index + 1, self._of_total(), again, at)

    def _scan(self, step: PlanStep, *, repeat: bool = True) -> ScanSet:
        return self.scope.scan(step.region, shape=step.shape, key=step.key, repeat=repeat)

    def _rest_of(self, step: PlanStep) -> PlanRest | None:
        # after a restart, a scan with a bad tip may be taken again before the interrupted one
        key, *rows = self.memory.get("rest", ("",))
        return PlanRest(*rows) if key == step.key else None

    def _scan_rest(self, step: PlanStep) -> ScanSet:
        rows, _ = step.shape or (0, 0)
        rest = self._rest_of(step) or PlanRest(0, rows - 1)
        with self.scope.events(tip_verdict.OF_LINES, "ScopeStateMsg") as events:
            while True:
                part, lasted_ns = rest.of(step), None
                published: list[PublishedEvent] = []
                try:
                    return self._scan(part, repeat=False)
                except ControlLost as lost:
                    self._round_began_s = None
                    self.log.warning("%s: %s", part.key, lost.what)
                    published += events.waiting()
                    lasted_ns = _newest_scan_ns(published)
                except Refused as refused:
                    if part is step:
                        raise
                    self.log.warning("%s can't be taken alone: %s; all rows are taken again", part.key, refused.reason)
                    rest = PlanRest(0, rows - 1)
                    self.memory.pop("rest", None)
                    self.memory.save()
                with self.scope.control():  # in control again: the tip is repaired, and all verdicts have arrived
                    pass
                published += events.waiting()
                rest = self._since_change(step, rest, published, lasted_ns)

    def _since_change(
        self, step: PlanStep, rest: PlanRest, published: Sequence[PublishedEvent], lasted_ns: tuple[int, int] | None
    ) -> PlanRest:
        part = rest.of(step)
        messages = (event.message for event in published if not isinstance(event.message, ScopeStatus))
        verdicts = [
            verdict for verdict in map(tip_verdict.read_line_verdict, messages) if verdict is not None and verdict.stops
        ]
        # of this scan only: a verdict on an earlier scan, or on another component's scan, would leave out rows here
        stopping = [verdict for verdict in verdicts if verdict.shape == part.shape and _is_of(verdict, lasted_ns)]
        if not stopping:
            return rest
        # a restarted or second watch may have seen the change later: the verdict that leaves the most rows counts
        rests = [rest.since(verdict.since_row, downwards=verdict.downwards) for verdict in stopping]
        rest = max(rests, key=lambda left: left.last - left.first)
        self.log.info("%s: rows %d to %d are left", part.key, rest.first, rest.last)
        # saved before the request: after a kill the same rows are requested, under the same key
        self.memory["rest"] = [step.key, rest.first, rest.last]
        self.memory.save()
        return rest

    @property
    def _total(self) -> int | None:
        missed = int(self.memory.get("missed", 0)) * len(self.plan.regions)
        return None if self.plan.total is None else max(self.plan.total - missed, int(self.memory.get("done", 0)))

    def _of_total(self) -> str:
        return "" if self._total is None else f" of {self._total}"


class ScanSeries(PlannedScans):
    """The same region again and again, with a period, for a number of scans or a duration.

    With neither `scans` nor `duration` the series continues until another component or a person ends the experiment.

    Args:
        size: (width, height) of the region, e.g. ["2 um", "2 um"].
        center: (x, y) of the middle of the region.
        angle: angle of the region, counter-clockwise.
        pixels: (columns, rows).
        every: experiment time from the start of one scan to the start of the next; 0 for no pause.
        scans: number of scans.
        duration: time within which scans are started (instead of `scans`); needs `every`.
    """

    def __init__(
        self,
        size: tuple[Length, Length],
        center: tuple[Length, Length] = (0.0, 0.0),
        angle: Angle = 0.0,
        pixels: Pixels = (128, 128),
        every: Period = 0.0,
        scans: int | None = None,
        duration: Period | None = None,
        **planned: Any,
    ) -> None:
        super().__init__(**planned)
        self.beat_s = period(every)
        if scans is not None and duration is not None:
            raise ConfigError("both `scans` and `duration` are given", hint="give one of them")
        rounds = scans if duration is None else rounds_within(duration, every)
        if self.end_when_done and rounds is None:
            raise ConfigError("`end_when_done` without an end", hint="give `scans` or `duration`")
        self.plan = _plan((Region(pair(center), pair(size), angle),), pixels, rounds)
        self.ends_on_time = duration is not None


@dataclass(frozen=True)
class ListedRegion:
    """A region in an experiment file: {center = ["1 um", "0 um"], size = ["500 nm", "500 nm"], angle = "30 deg"}."""

    center: tuple[Length, Length]
    size: tuple[Length, Length]
    angle: Angle = 0.0

    @property
    def region(self) -> Region:
        return Region(pair(self.center), pair(self.size), self.angle)


class ScanList(PlannedScans):
    """Regions of a list, in order, in one or more rounds. Refused regions are left out; the log and a note say so.

    Args:
        regions: list of regions, each with center, size and angle.
        pixels: (columns, rows) of each scan.
        rounds: number of rounds.
        every: experiment time from the start of one round to the start of the next.
    """

    def __init__(
        self,
        regions: list[ListedRegion],
        pixels: Pixels = (128, 128),
        rounds: int = 1,
        every: Period = 0.0,
        **planned: Any,
    ) -> None:
        super().__init__(**planned)
        listed = (given if isinstance(given, ListedRegion) else ListedRegion(**given) for given in regions)
        self.plan = _plan(tuple(entry.region for entry in listed), pixels, rounds)
        self.beat_s = period(every)


class RegionGrid(PlannedScans):
    """A region at each point of a grid, back and forth row by row, for a map larger than a scan.

    Refused regions are left out; the log and a note say so.

    Args:
        size: (width, height) of each region.
        counts: (columns, rows) of the grid.
        spacing: (x, y) distance from one centre to the next; by default the size, so that the regions touch.
        center: (x, y) of the middle of the grid.
        angle: angle of grid and regions, counter-clockwise.
        pixels: (columns, rows) of each scan.
        rounds: number of rounds.
        every: experiment time from the start of one round to the start of the next.
    """

    def __init__(
        self,
        size: tuple[Length, Length],
        counts: tuple[int, int],
        spacing: tuple[Length, Length] | None = None,
        center: tuple[Length, Length] = (0.0, 0.0),
        angle: Angle = 0.0,
        pixels: Pixels = (128, 128),
        rounds: int = 1,
        every: Period = 0.0,
        **planned: Any,
    ) -> None:
        super().__init__(**planned)
        points = grid_centers(pair(center), (counts[0], counts[1]), pair(spacing or size), angle)
        self.plan = _plan(tuple(Region(point, pair(size), angle) for point in points), pixels, rounds)
        self.beat_s = period(every)


def _newest_scan_ns(published: Sequence[PublishedEvent]) -> tuple[int, int] | None:
    # start and end by the published states; None if no start was seen
    states = [
        (event.message.state, event.time_ns)
        for event in published
        if isinstance(event.message, ScopeStatus) and event.time_ns
    ]
    known = [(state, at_ns) for state, at_ns in states if state is not ScopeState.UNDEFINED]
    before = (ScopeState.UNDEFINED, *(state for state, _ in known))
    begins = ScopeState.SCANNING
    starts = [at_ns for was, (state, at_ns) in zip(before, known, strict=False) if was is not state is begins]
    return (starts[-1], known[-1][1]) if starts else None


def _is_of(verdict: tip_verdict.LineVerdict, lasted_ns: tuple[int, int] | None) -> bool:
    if verdict.began_ns is None:
        return True
    # the lines' start is read from the clock just after the time of the published state
    return lasted_ns is not None and lasted_ns[0] - NS_PER_S <= verdict.began_ns <= lasted_ns[1]


def pair(values: Sequence[float]) -> XY:
    """Return two numbers as a tuple (JSON delivers a list). Raises InvalidValue for another length."""
    if len(values) != 2:
        raise InvalidValue(f"{list(values)!r} is not a pair of x and y")
    return float(values[0]), float(values[1])


def checked_parameters(given: Mapping[str, str | float] | None, where: str) -> dict[str, str | float]:
    """Return the parameters to set before a scan. Raises ConfigError for an invalid name, value or unit."""
    parameters = dict(given or {})
    for name, quantity in parameters.items():
        try:
            parameter = to_parameter(name, quantity, None)
            if parameter.unit and (si_unit := UNITS_OF_REQUESTS.get(name)):
                convert(1.0, parameter.unit, si_unit)
        except (InvalidValue, UnitError) as error:
            raise ConfigError(error.what, where=f"{where}.{name}", hint=error.hint) from error
    return parameters


def speed_in_force(parameters: Mapping[str, str | float], before_m_s: float | None) -> float | None:
    """Return the scan speed after these parameters are set; None if unknown.

    Args:
        before_m_s: the speed before.
    """
    if names.SCAN_SPEED not in parameters:
        return before_m_s
    speed = to_parameter(names.SCAN_SPEED, parameters[names.SCAN_SPEED], None)
    return si(f"{speed.value} {speed.unit or 'm/s'}", "m/s")


def period(every_s: float, where: str = "every") -> float:
    """Return the time from one round to the next. Raises ConfigError if it is negative or infinite."""
    if not 0.0 <= every_s < math.inf:
        raise ConfigError(f"a period of {every_s:g} s", where=where, hint='above zero, for example "15 min"')
    return every_s


def shape_of(pixels: Sequence[int], where: str = "pixels") -> tuple[int, int]:
    """Return (columns, rows) as (rows, columns). Raises ConfigError for fewer than 1 x 1 pixels."""
    if len(pixels) != 2 or min(pixels) < 1:
        hint = "columns and rows, each at least 1, for example [128, 128]"
        raise ConfigError(f"{list(pixels)} is no number of pixels", where=where, hint=hint)
    columns, rows = pixels
    return int(rows), int(columns)


def _plan(regions: tuple[Region, ...], pixels: Sequence[int], rounds: int | None) -> ScanPlan:
    return ScanPlan(regions, shape_of(pixels), rounds)
