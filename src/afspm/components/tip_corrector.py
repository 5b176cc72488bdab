"""`TipCorrector`: the repair of a flagged tip by the allowed treatments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from afspm.basics import ControlLost, Speed, Voltage
from afspm.basics.errors import AfspmError, ConfigError, FileError, NoResponse, Refused
from afspm.basics.formatting import position_text
from afspm.basics.units import Duration, Length, Period
from afspm.client.component import Component
from afspm.client.events import Events
from afspm.components import tip_verdict
from afspm.components.channel_pairs import ChannelPairing
from afspm.components.planned_scans import pair
from afspm.components.tip_budget import RepairAccount, RepairBudget
from afspm.components.tip_experience import UNKNOWN_FLAW
from afspm.components.tip_experience_file import NightsExperience
from afspm.components.tip_judge import Opinion, TipJudge, Verdict
from afspm.components.tip_treatments import Treatment, TreatmentPlaces, treatments
from afspm.components.tip_verdict import read_verdict
from afspm.components.tip_workshop import DONE_ACTION, TipWorkshop
from afspm.model import HEIGHT, HEIGHT_RETRACE, ChannelName, Problem, Region, Scan, ScanSet, names

Frame = list[Any]
"""Region, pixels and settings in JSON's types: centre, size and angle; rows and columns; values to lend, by parameter.

