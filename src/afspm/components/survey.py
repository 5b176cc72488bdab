"""`Survey`: a wide scan, the targets found in it, and a zoom and curves at each target."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from afspm.basics import Angle
from afspm.basics.errors import ConfigError, Refused
from afspm.basics.formatting import area_text, counted, lengths_text, position_text
from afspm.basics.units import Length
from afspm.client import xy_of
from afspm.client.component import Component
from afspm.client.events import Events
from afspm.client.keyed_results import check_key
from afspm.components.pace import Pace
from afspm.components.planned_scans import FRAME, Pixels, checked_parameters, pair, shape_of, speed_in_force
from afspm.components.scan_plan import ScanPlan
from afspm.components.surveying.record import Outcome, SurveyRecord, Visit
from afspm.components.surveying.targets import Target, find_particles, lowest_beside, nearest
from afspm.model import (
    TOPOGRAPHY,
    ChannelName,
    Region,
    RegistrationOutcome,
    Scan,
    ScanParameters,
    ScanSet,
    names,
    registration_summary,
)
from afspm.model.curve_request import CurveTable, curve_parameters
from afspm.model.geometry import XY
from afspm.model.planned_work import PlannedWork, planned_rounds
from afspm.record import drift_knowledge
from afspm.storage.atomic import OutageLog
from afspm.transport import find_object

MAPPING = "DriftMapping"
LEAST_ZOOM_PX = 20
"""Least width of a zoom in pixels of the survey: narrower zooms are often not registered, below 8 px never.

Of zooms 13 px wide 22 % were registered, of zooms 20 px wide 60 %. In 23 of 24 surveys of particles with 208 pixels,
all 12 scans were registered; with 128 pixels 5 to 7 of 12. The survey takes finer pixels, since the size of zooms is
the user's choice; above 512 pixels a registration would take seconds."""
USUAL_PX, MOST_PX, _STEP_PX = 128, 512, 16


