"""`FeedbackAnalysis`: the judge of the z feedback in scans, which flags a problem if the feedback is bad."""

from __future__ import annotations

from typing import Any, ClassVar

from afspm import wire
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.components.channel_pairs import ChannelPairing, MissingChannels
from afspm.components.feedback_metrics import FeedbackError, FeedbackQuality
from afspm.components.feedback_signal import FeedbackObserver
from afspm.model import ControlState, Feedback, Problem, Scan

MESSAGE = "FeedbackAnalysis"


class FeedbackAnalysis(FeedbackObserver):
    """A component that publishes a `FeedbackAnalysis` after each scan: the shares of pixels with too large an error.

    The component flags `feedback-non-optimal` after several scans in a row beyond the limits. The flag is cleared after
    scans within half of the limits; while another component has control to solve the problem, only that component
    clears the flag. A flag that was cleared although the feedback is still bad is set again only after a scan within
    the limits. Scans with the feedback off are skipped.

    Args:
        flag_after: number of scans in a row beyond the limits until the problem is flagged.
        clear_after: number of scans in a row within half of the limits until the flag is cleared.
    """

    flags: ClassVar = ("feedback-non-optimal",)
    publishes: ClassVar = (MESSAGE,)
    listens: ClassVar = ("Scan2d", "ControlState", "ZCtrlParameters")

    def __init__(self, flag_after: int = 2, clear_after: int = 1, **observed: Any) -> None:
        super().__init__(**observed)
        if flag_after < 1 or clear_after < 1:
            raise ConfigError("`flag_after` and `clear_after` must be at least 1")
        self.flag_after, self.clear_after = flag_after, clear_after
        self._pairing: ChannelPairing | None = None
        self._feedback = Feedback()
        self._is_flagged = self._is_being_solved = self._is_told = False

    def on_feedback(self, feedback: Feedback) -> None:
        self._feedback = feedback

    def on_control(self, control_state: ControlState) -> None:
        self._is_flagged = Problem.FEEDBACK_NON_OPTIMAL in control_state.problems
        self._is_being_solved = self._is_flagged and bool(control_state.holder)

    def on_scan(self, scan: Scan) -> None:
        if self._pairing is None:
            try:
                self._pairing = ChannelPairing(self.held_channel(), self.height)
            except InvalidValue as unknown:
                if not self._is_told:
                    self.log.error("nothing is judged: %s; %s", unknown.what, unknown.hint)
                self._is_told = True
                return
            self.expected = MissingChannels(self._pairing.channels, self.log)
        self.expected.see(scan)
        pair = self._pairing.add(scan)
        if pair is None or self._feedback.on is False:
            return
        time_ns = pair.trace.time_ns
        if time_ns is not None and time_ns <= self.memory.get("newest_ns", -1):
            return  # replayed after a restart
        try:
            error = self.signal.error(pair.trace, pair.retrace, self._feedback.setpoint, self.scope)
        except InvalidValue as wrong:
            self.log.warning("%s: %s", pair.trace.channel, wrong)
            return
        message: object = wire.message_type(MESSAGE)(
            proportionOverThreshold=error.over, proportionUnderThreshold=error.under
        )
        self.publish(message)
        self._count(error)
        self.memory["newest_ns"] = -1 if time_ns is None else time_ns
        self.memory.save()

    def _count(self, error: FeedbackError) -> None:
        following = self.limits.judge(error)
        row = self.memory.get("row", 0)  # bad scans in a row as a positive number, good ones as a negative
        row = min(row, 0) - 1 if following is FeedbackQuality.WELL else 0 if following.is_good else max(row, 0) + 1
        self.memory["row"] = row
        if row <= 0:
            self.memory["is_told"] = False
        if row >= self.flag_after and not self._is_flagged and not self.memory.get("is_told"):
            self.log.warning("the feedback %s: %s", following.value, error)
            self.memory["is_told"] = True
            self.scope.flag(Problem.FEEDBACK_NON_OPTIMAL)
        elif -row >= self.clear_after and self._is_flagged and not self._is_being_solved:
            self.log.info("the feedback %s: %s", following.value, error)
            self.scope.clear(Problem.FEEDBACK_NON_OPTIMAL)
