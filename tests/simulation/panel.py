"""A person at the microscope's own panel, in simulated nights, for the controllers of five makers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from afspm.model import PanelAct


@dataclass(frozen=True)
class MakerPanel:
    """What a maker's panel does, and what its controller shows of it.

    Attributes:
        shows_tip: whether it shows a withdrawn tip.
        shows_feedback: whether it shows a feedback that is switched off.
        shows_stop: whether a stop at the panel differs from an end of its own.
        stop_withdraws: whether a stop at the panel withdraws the tip.
        withdrawal_ends_scan: whether a withdrawal ends the running scan.
        start_engages: whether the start of a scan brings the tip to the sample.
        ends_scans: the chance that a scan ends by itself before its time.
    """

    shows_tip: bool = True
    shows_feedback: bool = True
    shows_stop: bool = True
    stop_withdraws: bool = False
    withdrawal_ends_scan: bool = False
    start_engages: bool = False
    ends_scans: float = 0.02


PANELS: Final = {
    "nanonis": MakerPanel(),
    "asylum": MakerPanel(stop_withdraws=True, withdrawal_ends_scan=True, start_engages=True),
    "gxsm": MakerPanel(shows_tip=False, ends_scans=0.1),
    "nanosurf": MakerPanel(shows_tip=False, shows_feedback=False, withdrawal_ends_scan=True),
    "park": MakerPanel(shows_tip=False, withdrawal_ends_scan=True),
}
ACTS: Final = (
    *("stop", "stop and scan", "scan", "pause", "pause for ever"),
    *("withdraw", "feedback off", "bias", "setpoint", "frame"),
)
PAUSING: Final = frozenset({PanelAct.STOP, PanelAct.WITHDRAW, PanelAct.FEEDBACK_OFF})
"""Acts after which nothing is sent until a person lets the run continue."""
