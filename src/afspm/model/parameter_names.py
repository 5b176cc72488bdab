"""Names of actions and parameters. Names that begin with `x-` are extensions to the paper's names."""

from __future__ import annotations

from typing import Final

START_SCAN: Final = "start-scan"
STOP_SCAN: Final = "stop-scan"
START_SPEC: Final = "start-spec"
STOP_SPEC: Final = "stop-spec"

BASE_ACTIONS: Final = (START_SCAN, STOP_SCAN, START_SPEC, STOP_SPEC)

# Tip preparation and safety, on microscopes with these actions.
PULSE: Final = "x-pulse"
CRASH: Final = "x-crash"
RETRACT: Final = "x-retract"
ENGAGE: Final = "x-engage"
APPROACH: Final = "x-approach"
"""Bring the tip to the sample with the coarse motor, from any distance."""

FEEDBACK_MAY_BE_OFF: Final = "x-feedback-may-be-off"
"""A person says that the z feedback is off by intention; every translator takes it, in the mode MANUAL alone."""

TIP_IS_CLEAR: Final = "x-tip-is-clear"
"""A person says that the tip is far enough from the sample for a lateral move; the scheduler takes it, in MANUAL."""

HOLD_Z: Final = "x-hold-z"
"""Switch the z feedback off to hold z; every translator takes it whose driver can move z then."""
RELEASE_Z: Final = "x-release-z"
"""The way back from `HOLD_Z`: height, bias, setpoint and gains as before it, then the feedback on."""

EXTENSION_ACTIONS: Final = (PULSE, CRASH, RETRACT, ENGAGE, APPROACH)
OF_HELD_Z_ACTIONS: Final = (HOLD_Z, RELEASE_Z)

TREATMENTS: Final = (PULSE, CRASH)
APPROACHES: Final = (ENGAGE, APPROACH)
AT_PROBE: Final = frozenset({START_SPEC, *TREATMENTS})
"""The actions that take place at the probe position."""

SCAN_TOP_LEFT_X: Final = "scan-top-left-x"
SCAN_TOP_LEFT_Y: Final = "scan-top-left-y"
SCAN_SIZE_X: Final = "scan-size-x"
SCAN_SIZE_Y: Final = "scan-size-y"
SCAN_ANGLE: Final = "scan-angle"
SCAN_RESOLUTION_X: Final = "scan-resolution-x"
SCAN_RESOLUTION_Y: Final = "scan-resolution-y"
ZCTRL_SETPOINT: Final = "zctrl-setpoint"
ZCTRL_PGAIN: Final = "zctrl-pgain"
ZCTRL_IGAIN: Final = "zctrl-igain"
SAMPLE_SLOPE_X: Final = "sample-slope-x"
SAMPLE_SLOPE_Y: Final = "sample-slope-y"
SCAN_SPEED: Final = "scan-speed"
MOVE_SPEED: Final = "move-speed"
PROBE_POS_X: Final = "probe-pos-x"
PROBE_POS_Y: Final = "probe-pos-y"
TIP_BIAS_VOLTAGE: Final = "tip-bias-voltage"
SAMPLE_BIAS: Final = "x-sample-bias"
"""The second electrode, of a microscope that has both: between tip and sample lies the difference."""
BIAS_OF_SAMPLE: Final = "sample-bias"
"""`tip-bias-voltage` with the sign of a bias of the sample: see `model.bias`."""

# The SI unit of each base parameter; None where it depends on the microscope, or on its operating mode.
BASE_PARAMETERS: Final[dict[str, str | None]] = {
    SCAN_TOP_LEFT_X: "m",
    SCAN_TOP_LEFT_Y: "m",
    SCAN_SIZE_X: "m",
    SCAN_SIZE_Y: "m",
    SCAN_ANGLE: "rad",
    SCAN_RESOLUTION_X: "px",
    SCAN_RESOLUTION_Y: "px",
    ZCTRL_SETPOINT: None,
    ZCTRL_PGAIN: None,
    ZCTRL_IGAIN: None,
    SAMPLE_SLOPE_X: "",
    SAMPLE_SLOPE_Y: "",
    SCAN_SPEED: "m/s",
    MOVE_SPEED: "m/s",
    PROBE_POS_X: "m",
    PROBE_POS_Y: "m",
    TIP_BIAS_VOLTAGE: "V",
}

UNITS_OF_REQUESTS: Final = {**BASE_PARAMETERS, BIAS_OF_SAMPLE: "V"}
"""The SI units of the base parameters and of their aliases."""

# Pulse and crash are described by parameters, so that the actions stay plain names.
PULSE_VOLTAGE: Final = "x-pulse-voltage"
PULSE_DURATION: Final = "x-pulse-duration"
CRASH_SPEED: Final = "x-crash-speed"
CRASH_DEPTH: Final = "x-crash-depth"
OF_TREATMENTS: Final = (PULSE_VOLTAGE, PULSE_DURATION, CRASH_SPEED, CRASH_DEPTH)
SPEC_KIND: Final = "x-spec-kind"