class Survey(Component):
    """A wide scan, a search for targets in it, and a zoom and curves at each target.

    The component writes a table into the run folder (number, position, height, outcome, files of zoom and curves) and a
    picture (`.png`, and `.pdf` for print): the survey with its numbered targets, their zooms and curves. If the zoom or
    a curve of a target is refused, for instance by a limit, the table has the reason, and the survey goes on with the
    next target. If all zooms are refused, the component ends with the reason. With a Drift Compensated Scheduler,
    positions are positions on the sample.

    Each scan and each curve is taken once, even if processes are killed. If the experiment ends early, table and
    picture show the measurements up to then. Their keys are `survey`, `zoom-3`, `curve-top-3` and so on:
    `run.scan("zoom-3")` finds them in the record.

    Args:
        size: (width, height) of the survey, or one length for both.
        zoom: (width, height) of each zoom, or one length for both.
        curves: places of curves, by name: a pair is an offset (x, y) from the target; a length is a distance, at which
            the lowest place of the zoom is taken; 0 is the target itself, e.g. {top = "0 nm", beside = "150 nm"}.
        kind: kind of the curves, if the microscope has several, e.g. "IV" or "force".
        curve: settings of the curves, as for a `SpectroscopyGrid`: {sweep = ["-500 mV", "500 mV"], points = 201}.
        count: largest number of targets to visit.
        center: (x, y) of the middle of the survey.
        angle: angle of survey and zooms, counter-clockwise.
        pixels: (columns, rows) of the survey. By default 128, or, up to 512, the number at which a zoom is 20 pixels of
            the survey wide: with fewer, drift between survey and zoom may not be followed.
        zoom_pixels: (columns, rows) of each zoom.
        channel: channel in which targets are found, by role or name.
        min_height: least height of a particle above the ground around it; by default six times the noise.
        separation: least distance of two particles, else only the higher counts; by default half a zoom.
        targets: a function of yours that finds targets instead of particles, e.g. "my_module.corners": it gets the
            `Scan`, and returns positions (x, y) in metres, the best first.
        refine: whether to find the target again in its zoom, so that curves are taken at its place there.
        parameters: the settings of all scans and curves, e.g. {scan-speed = "10 um/s"}.
        zoom_parameters: the settings of zooms and curves, which come before `parameters`.
        keep_control: whether to keep control between measurements; by default others may measure meanwhile.
        end_when_done: whether to end the whole experiment after the last target.
        file: name of the table and of the picture in the run folder, without suffix.
    """

    drift_doubts: tuple[ConfigError, ...]
    """Warnings of `afspm check` if drift is corrected."""
    requires = ("afspm[features]",)
    file_suffix: ClassVar[str] = ".csv"
    needs_actions: tuple[str, ...] = (names.START_SCAN,)
    _outage = OutageLog("the table of targets can't be written", logging.getLogger("afspm.records"))

    def __init__(
        self,
        size: Length | tuple[Length, Length],
        zoom: Length | tuple[Length, Length],
        curves: dict[str, Length | tuple[Length, Length]] | None = None,
        kind: str | None = None,
        curve: CurveTable | None = None,
        count: int = 10,
        center: tuple[Length, Length] = (0.0, 0.0),
        angle: Angle = 0.0,
        pixels: Pixels | None = None,
        zoom_pixels: Pixels = (128, 128),
        channel: ChannelName = TOPOGRAPHY,
        min_height: Length | None = None,
        separation: Length | None = None,
        targets: str | None = None,
        refine: bool = True,
        parameters: dict[str, str | float] | None = None,
        zoom_parameters: dict[str, str | float] | None = None,
        keep_control: bool = False,
        end_when_done: bool = False,
        file: str = "targets",
    ) -> None:
        self.parameters = checked_parameters(parameters, "parameters")
        self.zoom_parameters = checked_parameters(zoom_parameters, "zoom_parameters")
        wide, closer = Region(pair(center), _both(size), angle), Region((0.0, 0.0), _both(zoom), angle)
        for zoom_m, whole_m in zip(closer.size_m, wide.size_m, strict=True):
            if zoom_m > whole_m:
                what = f"a zoom of {area_text(closer.size_m)} is larger than the survey"
                raise ConfigError(what, where="zoom", hint=f"at most {area_text(wide.size_m)}")
        chosen = _fine_enough(wide, closer) if pixels is None else pixels
        self._wide = _ScanSetup(wide, shape_of(chosen), self.parameters)
        self._closer = _ScanSetup(closer, shape_of(zoom_pixels, "zoom_pixels"), self.zoom_parameters)
        self.drift_doubts = tuple(_too_coarse(wide, chosen, closer, is_given=pixels is not None))
        self.plan = ScanPlan((self._wide.region,), self._wide.shape)  # the parts that `afspm check` can look at
        self.placed_later = {"zoom": ScanParameters(closer.moved_to(wide.center_m), self._closer.shape)}
        half_m = min(self._closer.region.size_m) / 2
        self.curves = {name: _place(name, place, half_m) for name, place in (curves or {}).items()}
        self.curve = curve or {}
        self.planned_parameters = {"curve": curve_parameters(self.curve, kind)}
        self.kind, self.channel, self.end_when_done, self.file = kind, channel, end_when_done, file
        if targets is not None:
            for name, value in {"min_height": min_height, "separation": separation}.items():
                if value is not None:
                    raise ConfigError("applies to particles only, not to `targets`", where=name)
        if count < 1:
            raise ConfigError(f"{count} is not at least 1", where="count")
        for name, value in {"min_height": min_height, "separation": separation}.items():
            if value is not None and value < 0.0:
                raise ConfigError(f"{lengths_text([value])} is below zero", where=name)
        separation_m = half_m if separation is None else separation
        self.finder = TargetFinder(targets, count, min_height, separation_m, min(self._wide.region.size_m), refine)
        self.keep_control = keep_control
        self._record: SurveyRecord | None = None
        self._refused: Refused | None = None
        self._needs(dict.fromkeys((*self._wide.parameters, *self._closer.parameters)))

    def _needs(self, parameters: Iterable[str]) -> None:
        probe: tuple[str, ...] = ()
        if self.curves:
            self.needs_actions = (names.START_SCAN, names.START_SPEC)
            of_curves = (one.name for one in self.planned_parameters["curve"])
            probe = (names.PROBE_POS_X, names.PROBE_POS_Y, *((names.SPEC_KIND,) if self.kind else ()), *of_curves)
        self.needs_parameters = (*FRAME, *probe, *parameters)

    def check(self) -> None:
        """Raise ConfigError if the function that finds targets does not exist."""
        self.finder.check()

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        wide, closer, count = self._wide, self._closer, self.finder.count
        wide_m_s = speed_in_force(wide.parameters, speed_m_s)
        survey = planned_rounds((wide.region,), wide.shape, 1, 0.0, wide_m_s)
        zooms = planned_rounds((closer.region,), closer.shape, count, 0.0, speed_in_force(closer.parameters, wide_m_s))
        why = survey.why or zooms.why or "zooms depend on the targets found"
        work = replace(survey + zooms, spectra=count * len(self.curves), why=why)
        return replace(work, at_most=True, ends_experiment=self.end_when_done)

    def run(self) -> None:
        with (
            self.scope.control() if self.keep_control else nullcontext(),
            self.scope.curves(self.curve, kind=self.kind),
            self.scope.events(MAPPING, timeout_s=0.0) as mappings,
            self.scope.settings(self._wide.parameters),
        ):
            self._run(mappings)
        if self.end_when_done:
            self.scope.end_experiment()

    def _run(self, mappings: Events) -> None:
        survey = self._channel(self.scope.scan(self._wide.region, shape=self._wide.shape, key="survey"))
        self._record = SurveyRecord(survey, self._targets(survey), tuple(self.curves))
        self._keep(self._record)
        visits = self._record.visits
        with self.scope.settings(self._closer.parameters):
            self._visit_all(self._record, mappings)
        registered = [visit.registration for visit in visits if visit.registration]
        if registered:
            level = logging.INFO if all(one.is_registered for one in registered) else logging.WARNING
            self.log.log(level, "zooms: %s", registration_summary(registered))
        if visits and all(visit.zoom is None for visit in visits):
            assert self._refused is not None
            self.log.error("no target could be zoomed: all %d were refused", len(visits))
            raise self._refused

    def _visit_all(self, record: SurveyRecord, mappings: Events) -> None:
        visits, pace = record.visits, Pace(self.scope, self.memory)
        for visit in visits:
            self._visit(visit, mappings)
            self._keep(record)
            pace.note()
            self.scope.progress(visit.number, len(visits), left_s=pace.left_s(visit.number, len(visits)))
            if visit.number > int(self.memory.get("done", 0)):  # else it was logged before a restart
                self._tell(visit, record.outcome(visit))
                self.memory["done"] = visit.number
                self.memory.save()

    def on_end(self) -> None:
        if self._record is None:
            self.log.warning("no survey was taken: there is no table and no picture")
            return
        self._keep(self._record)
        from afspm.components.surveying import figure  # matplotlib: needed at the end alone
        from afspm.drawing.plotting import save_figure

        drawn = figure.survey_figure(self._record, title=self.name, simulated=self.simulated)
        path = Path(self.run_dir) / f"{self.file}.png"
        for suffix in (".png", ".pdf"):  # the second for `afspm export --to pdf`: the record does not have all of it
            save_figure(drawn, path.with_suffix(suffix), figure.DPI)
        self.log.info("the survey is drawn: %s", path)

    def _targets(self, survey: Scan) -> list[Target]:
        # saved, so that they are the same after a restart: a user's function may be random
        if "targets" not in self.memory:
            with self.clock.late():
                found = self.finder.targets(survey)
            self.memory["targets"] = [[*target.position_m, target.height] for target in found]
            self.memory.save()
            if found:
                self.log.info("%s found", counted(len(found), "target"))
            else:
                self.log.warning("no target found in the survey: nothing is zoomed")
        return [Target((x, y), height) for x, y, height in self.memory["targets"]]

    def _visit(self, visit: Visit, mappings: Events) -> None:
        # refusals are recorded
        region = self._closer.region.moved_to(visit.target.position_m)
        try:
            scans = self.scope.scan(region, shape=self._closer.shape, key=f"zoom-{visit.number}")
        except Refused as refused:
            visit.refusals.append(f"zoom: {refused.reason}")
            self._refused = refused
            return
        visit.zoom = self._channel(scans)
        visit.registration, visit.position_sd_m = self._position(visit, scans, mappings)
        visit.center_m = self._center(visit, visit.zoom)
        for name, place in self.curves.items():
            at_m = place.of(visit.center_m, visit.zoom)
            try:
                key = f"{name}-{visit.number}"
                visit.curves[name] = self.scope.spectrum(at_m, kind=self.kind, key=f"curve-{key}")
            except Refused as refused:
                visit.refusals.append(f"{name}: {refused.reason}")

    def _position(
        self, visit: Visit, scans: ScanSet, mappings: Events
    ) -> tuple[RegistrationOutcome | None, float | None]:
        # the scheduler publishes the mapping just before the zoom
        kept = self.memory.setdefault("positions", {})
        files = {scan.filename for scan in scans.values() if scan.filename}
        for event in mappings:
            if event.message.filename in files:
                kept[str(visit.number)] = drift_knowledge(event.message)
                self.memory.save()
        outcome, sd_m = kept.get(str(visit.number), (None, None))
        return None if outcome is None else RegistrationOutcome(outcome), sd_m

    def _center(self, visit: Visit, zoom: Scan) -> XY:
        # saved, so that it is the same after a restart
        centers = self.memory.setdefault("centers", {})
        if str(visit.number) not in centers:
            with self.clock.late():
                centers[str(visit.number)] = list(self.finder.again(zoom, visit.target))
            self.memory.save()
        return pair(centers[str(visit.number)])

    def _channel(self, scans: ScanSet) -> Scan:
        if self.channel not in scans:
            raise ConfigError(
                f"the microscope records no channel {self.channel!r}",
                where="channel",
                hint=f"one of {', '.join(scans)}",
            )
        return scans[self.channel]

    def _keep(self, record: SurveyRecord) -> None:
        # on a full disk the error is logged, and the next target tries again
        with self._outage.trying():
            record.write(Path(self.run_dir) / f"{self.file}.csv")

    def _tell(self, visit: Visit, outcome: Outcome) -> None:
        where, of = position_text(visit.center_m), len(self._record.visits) if self._record else 0
        if outcome is Outcome.REFUSED:
            self.log.warning("target %d of %d at %s refused: %s", visit.number, of, where, "; ".join(visit.refusals))
            return
        registration, sd_m = visit.registration, visit.position_sd_m
        how = ""
        if registration is not None and not registration.is_registered:
            sd = "unknown" if sd_m is None else f"± {lengths_text([float(f'{sd_m:.2g}')])}"
            how = f", its position by dead reckoning ({sd}): the zoom is {registration.label}"
        self.log.info("target %d of %d at %s measured%s", visit.number, of, where, how)


