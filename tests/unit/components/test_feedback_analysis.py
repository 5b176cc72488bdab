"""Quality of the feedback in the in-memory laboratory: shares, flags, and refusals."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from client_lab import Lab, run

from afspm import wire
from afspm.basics.exit_codes import ExitCode
from afspm.components.feedback_analysis import MESSAGE, FeedbackAnalysis
from afspm.model import Feedback, Problem, Region, Scan, names
from afspm.scheduler.control import arbitration as a

SETPOINT = 0.5
HERE = Region((0.0, 0.0), (1e-6, 1e-6))
BAD, BARELY, GOOD = 0.3, 0.08, 0.02
HEIGHT = 1e-6 * np.random.default_rng(1).normal(size=(10, 10)).cumsum(axis=1)


def night(
    shares: list[float], unit: str = "V", on: bool = True, cleared_s: float | None = None, solver: str = ""
) -> Lab:
    """Take scans with these shares of pixels half above the setpoint, one every 100 s; the setpoint is in V."""
    lab = Lab("feedback_analysis")
    lab.values[names.ZCTRL_SETPOINT] = str(SETPOINT)
    lab.publish(Feedback(on=on, setpoint=SETPOINT))
    if solver:
        lab.at(250.0, lambda: lab.does(a.ArbitrationEvent.REQUEST_CONTROL, solver, Problem.FEEDBACK_NON_OPTIMAL))
    if cleared_s is not None:
        lab.at(cleared_s, lambda: lab.clear(Problem.FEEDBACK_NON_OPTIMAL))

    def publish(share: float) -> None:
        values = np.full((10, 10), SETPOINT)
        values.flat[: round(100 * share)] = 1.5 * SETPOINT
        lab.publish(Scan(HERE, "Amplitude", unit, values, lab.clock.now_ns()))
        lab.publish(Scan(HERE, "Height", "m", HEIGHT, lab.clock.now_ns()))

    for number, share in enumerate(shares):
        lab.at(100.0 * (number + 1), partial(publish, share))
    lab.at(100.0 * (len(shares) + 1), lab.kill)
    assert run(FeedbackAnalysis(), lab) == ExitCode.ENDED
    return lab


def told(lab: Lab) -> list[tuple[float, float]]:
    """Return the shares over and under the threshold, of each scan."""
    found = [wire.decode(MESSAGE, payload) for envelope, payload in lab.published if envelope == MESSAGE]
    return [(one.proportionOverThreshold, one.proportionUnderThreshold) for one in found]


def test_shares_of_each_scan_are_published() -> None:
    assert np.array(told(night([GOOD, BAD]))) == pytest.approx(np.array([(GOOD, 0.0), (BAD, 0.0)]))


@pytest.mark.parametrize(
    ("shares", "flagged"),
    [
        ([BAD], False),
        ([BAD, GOOD, BAD], False),
        ([GOOD, BAD, BAD], True),
        ([BAD, BAD, BAD, GOOD], False),
        ([BAD, BAD, BARELY], True),
        ([BAD, BARELY, BAD], False),
    ],
)
def test_several_bad_scans_in_a_row_are_flagged_and_a_good_one_clears_it(shares: list[float], flagged: bool) -> None:
    lab = night(shares)
    assert (Problem.FEEDBACK_NON_OPTIMAL in lab.control.published().problems) is flagged


def test_a_channel_of_another_kind_than_the_setpoint_is_not_compared(caplog: pytest.LogCaptureFixture) -> None:
    """An amplitude in m with a setpoint in V: every pixel would seem wrong."""
    lab = night([GOOD] * 3, unit="m")
    assert told(lab) == []
    assert not lab.control.published().problems
    assert "Amplitude can't be compared with the setpoint" in caplog.text


def test_problem_cleared_without_improvement_is_flagged_again_only_after_a_good_scan() -> None:
    """A tuner without success lets the experiment go on; flag and repair must not alternate for ever."""
    assert not night([BAD] * 6, cleared_s=250.0).control.published().problems
    again = night([BAD] * 3 + [GOOD] + [BAD] * 2, cleared_s=250.0).control.published().problems
    assert again == (Problem.FEEDBACK_NON_OPTIMAL,)


def test_scans_with_the_feedback_off_are_not_judged() -> None:
    lab = night([BAD] * 3, on=False)
    assert told(lab) == []
    assert not lab.control.published().problems


def test_component_that_solves_the_problem_decides_when_to_clear_it() -> None:
    """The first good gain is not yet the one to keep."""
    lab = night([BAD, BAD, GOOD, GOOD], solver="tuner")
    assert lab.control.published().problems == (Problem.FEEDBACK_NON_OPTIMAL,)
