"""`TipCorrector`: makes the tip good again when somebody flagged it, within what it is allowed to do."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar, Literal

from afspm import wire
from afspm.client.component import Component
from afspm.client.events import Events
from afspm.components import tip_verdict
from afspm.components.channel_pairs import ChannelPairing
from afspm.components.planned_scans import pair
from afspm.components.tip_judge import Opinion, TipJudge
from afspm.components.tip_treatments import XY, Pulse, Treatment, clearance_m, fresh_place, treatments
from afspm.components.tip_verdict import read_verdict
from afspm.errors import AfspmError, ConfigError, ControlLost, FileError, NoResponse, Refused
from afspm.model import Problem, Region, Scan, ScanSet, ScopeState, names
from afspm.units import Duration, Length, Speed, Voltage

VERDICT_WITHIN_S = 20.0  # real time: a classifier that says nothing for that long will not
SETTLED_WITHIN_S = 2.0  # real time: a microscope that does not say that it is busy is taken to be ready then
DONE_ACTION = "ActionMsg"


class TipCorrector(Component):
    """Solves `tip-shape-changed`: pulses of the bias, one after the other, then controlled crashes, deeper and deeper.

    After each it takes a test scan, of the size of the experiment's scans. Whoever judges scans (the
    `TipClassifier`) clears the flag when the tip is good, which takes control from the corrector: the experiment goes
    on. The lists below are all that one repair may do, over restarts too; what a limit of the experiment file or the
    microscope refuses is told and left out. When nothing is left it flags `device-malfunction` and waits for a person:
    the experiment stands still rather than measuring with a bad tip. Once that flag is removed it may try again.

    What it does to the sample it does at fresh places about `workshop_center`, and never within `keep_away` of the
    experiment's region or of the test scan. Where control is lost on the way to one of them, to a person who moves the
    probe, say, it begins again with another place when control is back. It does nothing where the probe is not
    published to stand there, nor what it can't write down, on a full disk: a restart would do it again. It publishes
    each action done as an `ActionMsg`.

    Args:
        workshop_center: (x, y) about which pulses and crashes are made.
        test_center: (x, y) of a first test scan, so that a tip that is worse stays off the experiment's region.
            Whether it is good is seen best in that region, which is known; there it is tested next, or at once if no
            place is given here.
        pulse_voltages: those of one repair, in order.
        pulse_duration: of each pulse.
        crash_depths: those of one repair, in order, after the pulses.
        crash_speed: of each crash.
        place_spacing: between the places of two treatments.
        keep_away: least distance of a treatment from the experiment's region and the test scans.
        judge: "classifier" waits for whoever judges scans to clear the flag; "self" judges the test scans by the first
            scans of the experiment, and clears it.
        channel, retrace_channel: of the heights, for judge = "self".
        reference_scans: for judge = "self".
        problem: what it solves.
    """

    solves: ClassVar = ("tip-shape-changed",)
    flags: ClassVar = ("device-malfunction",)
    publishes: ClassVar = (DONE_ACTION,)
    needs_actions = (names.START_SCAN,)
    needs_parameters = (names.PROBE_POS_X, names.PROBE_POS_Y)

    def __init__(
        self,
        workshop_center: tuple[Length, Length],
        test_center: tuple[Length, Length] | None = None,
        pulse_voltages: tuple[Voltage, ...] = (3.0, -4.0, 5.0),
        pulse_duration: Duration = 50e-3,
        crash_depths: tuple[Length, ...] = (5e-9, 10e-9, 20e-9),
        crash_speed: Speed = 50e-9,
        place_spacing: Length = 300e-9,
        keep_away: Length = 500e-9,
        judge: Literal["classifier", "self"] = "classifier",
        channel: str = "Height",
        retrace_channel: str = "Height Retrace",
        reference_scans: int = 4,
        problem: str = "tip-shape-changed",
    ) -> None:
        self.workshop_center = pair(workshop_center)
        self.test_center = None if test_center is None else pair(test_center)
        self._frame: Region | None = None  # of our own, about a place
        self.allowed = treatments(pulse_voltages, pulse_duration, crash_depths, crash_speed)
        pulses = (names.PULSE,) if pulse_voltages else ()
        crashes = (names.CRASH,) if crash_depths else ()
        self.needs_actions = (names.START_SCAN, *pulses, *crashes)
        self.place_spacing, self.keep_away = place_spacing, keep_away
        self.problem = problem
        if place_spacing <= 0.0 or keep_away < 0.0:
            raise ConfigError("`place_spacing` must be above zero, `keep_away` not below")
        self.pairing = ChannelPairing(channel, retrace_channel)
        self.judge = TipJudge(reference_scans) if judge == "self" else None

    def run(self) -> None:
        if self.judge is not None and "judge" in self.memory:
            self.judge.restore(self.memory["judge"])
        wanted = ("ControlState",) if self.judge is None else ("ControlState", "Scan2d")
        with self.scope.events(*wanted) as events:
            self._look()
            problems = self.scope.control_state.problems
            for event in events:
                if isinstance(event.message, Scan):
                    self._learn(event.message, problems)
                else:
                    problems = event.message.problems  # as it was when the scans after it came
                    self._look()

    def _look(self) -> None:
        """Repair if that is wanted."""
        if self.memory.get("given_up"):
            if self.scope.is_flagged(self.problem) and self.scope.is_flagged(Problem.DEVICE_MALFUNCTION):
                return
            self.log.info("somebody has looked after the tip: it may be repaired again")
            self._begin_anew()
        if not self.scope.is_flagged(self.problem):
            if self.memory.get("tried"):
                self._begin_anew()
            return
        try:
            with self.scope.control(solving=self.problem):
                self._repair()
        except ControlLost as lost:
            self.log.info("the repair is over: %s", lost.what)

    def _repair(self) -> None:
        region, shape = self._of_experiment()
        if region is None:
            self._give_up("the microscope does not say where the experiment scans: no place is known to be safe")
            return
        test = region if self.test_center is None else region.moved_to(self.test_center)
        looks = (test, region, region) if self.test_center else (region,) * 3
        tried = int(self.memory.get("tried", 0))
        self.log.info("repairing the tip%s", f" ({tried} treatments were tried already)" if tried else "")
        with self.scope.events("ControlState", tip_verdict.MESSAGE, timeout_s=VERDICT_WITHIN_S) as answers:
            try:
                if tried and self._is_cured(looks, shape, answers):  # a kill may have come between treatment and test
                    return
                for number, treatment in enumerate(self.allowed[tried:], tried + 1):
                    if self._treat(number, treatment, (region, test)) and self._is_cured(looks, shape, answers):
                        self.log.info("the tip is repaired")
                        return
                why = f"all {len(self.allowed)} treatments that are allowed were tried"
            except (FileError, _Blind) as error:
                why = error.what
        self._restore(region)
        self._give_up(why)

    def _of_experiment(self) -> tuple[Region | None, tuple[int, int] | None]:
        """Region and shape of the experiment's scans, as they were before we moved away."""
        if "region" not in self.memory:
            parameters = self.scope.scan_parameters
            if parameters is None or not isinstance(parameters.region, Region):
                return None, None
            region = parameters.region
            self.memory["region"] = [*region.center_m, *region.size_m, region.angle_rad]
            self.memory["shape"] = parameters.shape
            self.memory.save()
        x, y, width, height, angle = self.memory["region"]
        shape = self.memory["shape"]
        return Region((x, y), (width, height), angle), (shape[0], shape[1]) if shape else None

    def _treat(self, number: int, treatment: Treatment, safe: tuple[Region, ...]) -> bool:
        """Whether the `number`-th treatment was done, at a place that the probe was moved to in the same tenure."""
        while True:
            place = self._fresh_place(number)
            try:
                with self.scope.control(unbroken=True):
                    return self._treat_at(place, treatment, safe)
            except Refused as refused:
                self.log.warning("no %s, it was refused: %s", treatment, refused.reason)
                return False
            except ControlLost as lost:
                if not self.scope.is_flagged(self.problem):
                    raise
                self.log.warning("no %s yet: %s; it is begun again at a fresh place", treatment, lost.what)

    def _fresh_place(self, number: int) -> XY:
        """Where the `number`-th treatment is to be tried. It is counted before: a kill must not make it happen twice.

        Raises:
            FileError: that can't be written down.
        """
        places = int(self.memory.get("places", 0))
        self.memory["tried"], self.memory["places"] = number, places + 1
        if not self.memory.save():
            raise FileError("the disk is full: a treatment that can't be written down would be done again by a restart")
        return fresh_place(self.workshop_center, self.place_spacing, places)

    def _treat_at(self, place: XY, treatment: Treatment, safe: tuple[Region, ...]) -> bool:
        """Whether it was done. All of it in one tenure of control: whoever has it in between may move the probe."""
        parameters = self.scope.scan_parameters  # a person may have chosen another region meanwhile
        if parameters is not None and isinstance(parameters.region, Region) and parameters.region != self._frame:
            safe = (*safe, parameters.region)
        if (away := min(clearance_m(place, region) for region in safe)) < self.keep_away:
            self.log.error("no %s: its place is only %.0f nm away from what is scanned", treatment, away * 1e9)
            return False
        action = names.PULSE if isinstance(treatment, Pulse) else names.CRASH
        if not self.scope.supports(action):
            self.log.warning("no %s: the microscope has no %s", treatment, action)
            return False
        self._go_to(place)
        self._prepare(treatment)
        if not self.scope.wait_until(
            lambda: self._stands_at(place) or not self.scope.in_control, timeout_s=SETTLED_WITHIN_S
        ):
            self.log.error("no %s: the probe is %s, and not at %s", treatment, self._where(), _nm(place))
            return False
        where = self._where()
        self._act(action)
        self.log.info("%s %s", treatment, where)
        self.publish(wire.message_type(DONE_ACTION)(action=action), f"{DONE_ACTION}_{self.name}")
        return True

    def _go_to(self, place: XY) -> None:
        """Move the probe to a place; with the scan frame, where the microscope moves its tip in that alone."""
        try:
            self.scope.move_probe(place)
        except Refused as refused:
            parameters = self.scope.scan_parameters
            if parameters is None or not isinstance(parameters.region, Region):
                raise
            self.log.debug("the frame goes along to %s: %s", _nm(place), refused.reason)
            size_m = (self.place_spacing, self.place_spacing)
            self._frame = replace(parameters.region, center_m=place, size_m=size_m)
            self.scope.set_scan_region(self._frame)
            self.scope.move_probe(place)

    def _stands_at(self, place: XY) -> bool:
        """Whether the probe is published to be so near to a place that no other one is nearer."""
        position = self.scope.probe_position
        return position is not None and math.dist(position.xy_m, place) <= self.place_spacing / 2

    def _where(self) -> str:
        position = self.scope.probe_position
        return "nobody knows where" if position is None else f"at {_nm(position.xy_m)}"

    def _act(self, action: str) -> None:
        """Do it, and let it end: what is asked of a busy microscope it refuses."""
        with self.scope.events("ScopeStateMsg", timeout_s=SETTLED_WITHIN_S) as states:
            try:
                self.scope.action(action)
            except NoResponse as silent:
                self.log.warning("%s: it counts as done, %s", silent.what, silent.hint)
                return
            was_busy = False
            for event in states:
                if event.message.state is ScopeState.FREE and was_busy:
                    return
                was_busy = True

    def _prepare(self, treatment: Treatment) -> None:
        if isinstance(treatment, Pulse):
            self.scope.set(names.PULSE_VOLTAGE, treatment.voltage_v, "V")
            self.scope.set(names.PULSE_DURATION, treatment.duration_s, "s")
        else:
            self.scope.set(names.CRASH_DEPTH, treatment.depth_m, "m")
            self.scope.set(names.CRASH_SPEED, treatment.speed_m_per_s, "m/s")

    def _is_cured(self, looks: tuple[Region, ...], shape: tuple[int, int] | None, answers: Events) -> bool:
        """Test scans until it is known whether the tip is good.

        Raises:
            _Blind: none can be taken.
        """
        refused: list[str] = []
        for place in looks:
            try:
                scans = self.scope.scan(place, shape=shape)
            except (Refused, NoResponse) as error:
                self.log.warning("no test scan at %s: %s", _nm(place.center_m), error.what)
                refused.append(error.what)
                if len(refused) == len(looks):
                    raise _Blind(f"no test scan can be taken: {error.what}") from error
                continue
            score = self._own_score(scans) if self.judge is not None else self._score_of_others(scans, answers)
            if not self.scope.is_flagged(self.problem):
                return True
            if score == tip_verdict.BAD:
                return False
        return False

    def _own_score(self, scans: ScanSet) -> float:
        """Judge, and clear the flag of a good tip."""
        for scan in scans.values():
            pair = self.pairing.add(scan)
            if pair is not None and self.judge is not None and self.judge.has_learnt:
                verdict = pair.judged_by(self.judge)
                self.log.info("test scan: %s (%s)", verdict.opinion.value, verdict.why)
                if verdict.opinion is Opinion.GOOD:
                    self._restore(self._of_experiment()[0])
                    self.scope.clear(self.problem)
                    self._wait_flag(self.problem, flagged=False)
                return tip_verdict.BAD if verdict.opinion is Opinion.BAD else tip_verdict.UNCLEAR
        self.log.warning("a test scan that can't be judged: no reference, or without the channels")
        return tip_verdict.UNCLEAR

    def _score_of_others(self, scans: ScanSet, answers: Events) -> float:
        """Wait for the verdict on these scans, or for the flag to be removed."""
        times = {scan.time_ns for scan in scans.values()}
        for event in answers:
            if not self.scope.is_flagged(self.problem):
                return tip_verdict.GOOD
            verdict = read_verdict(event.message) if event.envelope.startswith(tip_verdict.MESSAGE) else None
            if verdict is not None and verdict[0] in times:
                return verdict[1]
        self.log.warning("nobody judged the test scan within %.0f s: taken for bad", VERDICT_WITHIN_S)
        return tip_verdict.BAD

    def _learn(self, scan: Scan, problems: tuple[int, ...]) -> None:
        if self.judge is None or self.judge.has_learnt or problems:
            return
        pair = self.pairing.add(scan)
        if pair is not None and pair.judged_by(self.judge).opinion is Opinion.LEARNING:
            self.memory["judge"] = self.judge.state()
            self.memory.save()

    def _restore(self, region: Region | None) -> None:
        """Set the scan region back to the experiment's: its next scan may take what it finds."""
        if region is None:
            return
        try:
            self.scope.set_scan_region(region)
        except Refused as refused:
            self.log.warning("the experiment's region could not be set again: %s", refused.reason)

    def _give_up(self, why: str) -> None:
        self.log.error("the tip can't be repaired: %s. A person has to look; nothing is scanned until then", why)
        self.scope.flag(Problem.DEVICE_MALFUNCTION)
        self._wait_flag(Problem.DEVICE_MALFUNCTION, flagged=True)
        self.memory["given_up"] = True
        self.memory.save()

    def _wait_flag(self, problem: int | str, *, flagged: bool) -> None:
        """Until the scheduler's word for it is here: what is older must not be taken for a change."""
        self.scope.wait_until(lambda: self.scope.is_flagged(problem) is flagged, timeout_s=VERDICT_WITHIN_S)

    def _begin_anew(self) -> None:
        for key in ("tried", "region", "shape", "given_up"):
            self.memory.pop(key, None)
        self.memory.save()


class _Blind(AfspmError):
    """Nobody can tell what the tip is like."""


def _nm(place: XY) -> str:
    return f"({place[0] * 1e9:.0f}, {place[1] * 1e9:.0f}) nm"
