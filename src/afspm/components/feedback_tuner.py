"""`FeedbackTuner`: the search for a better integral gain when `feedback-non-optimal` is flagged."""

from __future__ import annotations

import math
from contextlib import nullcontext, suppress
from typing import Any, ClassVar

from afspm.basics import ControlLost
from afspm.basics.errors import ConfigError, InvalidValue, Refused
from afspm.components.feedback_metrics import FeedbackError, FeedbackQuality, gain_search
from afspm.components.feedback_signal import FeedbackObserver
from afspm.model import ControlResponse, Parameter, Problem, names

# interval of attempts to set a good gain, while a person or another component holds control
BACK_WITHIN_S = 60.0
_ROUNDED = 1e-6  # relative: a gain on the wire is in single precision


class FeedbackTuner(FeedbackObserver):
    """A solver of `feedback-non-optimal`: it scans the current region, and searches for a good integral gain.

    The component raises the gain while the feedback is too slow, and lowers the gain while the feedback oscillates. If
    no gain is good, the component restores the original gain, says so at CRITICAL, and clears the flag, so that the
    experiment continues as before. The same happens if the signal stays at one distance from the setpoint while the
    height follows: then the setpoint and the channel are calibrated differently, which no gain changes. Each test scan
    carries its gain, beside the settings of the scan that was found bad, so that the original one is set back after a
    failed scan, a loss of control or a kill; a good gain of the search is set as soon as possible. If a gain can't be
    set again, the component flags `device-malfunction`, so that nothing is scanned until a person has set one.

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
        self._way: list[float] = []  # the gains of a search, in order

    def run(self) -> None:
        while True:
            # control was lost, or this process was killed, after a good gain was found
            with suppress(ControlLost), self.scope.control(timeout_s=BACK_WITHIN_S) if self._found else nullcontext():
                self._set_found()
            if not self.scope.wait_until(self._is_wanted, timeout_s=BACK_WITHIN_S if self._found else None):
                continue
            try:
                # a scan that is repeated after a person has had the microscope is none of the gain that was tried
                with self.scope.control(solving=Problem.FEEDBACK_NON_OPTIMAL, unbroken=True):
                    self._tune()
            except ControlLost as lost:
                self.log.info("the search is over: %s", lost.what)

    @property
    def _found(self) -> float | None:
        found: float | None = self.memory.get("gain")
        return found

    def _is_wanted(self) -> bool:
        scope = self.scope
        return scope.is_flagged(Problem.FEEDBACK_NON_OPTIMAL) and not scope.is_flagged(Problem.DEVICE_MALFUNCTION)

    def _tune(self) -> None:
        feedback = self.scope.feedback
        if feedback is None or feedback.integral_gain is None or feedback.on is False:
            self._finish(f"the feedback in force is {feedback}")
            return
        before, self._way = self._in_force(), [feedback.integral_gain]
        self.memory["before"] = before
        settings = self.scope.settings_of()  # of the scan that was found bad, whose gain may be its plan's
        gain = float(settings.get(names.ZCTRL_IGAIN, f"{before:g}").split()[0])
        start, why = min(max(gain, self.lowest), self.highest), ""
        try:
            # each scan has a gain of its own; the scheduler sets the former one back
            with self.scope.settings({**settings, names.ZCTRL_IGAIN: start}):
                if self._search(start) is None:
                    why = f"no gain is good from {self.lowest:g} to {self.highest:g}"
                elif not self._set_found():
                    return
        except InvalidValue as error:
            why = error.what
        if why and not math.isclose(now := self._in_force(), before, rel_tol=_ROUNDED):
            self._call_a_person(before, now, "the log of the scheduler says why")
            return
        self._finish(why)

    def _in_force(self) -> float:
        return float(self.scope.get(names.ZCTRL_IGAIN))

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
        if found is not None:
            self._keep(found)
        return found

    def _try(self, gain: float) -> FeedbackQuality | None:
        try:
            scans = self.scope.scan(settings={names.ZCTRL_IGAIN: gain})
        except Refused as refused:
            if refused.response == ControlResponse.ACTION_ERROR:  # not the gain, but the scan
                raise
            self.log.warning("integral gain %g was refused: %s", gain, refused.reason)
            return None
        self._way.append(gain)
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
        if why:
            self.log.critical("the feedback can't be improved: %s. Its setting is as before; please check it", why)
        self.scope.clear(Problem.FEEDBACK_NON_OPTIMAL)

    def _set_found(self) -> bool:
        # the gain that was found stays: it is no setting of a measurement
        gain, before = self._found, self.memory.get("before")
        if gain is None:
            return True
        known = [*self._way, *([] if before is None else [before]), gain]
        try:
            if any(math.isclose(self._in_force(), one, rel_tol=_ROUNDED) for one in known):
                self._go_to(gain)
                self.log.info("integral gain %g", gain)
            else:
                self.log.warning("integral gain %g stays: others have set it since", self._in_force())
        except Refused as refused:
            self._call_a_person(gain, self._in_force(), refused.reason)
            return False
        finally:
            del self.memory["gain"]
            self.memory.save()
        return True

    def _call_a_person(self, wanted: float, gain: float, why: str) -> None:
        text = "integral gain %g can't be set again: %s. The gain in force is %g; set a gain by hand"
        self.log.critical(text, wanted, why, gain)
        self.scope.flag(Problem.DEVICE_MALFUNCTION)

    def _go_to(self, gain: float) -> None:
        try:
            self.scope.set_feedback(integral_gain=gain)
        except Refused:
            # a limit on steps may refuse the whole way, and allow the steps of the search
            if gain not in self._way[:-1]:
                raise
            for one in reversed(self._way[self._way.index(gain) : -1]):
                self.scope.set_feedback(integral_gain=one)
