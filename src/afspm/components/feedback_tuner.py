"""`FeedbackTuner`: looks for a better integral gain when somebody flagged that the feedback does not follow."""

from __future__ import annotations

from typing import ClassVar

from afspm.components.feedback_metrics import gain_search
from afspm.components.feedback_signal import FeedbackSignal
from afspm.errors import ConfigError, ControlLost, InvalidValue, Refused
from afspm.model import Problem, names
from afspm.runtime.component import Component


class FeedbackTuner(Component):
    """Solves `feedback-non-optimal`: multiplies the integral gain up and down, with a test scan of the region set after
    each, and keeps the one of the smallest error. If that is good it clears the flag; if not it flags
    `device-malfunction` and leaves the rest to a person.

    Args:
        lowest_gain, highest_gain: of the integral gain; never left.
        factor: of one step.
        most_tries: test scans of one search.
        channel: what the feedback holds at the setpoint, in a unit of the same kind.
        threshold: of the error, as a share of the setpoint.
        limit: of the pixels that may lie beyond it for the flag to be cleared.
    """

    solves: ClassVar = ("feedback-non-optimal",)
    flags: ClassVar = ("device-malfunction",)
    needs_actions = (names.START_SCAN,)
    needs_parameters = (names.ZCTRL_IGAIN,)

    def __init__(
        self,
        lowest_gain: float,
        highest_gain: float,
        factor: float = 1.5,
        most_tries: int = 8,
        channel: str = "Amplitude",
        threshold: float = 0.1,
        limit: float = 0.1,
    ) -> None:
        if not (0.0 < lowest_gain < highest_gain and factor > 1.0 and most_tries >= 2):
            raise ConfigError("needs 0 < lowest_gain < highest_gain, factor > 1, most_tries >= 2")
        self.lowest, self.highest, self.factor, self.most_tries = lowest_gain, highest_gain, factor, most_tries
        self.channel, self.threshold, self.limit = channel, threshold, limit
        self._signal = FeedbackSignal()

    def run(self) -> None:
        while True:
            self.scope.wait_until(self._is_wanted)
            try:
                with self.scope.control(solving=Problem.FEEDBACK_NON_OPTIMAL):
                    self._tune()
            except ControlLost as lost:
                self.log.info("the search is over: %s", lost.what)

    def _is_wanted(self) -> bool:
        scope = self.scope
        return scope.is_flagged(Problem.FEEDBACK_NON_OPTIMAL) and not scope.is_flagged(Problem.DEVICE_MALFUNCTION)

    def _tune(self) -> None:
        feedback = self.scope.feedback
        gain = feedback.integral_gain if feedback else None
        if gain is None or not self.lowest <= gain <= self.highest:
            self._give_up(f"the integral gain in force is {gain}, not within what is allowed")
            return
        search = gain_search(gain, self.factor, self.lowest, self.highest, self.most_tries)
        shares: dict[float, float] = {}
        wanted = next(search)
        try:
            while True:
                shares[wanted] = self._share_at(wanted)
                wanted = search.send(shares[wanted])
        except StopIteration as done:
            best: float = done.value
        self.scope.set_feedback(integral_gain=best)
        if shares[best] > self.limit:
            self._give_up(f"the best integral gain, {best:g}, leaves {shares[best]:.0%} beyond the threshold")
            return
        self.log.info("integral gain %g: %.0f %% beyond the threshold", best, shares[best] * 100)
        self.scope.clear(Problem.FEEDBACK_NON_OPTIMAL)

    def _share_at(self, gain: float) -> float:
        """Of the pixels beyond the threshold; all of them where the gain is refused, or the scan says nothing."""
        try:
            self.scope.set_feedback(integral_gain=gain)
        except Refused as refused:
            self.log.warning("integral gain %g was refused: %s", gain, refused.reason)
            return 1.0
        scans = self.scope.scan()
        if self.channel not in scans:
            raise ConfigError(
                f"the scans have no channel {self.channel!r}", where=self.name, hint=f"there are {', '.join(scans)}"
            )
        setpoint = self.scope.feedback.setpoint if self.scope.feedback else None
        try:
            share = self._signal.error_shares(scans[self.channel], setpoint, self.threshold, self.scope).total
        except InvalidValue as error:
            self.log.warning("integral gain %g can't be judged: %s", gain, error.what)
            return 1.0
        self.log.info("integral gain %g: %.0f %% beyond the threshold", gain, share * 100)
        return share

    def _give_up(self, why: str) -> None:
        self.log.error("the feedback can't be made better: %s. A person has to look", why)
        self.scope.flag(Problem.DEVICE_MALFUNCTION)
        self.scope.wait_until(lambda: not self._is_wanted(), timeout_s=10.0)