The frame of the fault comes from the verdict, not from the flag: in a survey the region set last is often another kind
of scan, which never showed the fault, and a flag of a published peer or of a person has no frame. The classifier
publishes a bad verdict before it flags."""
LAST_FRAMES = 16  # scans whose verdict may still arrive
MOVES_SHARE = 1.2  # time of a treatment and its test scans, relative to the test scans alone
VERDICT_WITHIN_S = 20.0  # real time: after that no verdict is expected


class TipCorrector(Component):
    """A solver of `tip-shape-changed`: it applies bias pulses, then controlled crashes, in the order of the lists.

    After each treatment it takes a test scan, and up to two more if the verdict is unclear. Test scans have the region
    and pixels of the scan last judged good or bad, if bad, since the fault was seen there; otherwise the current
    region. A component that judges scans (the `TipClassifier`) clears the flag when the tip is good, which takes
    control from the corrector: the experiment goes on. With policy = "list", one repair tries each listed treatment
    once, also over restarts; a treatment that a limit of the experiment file or the microscope refuses is
    logged and left out. After the last treatment the corrector flags `device-malfunction` and waits for a person: the
    experiment stops measuring rather than measure with a bad tip. Once one of the two flags is cleared, the corrector
    may repair again.

    Treatments are made at fresh places about `workshop_center`, never within `keep_away` of the experiment's region or
    of the test scan. If control is lost on the way to a place (to a person who moves the probe, say), the corrector
    continues with another place when it has control again. It makes no treatment unless the probe's published position
    is the place, nor a treatment that can't be saved, on a full disk: a restart would repeat it. Each treatment made is
    published as an `ActionMsg`.

    With policy = "learn" the corrector chooses each treatment by experience with the flaw in the scans: blunt, double
    or contaminated. It counts the outcomes, and keeps the counts in a file for the next nights.

    Args:
        workshop_center: (x, y) about which pulses and crashes are made.
        test_center: (x, y) of a first test scan, so that a worse tip stays off the experiment's region. The next test
            scan, taken unless the first shows a bad tip, is where the fault was seen. Without `test_center` all test
            scans are taken there.
        pulse_voltages: voltages of the pulses of one repair, in order.
        pulse_duration: duration of each pulse.
        crash_depths: depths of the crashes of one repair, in order, after the pulses.
        crash_speed: speed of each crash.
        place_spacing: distance between the places of two treatments.
        keep_away: least distance of a treatment from the experiment's region and the test scans.
        judge: "classifier" leaves the verdict and the flag to the component that judges scans (no verdict in time
            counts as bad); "self" compares the test scans with the first scans of the experiment, and clears the flag.
        channel, retrace_channel: channels of the heights, for judge = "self" or policy = "learn".
        reference_scans: number of scans for the reference, for judge = "self" or policy = "learn".
        problem: the problem to solve.
        policy: "list" makes the treatments in the order of the lists; "learn" chooses among them, again and again.
        most_treatments: largest number of treatments of one repair, with policy = "learn".
        experience: file of the learnt experience, relative to the folder of the runs, with policy = "learn"; of a
            simulated microscope, `_simulated` is added to its name.
        night_pulses: most pulses of all repairs of a run, also over restarts; by default no bound.
        night_depth: largest sum of the depths of all crashes of a run.
        night_places: most places of treatments, each with an area of `place_spacing` squared.
        night_time: longest time of all repairs of a run together. No treatment begins whose test scans are expected
            to end later.
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
        pulse_duration: Period = 50e-3,
        crash_depths: tuple[Length, ...] = (5e-9, 10e-9, 20e-9),
        crash_speed: Speed = 50e-9,
        place_spacing: Length = 300e-9,
        keep_away: Length = 500e-9,
        judge: Literal["classifier", "self"] = "classifier",
        channel: Annotated[ChannelName, HEIGHT] = HEIGHT,
        retrace_channel: Annotated[ChannelName, HEIGHT] = HEIGHT_RETRACE,
        reference_scans: int = 4,
        problem: str = "tip-shape-changed",
        policy: Literal["list", "learn"] = "list",
        most_treatments: int = 12,
        experience: str = "tip_experience.toml",
        night_pulses: int | None = None,
        night_depth: Length | None = None,
        night_places: int | None = None,
        night_time: Duration | None = None,
    ) -> None:
        self.test_center = None if test_center is None else pair(test_center)
        # `afspm check` compares them with the limits, and with the regions of the scans
        self.pulse_voltages, self.workshop_center = pulse_voltages, pair(workshop_center)
        self.positions = tuple(place for place in (self.workshop_center, self.test_center) if place is not None)
        self.allowed = treatments(pulse_voltages, pulse_duration, crash_depths, crash_speed)
        pulses = (names.PULSE,) if pulse_voltages else ()
        crashes = (names.CRASH,) if crash_depths else ()
        self.needs_actions = (names.START_SCAN, *pulses, *crashes)
        self.problem = problem
        self.places = TreatmentPlaces(self.workshop_center, place_spacing, keep_away)
        self.pairing = ChannelPairing(channel, retrace_channel)
        self.judge = TipJudge(reference_scans) if judge == "self" or policy == "learn" else None
        self.clears = judge == "self"
        if most_treatments < 1:
            raise ConfigError("must be at least 1", where="most_treatments")
        self.most_treatments = most_treatments if policy == "learn" else len(self.allowed)
        self.experience_file = experience if policy == "learn" else None
        area_m2 = None if night_places is None else night_places * place_spacing**2
        self.budget = RepairBudget(night_pulses, night_depth, area_m2, night_time)

    def run(self) -> None:
        self._workshop = TipWorkshop(self, self.problem, self.places, self._charge)
        self._settings: dict[str, str] = {}  # of the newest scan, or of the one that was found bad
        self._account = RepairAccount(self.budget, self.places.spacing_m, self.memory)
        self._experience: NightsExperience | None = None
        if self.experience_file is not None:
            file = Path(self.experience_file)
            if self.simulated:  # what cures a simulated tip must not be tried first on a real one
                file = file.with_name(f"{file.stem}_simulated{file.suffix}")
            path = Path(self.run_dir).parent / file
            self._experience = NightsExperience(path, self.allowed, self.memory, self.log)
        if self.judge is not None and "judge" in self.memory:
            self.judge.restore(self.memory["judge"])
        frames: dict[int | None, Frame] = {}
        with self.scope.events("ControlState", "Scan2d", tip_verdict.MESSAGE) as events:
            self._repair_if_flagged()
            problems = self.scope.control_state.problems
            for event in events:
                if isinstance(event.message, Scan):
                    self._settings = self.scope.settings_of(event.message)
                    frames[event.message.time_ns] = [
                        *_packed(event.message.region, event.message.shape),
                        self._settings,
                    ]
                    if len(frames) > LAST_FRAMES:
                        del frames[next(iter(frames))]
                    self._learn(event.message, problems)
                elif event.envelope.startswith(tip_verdict.MESSAGE):
                    self._note(read_verdict(event.message), frames)
                else:
                    problems = event.message.problems  # the flags when the scans after it were taken
                    self._repair_if_flagged()

    def _note(self, verdict: tuple[int, float] | None, frames: Mapping[int | None, Frame]) -> None:
        if verdict is None or verdict[1] == tip_verdict.UNCLEAR or "region" in self.memory:
            return
        self.memory["judged_bad"] = frames.get(verdict[0]) if verdict[1] == tip_verdict.BAD else None
        self.memory.save()

    def _repair_if_flagged(self) -> None:
        if self.memory.get("given_up"):
            if self.scope.is_flagged(self.problem) and self.scope.is_flagged(Problem.DEVICE_MALFUNCTION):
                return
            self.log.info("a person cleared the problem: the tip may be repaired again")
            self._reset_repair()
        if not self.scope.is_flagged(self.problem):
            if "region" in self.memory:
                self._reset_repair()
            if self.judge is not None:
                self.judge.trust()
            return
        try:
            with self.scope.control(solving=self.problem):
                self._account.spend_time(self.clock.now_s())
                self.memory.save()
                self._repair()
        except ControlLost as lost:
            self.log.info("the repair is over: %s", lost.what)
        finally:
            self._account.spend_time(self.clock.now_s(), ends=True)
            self.memory.save()

    def _repair(self) -> None:
        region, shape = self._of_experiment()
        if region is None:
            self._give_up("the microscope does not report its scan region: no place is known to be safe")
            return
        bad = self.memory.get("judged_bad")
        seen, shape = _unpacked(bad) if bad else (region, shape)
        if bad and len(bad) > 2:  # like is compared with like
            self._settings = bad[2]
        test = seen if self.test_center is None else seen.moved_to(self.test_center)
        looks = (test, seen, seen) if self.test_center else (seen,) * 3
        tried = int(self.memory.get("tried", 0))
        self.log.info("repairing the tip%s", f" ({tried} treatments were tried already)" if tried else "")
        self._workshop.refused.clear()
        self._expect_step(looks, shape)
        with self.scope.events("ControlState", tip_verdict.MESSAGE, timeout_s=VERDICT_WITHIN_S) as answers:
            try:
                if tried and self._is_cured(looks, shape, answers):  # a kill may have come between treatment and test
                    return
                for number in range(tried + 1, self.most_treatments + 1):
                    if self._is_treated(number, (region, seen, test)) and self._is_cured(looks, shape, answers):
                        self.log.info("the tip is repaired")
                        return
                why = f"all {self.most_treatments} treatments that are allowed were tried"
                if refused := len(self._workshop.refused):
                    done = self.most_treatments - refused
                    why = (
                        f"{done} of {self.most_treatments} treatments were done, without effect; {refused} were refused"
                    )
            except (FileError, _Blind, _OverBudget) as error:
                why = error.what
        self._restore(region)
        self._give_up(why)

    # --- the choice of treatments, and their budget

    def _is_treated(self, number: int, safe: tuple[Region, ...]) -> bool:
        # False: the treatment could not be done
        treatment = self._next(number)
        before = self._account.spent
        if self._workshop.treat(number, treatment, safe):
            return True
        self.memory.pop("pending", None)
        self._account.refund(before)
        self.memory.save()
        return False

    def _next(self, number: int) -> Treatment:
        choice = self.allowed[number - 1 : number] if self._experience is None else self.allowed
        possible = tuple(one for one in choice if one not in self._workshop.refused)
        if not possible:
            raise _Blind("no treatment of the list can be done")
        affordable = self._account.affordable(possible)
        if not affordable:
            raise _OverBudget(self._account.why_over(possible[0]))
        return affordable[0] if self._experience is None else self._experience.choose(self._flaw, affordable)

    def _charge(self, treatment: Treatment) -> None:
        # before each attempt: after a kill it counts as done, so that the budget holds
        self._account.spend_time(self.clock.now_s())
        if not self._account.affordable((treatment,)):
            raise _OverBudget(self._account.why_over(treatment))
        self._account.charge(treatment, self.scope.tenures)
        if self._experience is not None:
            self._experience.begin(self._flaw, treatment)

    def _expect_step(self, looks: tuple[Region, ...], shape: tuple[int, int] | None) -> None:
        # the longest that a treatment and its test scans may take, for the budget of time
        if self.budget.time_s is None or shape is None:
            return
        try:
            speed_m_s = float(self.scope.get(names.SCAN_SPEED))
        except (Refused, NoResponse) as error:
            self.log.warning("the first repair may exceed night_time by a test scan: %s", error.what)
            return
        scans_s = sum(2.0 * look.size_m[0] * shape[0] / speed_m_s for look in looks)
        self._account.expect_step(MOVES_SHARE * scans_s)

    # --- what it learns

    @property
    def _flaw(self) -> str:
        return str(self.memory.get("flaw", UNKNOWN_FLAW))

    def _see(self, verdict: Verdict) -> None:
        if verdict.opinion is Opinion.GOOD:
            self.memory.pop("flaw", None)
        elif verdict.opinion is Opinion.BAD and verdict.flaws:
            self.memory["flaw"] = verdict.flaws[0]
            self.memory.save()

    # --- test scans

    def _of_experiment(self) -> tuple[Region | None, tuple[int, int] | None]:
        if "region" not in self.memory:
            parameters = self.scope.scan_parameters
            if parameters is None or not isinstance(parameters.region, Region):
                return None, None
            region = parameters.region
            self.memory["region"] = _packed(region, parameters.shape if isinstance(parameters.shape, tuple) else None)
            self.memory.save()
        return _unpacked(self.memory["region"])

    def _is_cured(self, looks: tuple[Region, ...], shape: tuple[int, int] | None, answers: Events) -> bool:
        cured = self._looks_cured(looks, shape, answers)
        self._account.end_step(self.clock.now_s(), self.scope.tenures)
        if self._experience is not None:
            self._experience.end(self._flaw, cured=cured)
        self.memory.save()
        return cured

    def _looks_cured(self, looks: tuple[Region, ...], shape: tuple[int, int] | None, answers: Events) -> bool:
        refused: list[str] = []
        for place in looks:
            try:
                scans = self.scope.scan(place, shape=shape, settings=self._settings)
            except (Refused, NoResponse) as error:
                self.log.warning("no test scan at %s: %s", position_text(place.center_m), error.what)
                refused.append(error.what)
                if len(refused) == len(looks):
                    raise _Blind(f"no test scan can be taken: {error.what}") from error
                continue
            verdict = self._own_verdict(scans)
            if self.clears:
                score = self._own_score(verdict, decides=place == looks[-1])
            else:
                score = self._score_of_others(scans, answers)
            if not self.scope.is_flagged(self.problem):
                return True
            if score == tip_verdict.BAD:
                return False
        return False

    def _own_verdict(self, scans: ScanSet) -> Verdict | None:
        for scan in scans.values():
            pair = self.pairing.add(scan)
            if pair is not None and self.judge is not None:
                verdict = pair.judged_by(self.judge, learns=False)
                self._see(verdict)
                return verdict
        return None

    def _own_score(self, verdict: Verdict | None, *, decides: bool) -> float:
        # a scan at `test_center`, where the judge knows no place, can't show a double tip: it doesn't decide
        if verdict is None:
            self.log.warning("the test scan can't be judged: it lacks the channels")
            return tip_verdict.UNCLEAR
        self.log.info("test scan: %s (%s)", verdict.opinion.value, verdict.why)
        if verdict.opinion is Opinion.GOOD and decides:
            self._restore(self._of_experiment()[0])
            self.scope.clear(self.problem)
            self._wait_flag(self.problem, flagged=False)
        return tip_verdict.BAD if verdict.opinion is Opinion.BAD else tip_verdict.UNCLEAR

    def _score_of_others(self, scans: ScanSet, answers: Events) -> float:
        times = {scan.time_ns for scan in scans.values()}
        for event in answers:
            if not self.scope.is_flagged(self.problem):
                return tip_verdict.GOOD
            verdict = read_verdict(event.message) if event.envelope.startswith(tip_verdict.MESSAGE) else None
            if verdict is not None and verdict[0] in times:
                return verdict[1]
        self.log.warning("no verdict on the test scan within %.0f s: taken as bad", VERDICT_WITHIN_S)
        return tip_verdict.BAD

    def _learn(self, scan: Scan, problems: tuple[int, ...]) -> None:
        if self.judge is None or problems:
            return
        settings = scan.picture_settings
        if self._experience is None and self.judge.knows(scan.region, scan.shape, settings):
            return
        pair = self.pairing.add(scan)
        if pair is None:
            return
        verdict = pair.judged_by(self.judge, learns=True)
        self._see(verdict)
        if verdict.opinion is Opinion.LEARNING:
            self.memory["judge"] = self.judge.state()
            self.memory.save()

    def _restore(self, region: Region | None) -> None:
        if region is None:
            return
        try:
            self.scope.set_scan_region(region)
        except Refused as refused:
            self.log.warning("the experiment's region could not be set again: %s", refused.reason)

    def _give_up(self, why: str) -> None:
        cure = "until a person clears the problem, or ends the run (`afspm end`)"
        self.log.error("the tip can't be repaired: %s; nothing is scanned %s", why, cure)
        self.scope.flag(Problem.DEVICE_MALFUNCTION)
        self._wait_flag(Problem.DEVICE_MALFUNCTION, flagged=True)
        self.memory["given_up"] = True
        self.memory.save()

    def _wait_flag(self, problem: int | str, *, flagged: bool) -> None:
        # an older ControlState must not be taken for a change
        self.scope.wait_until(lambda: self.scope.is_flagged(problem) is flagged, timeout_s=VERDICT_WITHIN_S)

    def _reset_repair(self) -> None:
        for key in ("tried", "region", "judged_bad", "given_up", "flaw", "pending"):
            self.memory.pop(key, None)
        self.memory.save()


def _packed(region: Region, shape: tuple[int, int] | None) -> Frame:
    return [[*region.center_m, *region.size_m, region.angle_rad], list(shape or ())]


def _unpacked(frame: Frame) -> tuple[Region, tuple[int, int] | None]:
    (x, y, width, height, angle), shape, *_ = frame
    return Region((x, y), (width, height), angle), (int(shape[0]), int(shape[1])) if shape else None


class _Blind(AfspmError):
    """The state of the tip can't be determined, or not changed."""


class _OverBudget(AfspmError):
    """No treatment fits into the rest of the night's budget."""