def _fine_enough(wide: Region, closer: Region) -> Pixels:
    # pixels of a survey in which a zoom is wide enough to be recognised
    needed = max(LEAST_ZOOM_PX * large / small for large, small in zip(wide.size_m, closer.size_m, strict=True))
    side = min(max(USUAL_PX, math.ceil((needed + 1) / _STEP_PX) * _STEP_PX), MOST_PX)
    return side, side


def _zoom_px(wide: Region, pixels: Pixels, closer: Region) -> float:
    # survey pixels along the shorter side of a zoom
    sides = zip(closer.size_m, wide.size_m, pixels, strict=True)
    return min(small / large * (n - 1) for small, large, n in sides)


def _too_coarse(wide: Region, pixels: Pixels, closer: Region, *, is_given: bool) -> Iterator[ConfigError]:
    if (zoom_px := _zoom_px(wide, pixels, closer)) >= LEAST_ZOOM_PX:
        return
    finer = _fine_enough(wide, closer)
    cure = f"pixels = [{finer[0]}, {finer[1]}]"
    if _zoom_px(wide, finer, closer) < LEAST_ZOOM_PX:
        least_m = LEAST_ZOOM_PX * max(large / (n - 1) for large, n in zip(wide.size_m, finer, strict=True))
        larger = f'zoom = "{math.ceil(least_m * 1e9)} nm"'
        cure = f"{larger} with {cure}" if is_given else larger
    yield ConfigError(
        f"a zoom is {zoom_px:.1f} pixels of the survey wide: drift may not be followed from the survey to its zooms",
        where="pixels" if is_given else "zoom",
        hint=f"{LEAST_ZOOM_PX} pixels are enough: {cure}",
    )


