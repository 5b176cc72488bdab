"""How well the feedback follows, in the laboratory in memory: what is told, flagged, and refused."""

from __future__ import annotations

import numpy as np
import pytest
from runtime_lab import Lab, run

from afspm import wire
from afspm.components.feedback_analysis import MESSAGE, FeedbackAnalysis
from afspm.exit_codes import ExitCode
from afspm.model import Feedback, Problem, Region, Scan, names

SETPOINT = 0.5
HERE = Region((0.0, 0.0), (1e-6, 1e-6))
BAD, GOOD = 0.3, 0.02


def night(shares: list[float], unit: str = "V", **settings: float) -> Lab:
    """Scans with these shares of pixels half above the setpoint, one every 100 s; the setpoint is in V."""
    lab = Lab("feedback_analysis")
    lab.values[names.ZCTRL_SETPOINT] = str(SETPOINT)
    lab.publish(Feedback(on=True, setpoint=SETPOINT))

    def publish(share: float) -> None:
        values = np.full((10, 10), SETPOINT)
        values.flat[: round(100 * share)] = 1.5 * SETPOINT
        lab.publish(Scan(HERE, "Amplitude", unit, values, lab.clock.now_ns()))

    for number, share in enumerate(shares):
        lab.at(100.0 * (number + 1), lambda share=share: publish(share))
    lab.at(100.0 * (len(shares) + 1), lab.kill)
    assert run(FeedbackAnalysis(**settings), lab) == ExitCode.ENDED  # type: ignore[arg-type]
    return lab


def told(lab: Lab) -> list[tuple[float, float]]:
    """Shares over and under the threshold, of each scan."""
    found = [wire.decode(MESSAGE, payload) for envelope, payload in lab.published if envelope == MESSAGE]
    return [(one.proportionOverThreshold, one.proportionUnderThreshold) for one in found]


def test_the_shares_of_each_scan_are_told() -> None:
    assert np.array(told(night([GOOD, BAD]))) == pytest.approx(np.array([(GOOD, 0.0), (BAD, 0.0)]))


@pytest.mark.parametrize(
    ("shares", "flagged"),
    [([BAD], False), ([BAD, GOOD, BAD], False), ([GOOD, BAD, BAD], True), ([BAD, BAD, BAD, GOOD], False)],
)
def test_several_bad_scans_in_a_row_are_flagged_and_a_good_one_clears_it(shares: list[float], flagged: bool) -> None:
    lab = night(shares)
    assert (Problem.FEEDBACK_NON_OPTIMAL in lab.control.published().problems) is flagged


def test_a_channel_of_another_kind_than_the_setpoint_is_not_compared(caplog: pytest.LogCaptureFixture) -> None:
    """An amplitude in m, where the setpoint is in V: all of it would seem to be wrong."""
    lab = night([GOOD] * 3, unit="m")
    assert told(lab) == []
    assert not lab.control.published().problems
    assert "Amplitude can't be compared with the setpoint" in caplog.text
