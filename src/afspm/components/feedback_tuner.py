"""`FeedbackTuner`: the search for a better integral gain when `feedback-non-optimal` is flagged."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, ClassVar

from afspm.basics import ControlLost, RequestError
from afspm.basics.errors import ConfigError, InvalidValue, Refused
from afspm.components.feedback_metrics import FeedbackError, FeedbackQuality, gain_search
from afspm.components.feedback_signal import FeedbackObserver
from afspm.model import Parameter, Problem, names

# interval of attempts to restore the gain, while a person or another component holds control
BACK_WITHIN_S = 60.0


class FeedbackTuner(FeedbackObserver):
    """A solver of `feedback-non-optimal`: it scans the current region, and searches for a good integral gain.

    The component raises the gain while the feedback is too slow, and lowers the gain while the feedback oscillates. If
    no gain is good, the component restores the original gain, says so at CRITICAL, and clears the flag, so that the
    experiment continues as before. The same happens if the signal stays at one distance from the setpoint while the
    height follows: then the setpoint and the channel are calibrated differently, which no gain changes. After a failed
    scan, a loss of control or a kill, it sets the last good gain of the search, or the original gain if none was good.
    If that gain is refused, the component flags `device-malfunction`, so that nothing is scanned until a person has set
    a gain.

    `afspm check` compares the bounds with those of the microscope and of `[limits]`, so that no gain beyond is set.

    Args:
        lowest_gain, highest_gain: bounds of the integral gain.
        factor: factor on the gain in one step.
        most_tries: largest number of test scans of one search.
    """

    solves: ClassVar = ("feedback-non-optimal",)
    flags: ClassVar = ("device-malfunction",)
    needs_actions = (names.START_SCAN,)
    needs_parameters = (names.ZCTRL_IGAIN,)

    def __init__(
        self,
        lowest_gain: float,
        highest_gain: float,
        factor: float = 2.0,
        most_tries: int = 14,
        **observed: Any,
    ) -> None:
        super().__init__(**observed)
        if not (0.0 < lowest_gain < highest_gain and factor > 1.0 and most_tries >= 2):
            raise ConfigError("needs 0 < lowest_gain < highest_gain, factor > 1, most_tries >= 2")
        self.lowest, self.highest, self.factor, self.most_tries = lowest_gain, highest_gain, factor, most_tries
        bounds = {"lowest_gain": lowest_gain, "highest_gain": highest_gain}
        self.planned_parameters = {name: (Parameter(names.ZCTRL_IGAIN, str(gain)),) for name, gain in bounds.items()}
        self._slow: FeedbackError | None = None  # of the gain before, if that was too low

    def run(self) -> None:
        while True:
            self._leave_behind()
            if not self.scope.wait_until(self._is_wanted, timeout_s=BACK_WITHIN_S if "gain" in self.memory else None):
                continue
            try:
                # a scan that is repeated after a person has had the microscope is none of the gain that was tried
                with self.scope.control(solving=Problem.FEEDBACK_NON_OPTIMAL, unbroken=True):
                    self._tune()
            except ControlLost as lost:
                self.log.info("the search is over: %s", lost.what)

    def _is_wanted(self) -> bool:
        scope = self.scope
        return scope.is_flagged(Problem.FEEDBACK_NON_OPTIMAL) and not scope.is_flagged(Problem.DEVICE_MALFUNCTION)

    def _tune(self) -> None:
        feedback = self.scope.feedback
        if feedback is None or feedback.integral_gain is None or feedback.on is False:
            self._finish(f"the feedback in force is {feedback}")
            return
        self.memory.setdefault("gain", feedback.integral_gain)
        self.memory["way"] = [feedback.integral_gain]
        self.memory.save()
        try:
            found = self._search(min(max(feedback.integral_gain, self.lowest), self.highest))
        except InvalidValue as error:
            self._finish(error.what)
            return
        except ControlLost:
            raise
        except RequestError:  # the scans may fail because of this gain, and the tip must not stay with it
            with suppress(RequestError):
                self._set_back(BACK_WITHIN_S)
            raise
        if found is not None:
            self._keep(found)
        none = f"no gain is good from {self.lowest:g} to {self.highest:g}"
        self._finish("" if found is not None else none)

    def _search(self, start: float) -> float | None:
        # a good gain is saved at once: a kill afterwards must not lose it
        search = gain_search(start, self.factor, self.lowest, self.highest, self.most_tries)
        gain, self._slow = next(search), None
        try:
            while True:
                following = self._try(gain)
                if following is not None and following.is_good:
                    self._keep(gain)
                gain = search.send(following)
        except StopIteration as done:
            found: float | None = done.value
        return found

    def _try(self, gain: float) -> FeedbackQuality | None:
        try:
            self.scope.set_feedback(integral_gain=gain)
        except Refused as refused:
            self.log.warning("integral gain %g was refused: %s", gain, refused.reason)
            return None
        self.memory["way"] = [*self.memory["way"], gain]
        self.memory["in_force"] = self.scope.feedback and self.scope.feedback.integral_gain
        self.memory.save()
        scans = self.scope.scan()
        held = self.held_channel()
        for name in (held, self.height):
            if name and name not in scans:
                raise InvalidValue(f"the scans have no channel {name!r}, there are {', '.join(scans)}")
        setpoint = self.scope.feedback.setpoint if self.scope.feedback else None
        error = self.signal.error(scans[held], scans.get(self.height), setpoint, self.scope)
        following = self.limits.judge(error)
        self.log.info("integral gain %g: the feedback %s: %s", gain, following.value, error)
        slow, self._slow = self._slow, error if following is FeedbackQuality.TOO_SLOW else None
        if slow is not None and self._slow is not None and self.limits.is_held_elsewhere(error, slow):
            what = f"{scans[held].channel} stays {error.middle:+.0%} off the setpoint while the height follows, so that"
            raise InvalidValue(
                f"{what} both are calibrated differently (set `sensitivity` to the calibration in force)"
            )
        return following

    def _keep(self, gain: float) -> None:
        self.memory["gain"] = gain
        self.memory.save()

    def _finish(self, why: str) -> None:
        if not self._set_back():
            return
        if why:
            self.log.critical("the feedback can't be improved: %s. Its setting is as before; please check it", why)
        self.scope.clear(Problem.FEEDBACK_NON_OPTIMAL)

    def on_end(self) -> None:
        gain, way = self.memory.get("gain"), self.memory.get("way")
        if gain is not None and way and gain != way[-1]:
            self.log.warning("it ends before the integral gain, now %g, is set back to %g", way[-1], gain)

    def _leave_behind(self) -> None:
        # control was lost before `_finish`, or this process was killed
        if "gain" in self.memory:
            with suppress(ControlLost), self.scope.control(timeout_s=BACK_WITHIN_S):
                self._set_back()

    def _set_back(self, timeout_s: float | None = None) -> bool:
        gain = self.memory.get("gain")
        if gain is None:
            return True
        now, own = self.scope.feedback and self.scope.feedback.integral_gain, self.memory.get("in_force")
        try:
            if own is None or now is None or now == own:
                self._go_back_to(gain, timeout_s)
            else:
                self.log.warning("integral gain %g stays: others have set it since", gain := now)
        except Refused as refused:
            text = "integral gain %g can't be set again: %s. The feedback in force is %s; set a gain by hand"
            self.log.critical(text, gain, refused.reason, self.scope.feedback)
            self.scope.flag(Problem.DEVICE_MALFUNCTION)
            is_back = False
        else:
            self.log.info("integral gain %g", gain)
            is_back = True
        del self.memory["gain"]
        self.memory.pop("way", None)
        self.memory.pop("in_force", None)
        self.memory.save()
        return is_back

    def _go_back_to(self, gain: float, timeout_s: float | None) -> None:
        try:
            self.scope.set_feedback(integral_gain=gain, timeout_s=timeout_s)
        except Refused:
            # a limit on steps may refuse the whole way, and allow the steps of the search
            way = self.memory.get("way", [])
            if gain not in way[:-1]:
                raise
            for one in reversed(way[way.index(gain) : -1]):
                self.scope.set_feedback(integral_gain=one, timeout_s=timeout_s)