@dataclass(frozen=True)
class _ScanSetup:
    """A region with its pixels as (rows, columns), and the parameters to set before its scan."""

    region: Region
    shape: tuple[int, int]
    parameters: dict[str, str | float]


@dataclass(frozen=True)
class _CurvePlace:
    """Place of a curve: an offset from the target, or a distance at which the lowest place of the zoom is taken."""

    offset_m: XY
    distance_m: float = 0.0

    def of(self, center_m: XY, zoom: Scan) -> XY:
        if self.distance_m:
            return lowest_beside(zoom, center_m, self.distance_m)
        return center_m[0] + self.offset_m[0], center_m[1] + self.offset_m[1]


def _place(name: str, place: float | Sequence[float], half_zoom_m: float) -> _CurvePlace:
    check_key(f"curve-{name}-1")
    if not isinstance(place, int | float):
        return _CurvePlace(pair(place))
    if not 0.0 <= place < half_zoom_m:
        raise ConfigError(
            f"a curve {lengths_text([place])} beside the target lies outside its zoom",
            where=f"curves.{name}",
            hint=f"at most {lengths_text([half_zoom_m])}, or an offset as a pair",
        )
    return _CurvePlace((0.0, 0.0), place)


def _both(length: float | Sequence[float]) -> XY:
    return (float(length), float(length)) if isinstance(length, int | float) else pair(length)


