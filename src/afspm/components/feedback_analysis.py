"""`FeedbackAnalysis`: watches how well the feedback follows, and flags it when it does not."""

from __future__ import annotations

from typing import Any, ClassVar

from afspm import wire
from afspm.components.channels import Expected
from afspm.components.feedback_signal import FeedbackSignal
from afspm.errors import ConfigError, InvalidValue
from afspm.model import ControlState, Feedback, Problem, Scan
from afspm.runtime.component import Component

MESSAGE = "FeedbackAnalysis"


class FeedbackAnalysis(Component):
    """Publishes after each scan the shares of its pixels whose error is too large, as a `FeedbackAnalysis` message.

    Flags `feedback-non-optimal` when the shares together exceed `limit` in several scans in a row, and removes the flag
    when they do not any more.

    Args:
        channel: what the feedback holds at the setpoint, in a unit of the same kind.
        threshold: of the error, as a share of the setpoint.
        limit: of the pixels that may lie beyond it.
        flag_after: bad scans in a row until the problem is flagged.
        clear_after: good scans in a row until it is cleared.
    """

    flags: ClassVar = ("feedback-non-optimal",)
    publishes: ClassVar = (MESSAGE,)
    listens: ClassVar = ("Scan2d", "ControlState", "ZCtrlParameters")

    def __init__(
        self,
        channel: str = "Amplitude",
        threshold: float = 0.1,
        limit: float = 0.1,
        flag_after: int = 2,
        clear_after: int = 1,
    ) -> None:
        if not (threshold > 0.0 and 0.0 < limit < 1.0 and flag_after >= 1 and clear_after >= 1):
            raise ConfigError("`threshold` must be above zero, `limit` between 0 and 1, the counts one at least")
        self.channel, self.threshold, self.limit = channel, threshold, limit
        self.flag_after, self.clear_after = flag_after, clear_after
        self._setpoint: float | None = None
        self._is_flagged = False
        self._signal = FeedbackSignal()

    def on_start(self) -> None:
        self.expected = Expected([self.channel], self.log)

    def on_feedback(self, feedback: Feedback) -> None:
        self._setpoint = feedback.setpoint

    def on_control(self, control_state: ControlState) -> None:
        self._is_flagged = Problem.FEEDBACK_NON_OPTIMAL in control_state.problems

    def on_scan(self, scan: Scan) -> None:
        self.expected.see(scan)
        if scan.channel != self.channel or not scan.values.size:
            return
        if scan.time_ns is not None and scan.time_ns <= self.memory.get("newest_ns", -1):
            return  # replayed after a restart
        try:
            shares = self._signal.error_shares(scan, self._setpoint, self.threshold, self.scope)
        except InvalidValue as error:
            self.log.warning("%s: %s", scan.channel, error)
            return
        message: Any = wire.message_type(MESSAGE)(
            proportionOverThreshold=shares.over, proportionUnderThreshold=shares.under
        )
        self.publish(message)
        self._count(shares.total)
        self.memory["newest_ns"] = -1 if scan.time_ns is None else scan.time_ns
        self.memory.save()

    def _count(self, share: float) -> None:
        is_bad = share > self.limit
        row = self.memory.get("row", 0)  # bad scans in a row as a positive number, good ones as a negative
        row = max(row, 0) + 1 if is_bad else min(row, 0) - 1
        self.memory["row"] = row
        if row >= self.flag_after and not self._is_flagged:
            self.log.warning("the feedback does not follow: error beyond the threshold in %.0f %%", share * 100)
            self.scope.flag(Problem.FEEDBACK_NON_OPTIMAL)
        elif -row >= self.clear_after and self._is_flagged:
            self.log.info("the feedback follows: error beyond the threshold in %.0f %%", share * 100)
            self.scope.clear(Problem.FEEDBACK_NON_OPTIMAL)