# A curve: the ends of its sweep, its points, and the lock-in amplifier.
SPEC_FROM: Final = "x-spec-from"
SPEC_TO: Final = "x-spec-to"
SPEC_Z_FROM: Final = "x-spec-z-from"
SPEC_Z_TO: Final = "x-spec-z-to"
SPEC_ENDS: Final = (SPEC_FROM, SPEC_TO)
"""First and last bias of a curve that sweeps the bias."""
SPEC_Z_ENDS: Final = (SPEC_Z_FROM, SPEC_Z_TO)
"""First and last height of a curve that sweeps the height: 0 where the feedback is opened, positive away from the
sample."""
SPEC_POINTS: Final = "x-spec-points"
SPEC_POINT_TIME: Final = "x-spec-point-time"
SPEC_Z_OFFSET: Final = "x-spec-z-offset"
"""Height at which the bias is swept, counted as `SPEC_Z_ENDS`."""
LOCK_IN_AMPLITUDE: Final = "x-lock-in-amplitude"
"""Amplitude of the modulation of the bias: its peak, not its root mean square."""
LOCK_IN_FREQUENCY: Final = "x-lock-in-frequency"
OF_CURVES: Final = {
    **dict.fromkeys(SPEC_ENDS, "V"),
    **dict.fromkeys(SPEC_Z_ENDS, "m"),
    SPEC_POINTS: "",
    SPEC_POINT_TIME: "s",
    SPEC_Z_OFFSET: "m",
    LOCK_IN_AMPLITUDE: "V",
    LOCK_IN_FREQUENCY: "Hz",
}
"""The parameters of curves with their SI units."""
SWEEPS_BIAS: Final = frozenset({"IV"})
SWEEPS_HEIGHT: Final = frozenset({"force", "z"})
"""Kinds of curves by the swept quantity; others, such as a maker's vector programs, may sweep any."""

# A held z: the height of a tip whose feedback is off.
HELD_Z_OFFSET: Final = "x-held-z-offset"
"""Height above the height of the setpoint, negative towards the sample: while z is held, a setting moves the tip."""
HELD_Z_SPEED: Final = "x-held-z-speed"
HELD_Z_ABORT_CURRENT: Final = "x-held-z-abort-current"
"""Absolute current beyond which z is held no more; 0: none."""
HELD_Z_ABORT_SHIFT: Final = "x-held-z-abort-shift"
"""Absolute frequency shift beyond which z is held no more; 0: none."""
Z_IS_HELD: Final = "x-z-is-held"
"""Whether z is held, and not on its way back; read-only."""
OF_HELD_Z: Final = {
    HELD_Z_OFFSET: "m",
    HELD_Z_SPEED: "m/s",
    HELD_Z_ABORT_CURRENT: "A",
    HELD_Z_ABORT_SHIFT: "Hz",
}
"""The parameters of a held z with their SI units."""
TIP_Z: Final = "x-tip-z"
"""Height of the tip as measured, positive away from the sample; read-only."""
CURRENT: Final = "x-current"
FREQUENCY_SHIFT: Final = "x-frequency-shift"
"""Current and frequency shift as measured now; read-only."""

FEEDBACK_ON: Final = "x-feedback-on"
ON_WORDS: Final = frozenset({"true", "1", "on", "yes"})
OFF_WORDS: Final = frozenset({"false", "0", "off", "no"})
"""Texts that a peer may send for a switch, in lower case."""
ENGAGED: Final = "x-engaged"
"""Whether the tip is at the sample, if the microscope reports it; read-only."""
SAFE_TIP_ON: Final = "x-safe-tip-on"
SAFE_TIP_THRESHOLD: Final = "x-safe-tip-threshold"
"""The controller's own guard, which withdraws the tip at too large a signal, where it is reported; read-only."""
CONTROLLER: Final = "x-controller"
"""The controller's name and version as a text; read-only."""

# Direction of the slow axis: "up" (small y first) or "down".
SCAN_DIRECTION: Final = "x-scan-direction"
UP: Final = "up"
DOWN: Final = "down"

EXTENSION_PARAMETERS: Final = (
    FEEDBACK_ON, SPEC_KIND, SCAN_DIRECTION, PULSE_VOLTAGE, PULSE_DURATION, CRASH_SPEED, CRASH_DEPTH, CONTROLLER,
)  # fmt: skip

# Velocity with which a controller moves its tip to follow a drifting sample.
DRIFT_RATE_X: Final = "x-drift-rate-x"
DRIFT_RATE_Y: Final = "x-drift-rate-y"

MAY_BE_LENT: Final = frozenset(
    (
        TIP_BIAS_VOLTAGE, SAMPLE_BIAS, ZCTRL_SETPOINT, ZCTRL_PGAIN, ZCTRL_IGAIN, SCAN_SPEED, SCAN_DIRECTION,
        *OF_CURVES, *OF_TREATMENTS,
    )
)  # fmt: skip
"""The parameters that a measurement may carry: they neither move the tip nor change what other numbers mean."""
