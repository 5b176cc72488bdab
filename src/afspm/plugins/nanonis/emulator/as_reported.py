"""What others report of real instruments, and the emulator does on request: `afspm emulate nanonis --as-reported`.

None of it was seen by us. The claims with the same words in `claims.toml` name the sources: HamsterPark/MAST-public and
HamsterPark/STM-Bench for a Nanonis, SPMQT-Lab/ScanFlow for another maker's controller, whose faults are shown as far as
a Nanonis could have them. What STM-Bench's simulator does against the maker's document stands with the latter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

ZEROS: Final = "zeros"
OVER_RANGE: Final = "over-range"
CONTINUOUS: Final = "continuous"
LATE_STATUS: Final = "late-status"
OTHER_LAYOUT: Final = "other-layout"
WEDGED_PORT: Final = "wedged-port"
CLOSED_MODULES: Final = "closed-modules"
BLOCKING_PULSE: Final = "blocking-pulse"
SLOW_SHAPER: Final = "slow-shaper"
CODE_PAGE: Final = "code-page"
QPLUS_NAMES: Final = "qplus-names"
CURVE_LAYOUT: Final = "curve-layout"
CURVE_STATUS: Final = "curve-status"
UNSAVED_CURVES: Final = "unsaved-curves"
FEW_PIXELS: Final = "few-pixels"
UNKNOWN_STATUS: Final = "unknown-status"
DEAF_STOP: Final = "deaf-stop"
OFFSET_IN_VOLTS: Final = "offset-in-volts"
ROUNDED_READING: Final = "rounded-reading"
KEEPS_TIME: Final = "keeps-time"
Z_SWEEP_TOWARDS: Final = "z-sweep-towards"
BACKWARD_BY_TIME: Final = "backward-by-time"
COUNTER_CLOCKWISE: Final = "counter-clockwise"

OF_NANONIS: Final[Mapping[str, str]] = {
    ZEROS: "rows not yet scanned are zeros in memory",
    OVER_RANGE: "a frame beyond the scanner's range is accepted and returned as set; the voltages are clipped",
    CONTINUOUS: "the continuous scan is on at the panel: the status never says that a scan has ended",
    LATE_STATUS: "for a second after its start a scan is not shown as running",
    OTHER_LAYOUT: "a channel that is chosen and not recorded is answered in another layout",
    WEDGED_PORT: "each of four ports serves one client, and stays silent for ever once one was reset in mid-answer",
    CLOSED_MODULES: "the Tip Shaper is closed, and says so in a text of its own",
    BLOCKING_PULSE: "a pulse is answered at its end, although no one waits",
    SLOW_SHAPER: "a shaping of the tip begins 0.33 s late",
    CODE_PAGE: "texts are in the code page of a Chinese Windows (GBK), as the comment at the panel is",
    QPLUS_NAMES: "amplitude and phase of a qPlus sensor are called OC D1 Amplitude and OC D1 Phase",
    CURVE_LAYOUT: "the settings of curves are answered with channels and without autosave, by new releases as well",
    CURVE_STATUS: "the question whether a curve runs is answered without a result",
    UNSAVED_CURVES: "saving of curves is off at the panel",
}
OF_OTHERS: Final[Mapping[str, str]] = {
    FEW_PIXELS: "a number of pixels is taken without an error, and lines have 16 pixels",
    UNKNOWN_STATUS: "the z controller has a status that no document names",
    DEAF_STOP: "a stop has no effect, without an error",
    OFFSET_IN_VOLTS: "the centre of a frame is taken for volts: it lies 9.6 times as far away, and is returned as set",
    ROUNDED_READING: "the centre of a frame is returned rounded to 10 nm, and 7 % too large",
    KEEPS_TIME: "a change of the frame keeps the time a line, although set to keep the speed",
    Z_SWEEP_TOWARDS: "the distance of a sweep of z counts as an amount, towards the sample",
    BACKWARD_BY_TIME: "the way back of a curve comes over TCP in the order of time",
    COUNTER_CLOCKWISE: "the angle of a frame counts counter-clockwise",
}

COMMENT: Final = "样品 Au(111)"
"""The comment at the panel of a computer with that code page."""
NO_MODULE: Final = "NeedModule: Cannot access {module}. Please make sure it is running"
UNKNOWN_Z_STATUS: Final = 9
IN_VOLTS: Final = 9.6
"""Factor of an offset that was taken for volts."""
ROUNDED_M: Final = 10e-9
SCALE: Final = 1.07
LATE_S: Final = 1.0
SHAPER_BEGINS_LATE_S: Final = 0.33
