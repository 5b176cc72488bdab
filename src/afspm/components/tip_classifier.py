"""`TipClassifier`: the detection, in scans, of a changed tip and of a tip that is good again."""

from __future__ import annotations

from typing import Annotated, ClassVar

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import UnitError
from afspm.client.component import Component
from afspm.components import tip_verdict
from afspm.components.channel_pairs import ChannelPairing, HeightPair, MissingChannels
from afspm.components.tip_judge import Opinion, TipJudge, TipTolerance, Verdict, VerdictCounter
from afspm.model import HEIGHT, HEIGHT_RETRACE, ChannelName, ControlState, Scan

ARRIVES_WITHIN_S = 600.0  # experiment time from the end of a scan to its arrival
_SCORES = {Opinion.GOOD: tip_verdict.GOOD, Opinion.BAD: tip_verdict.BAD, Opinion.UNCLEAR: tip_verdict.UNCLEAR}


class TipClassifier(Component):
    """A judge of scans: it flags `tip-shape-changed` for a blunt, double or contaminated tip, and clears the flag.

    The judge learns a reference from the first scans of each size and number of pixels, so the tip must be good then.
    No scan is added to an incomplete reference while a problem is flagged, or after a scan that was not good. The judge
    works best at places of earlier scans; elsewhere it detects only large changes. The verdict on each scan is
    published as a `SpatialROIWithScoreList` (1 good, 0.5 unclear, 0 bad); scans for the reference have no verdict.

    Args:
        channel: channel of the heights, by role or name.
        retrace_channel: channel of their retrace; empty if not recorded (then debris is not detected).
        reference_scans: number of scans of each kind for the reference.
        flag_after: bad scans in a row until the problem is flagged. A single one may show a slower feedback, or a jump
            of the sample.
        clear_after: good scans in a row until it is cleared.
        detail: share of the fine detail at a known place below which the tip is blunt.
        ghost: correlation of a ghost image at a known place above which the tip is double.
        unrest: factor on the disagreement of trace and retrace, in single stretches of lines, above which the tip
            carries debris; noise and hum are no disagreement.
        worn: share of the first scans' fine detail below which the tip is worn, at any place.
        sigmas: standard deviations of the reference beyond which a scan must lie to be bad; not for `worn`.
        problem: the problem to flag.
    """

    flags: ClassVar = ("tip-shape-changed",)
    publishes: ClassVar = (tip_verdict.MESSAGE,)
    listens: ClassVar = ("Scan2d", "ControlState")

    def __init__(
        self,
        channel: Annotated[ChannelName, HEIGHT] = HEIGHT,
        retrace_channel: Annotated[ChannelName, HEIGHT] = HEIGHT_RETRACE,
        reference_scans: int = 4,
        flag_after: int = 2,
        clear_after: int = 1,
        detail: float = TipTolerance.detail,
        ghost: float = TipTolerance.ghost,
        unrest: float = TipTolerance.unrest,
        worn: float = TipTolerance.worn,
        sigmas: float = TipTolerance.sigmas,
        problem: str = "tip-shape-changed",
    ) -> None:
        self.pairing = ChannelPairing(channel, retrace_channel)
        self.judge = TipJudge(reference_scans, TipTolerance(detail, ghost, unrest, worn, sigmas))
        self.counter = VerdictCounter(flag_after, clear_after)
        self.problem = problem
        self._problems: tuple[int, ...] | None = None  # not known yet
        self._flagged_ns = -1  # time of a flag by another component or a person

    def on_start(self) -> None:
        self.expected = MissingChannels(self.pairing.channels, self.log)
        if "judge" in self.memory:
            self.judge.restore(self.memory["judge"])
            self.counter.bad, self.counter.good = self.memory["counter"]

    def on_control(self, control_state: ControlState) -> None:
        was, self._problems = self._is_flagged, control_state.problems
        if self._is_flagged and not was and self.counter.bad < self.counter.flag_after:
            # flagged by another component or a person: only later scans can clear it
            self.counter.good = 0
            self._flagged_ns = (self.packet and self.packet.time_ns) or self.clock.now_ns()
        elif was and not self._is_flagged:
            self.counter.bad = 0  # repaired, or cleared by a person: only later scans can flag it
            self.judge.trust()
            self._save()

    def on_scan(self, scan: Scan) -> None:
        self.expected.see(scan)
        pair = self.pairing.add(scan)
        # replayed after a restart: judged already
        if pair is None or (scan.time_ns is not None and scan.time_ns <= self.memory.get("newest_ns", -1)):
            return
        self._judge(pair)

    @property
    def _is_flagged(self) -> bool:
        return self.scope.problems.number(self.problem) in (self._problems or ())

    def _judge(self, pair: HeightPair) -> None:
        try:
            verdict = pair.judged_by(self.judge, learns=self._problems == ())  # None: flags are not known yet
        except UnitError as error:
            self.log.warning("%s is not a height: %s", pair.trace.channel, error)
            return
        is_older = verdict.opinion is Opinion.GOOD and self._ended_before_flag(pair.trace)
        self.counter.count(Opinion.UNCLEAR if is_older else verdict.opinion)
        self._announce(pair.trace, verdict)
        self._remember(pair.trace)

    def _ended_before_flag(self, scan: Scan) -> bool:
        # with drift correction a scan arrives a while after its end; older times are of another clock
        return scan.time_ns is not None and 0 <= self._flagged_ns - scan.time_ns < ARRIVES_WITHIN_S * NS_PER_S

    def _announce(self, scan: Scan, verdict: Verdict) -> None:
        # A solver needs the verdict to know where the fault is, and must find no flag after a good one:
        # so flag after a bad verdict, clear before a good one.
        self.log.info("%s: %s (%s)", _name(scan), verdict.opinion.value, verdict.why)
        if self.counter.wants_clear and self._is_flagged:
            self.log.info("the tip is good again: %s", verdict.why)
            self.scope.clear(self.problem)
        if verdict.opinion in _SCORES:
            message = tip_verdict.verdict_message(scan, _SCORES[verdict.opinion])
            self.publish(message, f"{tip_verdict.MESSAGE}_{self.name}")
        if verdict.opinion is Opinion.BAD and self.counter.wants_flag and not self._is_flagged:
            self.log.warning("the tip has changed: %s", verdict.why)
            self.scope.flag(self.problem)

    def _remember(self, scan: Scan) -> None:
        if scan.time_ns is not None:
            self.memory["newest_ns"] = scan.time_ns
        self._save()

    def _save(self) -> None:
        self.memory["counter"] = [self.counter.bad, self.counter.good]
        self.memory["judge"] = self.judge.state()
        self.memory.save()


def _name(scan: Scan) -> str:
    return scan.filename.replace("\\", "/").rsplit("/", 1)[-1] or f"the scan of {scan.time}"
