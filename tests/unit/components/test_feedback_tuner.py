"""The search for a better gain in the laboratory in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from runtime_lab import Lab, run

from afspm.components.feedback_tuner import FeedbackTuner
from afspm.exit_codes import ExitCode
from afspm.model import ControlRequest, Feedback, Packet, Problem, Region, Scan, names

SETPOINT = 0.5


class Rig(Lab):
    """Its amplitude is as `amplitude` says of the integral gain in force."""

    def __init__(self, amplitude: Callable[[float], np.ndarray], setpoint: float = SETPOINT) -> None:
        super().__init__("tuner")
        self.amplitude, self.setpoint = amplitude, setpoint
        self.values[names.ZCTRL_SETPOINT] = str(setpoint)
        self.publish(Feedback(on=True, integral_gain=1.0))
        self.flag(Problem.FEEDBACK_NON_OPTIMAL)

    @property
    def gains(self) -> list[float]:
        """All that were set, in their order."""
        asked = [r.subject for r in self.requests if r.kind == ControlRequest.SET_ZCTRL_PARAMS]
        return [feedback.integral_gain for feedback in asked]

    def publish(self, thing: Any, envelope: str | None = None) -> Packet:
        return super().publish(
            replace(thing, setpoint=self.setpoint) if isinstance(thing, Feedback) else thing, envelope
        )

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        values = self.amplitude(self.gains[-1])
        self.publish(Scan(region, "Amplitude", "V", values, self.clock.now_ns()))


def tuned(lab: Rig) -> Rig:
    lab.at(5000.0, lab.kill)
    assert run(FeedbackTuner(lowest_gain=0.1, highest_gain=10.0, factor=2.0), lab) == ExitCode.ENDED
    return lab


def off_by(share: float) -> np.ndarray:
    """Of 100 pixels so many off the setpoint by half of it."""
    values = np.full((10, 10), SETPOINT)
    values.flat[: round(100 * share)] = 1.5 * SETPOINT
    return values


def test_the_gain_of_the_smallest_error_is_kept_and_the_flag_removed() -> None:
    lab = tuned(Rig(lambda gain: off_by({1.0: 0.4, 2.0: 0.2, 4.0: 0.05, 8.0: 0.3}[gain])))
    assert lab.gains == [1.0, 2.0, 4.0, 8.0, 4.0]
    assert lab.control.published().problems == ()


def test_where_no_gain_is_good_a_person_is_asked_for() -> None:
    lab = tuned(Rig(lambda gain: off_by(0.5)))
    assert lab.gains[-1] == 1.0
    assert Problem.DEVICE_MALFUNCTION in lab.control.published().problems


@pytest.mark.parametrize(("values", "setpoint"), [(np.full((10, 10), np.nan), SETPOINT), (off_by(0.0), 0.0)])
def test_a_scan_that_says_nothing_of_the_error_ends_in_a_word_to_a_person(values: np.ndarray, setpoint: float) -> None:
    lab = tuned(Rig(lambda gain: values, setpoint))
    assert Problem.DEVICE_MALFUNCTION in lab.control.published().problems