Finder = Callable[[Scan], Iterable[object]]


@dataclass(frozen=True)
class TargetFinder:
    """The search for targets in a survey, and for each target in its zoom.

    Attributes:
        function: import path of the user's function, "module.name"; None: find particles.
        count: largest number of targets.
        min_height: the least height of a particle, in the unit of the scan; None: six times the noise.
        separation_m: the least distance of two particles, in m; of a nearer pair only the higher counts.
        widest_m: shorter side of the survey, in m: a particle that fills its zoom must not be taken for ground.
        refines: whether targets are found again in their zooms.
    """

    function: str | None
    count: int
    min_height: float | None
    separation_m: float
    widest_m: float
    refines: bool

    def check(self) -> None:
        if self.function is not None:
            self._function(self.function)

    def targets(self, survey: Scan) -> list[Target]:
        """Return the targets in a survey, in the order of their visits."""
        if self.function is None:
            return find_particles(survey, self.count, min_height=self.min_height, separation_m=self.separation_m)
        return self._of_function(self.function, survey)[: self.count]

    def again(self, zoom: Scan, target: Target) -> XY:
        """Return a target's position in its zoom, or its position in the survey if the zoom does not show it."""
        if not self.refines:
            return target.position_m
        if self.function is None:
            least = None if target.height is None else target.height / 2
            found = find_particles(zoom, min_height=least, separation_m=self.separation_m, widest_m=self.widest_m)
        else:
            found = self._of_function(self.function, zoom)
        near = nearest(found, target.position_m, min(zoom.region.size_m) / 2)
        return target.position_m if near is None else near.position_m

    def _of_function(self, path: str, scan: Scan) -> list[Target]:
        places = self._function(path)(scan)
        return [Target(xy) for place in places if all(map(math.isfinite, xy := xy_of(place)))]

    @staticmethod
    def _function(path: str) -> Finder:
        function: object = find_object(path, "targets")
        if not callable(function):
            raise ConfigError(f"{path} is not a function", where="targets", hint="it is given a Scan")
        found: Finder = function
        return found
