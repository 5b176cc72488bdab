"""Asylum's emulated software: the effects of its functions, and the running scans and curves."""

from __future__ import annotations

import logging
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from afspm.basics import AfspmError, InvalidValue
from afspm.emulation import ControllerClock, Faults, PendingWrites, SimulatedInstrument
from afspm.model import Region
from afspm.plugins.asylum.emulator import files
from afspm.plugins.asylum.emulator.values import IgorValues

FAULT_KINDS: Final = {
    "scan-refused": "DoScan does nothing",
    "force-refused": "a force curve is refused: DoForceFunc gives 0",
    "keeps-scanning": "the start of a scan resets LastScan to 0",
    "stopped": "a scan is stopped at the panel",
    "status-stuck": "for the duration, ARGetStatus reports a scan",
    "no-file": "a scan or curve is not saved",
    "late-file": "a file appears only after the duration",
    "half-file": "the second half of a file appears only after the duration",
    "same-name": "a file gets the name of the previous one",
    "other-name": "the base name is changed at the panel during a measurement",
    "drive-gone": "for the duration, the drive with the data is not mounted",
}
_SCANNING, _ENGAGED, _FORCE = 0x1, 0x2, 0x10
_MOST_POINTS: Final = 8192
_PULSE_S: Final = 60.0
_INDENTS_M: Final = 1e-6
"""Longest force curve that does not drive the tip into the sample."""
_SHORTEST_S: Final = 1e-3
"""Shortest force curve, at any velocity that PV accepts."""
_REACH_M: Final = 1e-3
"""Limit of all distances: far beyond any scanner."""
_LONGEST_NAME: Final = 17
_INTEGRAL_GAIN: Final = 150.0
"""Simulated integral gain, in 1/s, for a gain of 1 in Asylum's units."""


@dataclass(frozen=True)
class AsylumSettings:
    """Settings of the emulated software; the arguments of `AsylumEmulator`."""

    idle_s: float
    start_s: float
    file_s: float
    save_path: str
    base_name: str
    procedures: str
    has_status: bool
    image_open: bool
    saves_partial: bool


class AsylumController:
    """The emulated software.

    Args:
        folder: destination of files, independent of the folder name in Igor's texts.
        file_clock: clock of Igor's computer.
    """

    def __init__(
        self,
        rig: SimulatedInstrument,
        faults: Faults,
        values: IgorValues,
        folder: Path,
        settings: AsylumSettings,
        file_clock: ControllerClock,
        log: logging.Logger,
    ) -> None:
        self.rig = rig
        self.faults = faults
        self.values = values
        self._folder = folder
        self._settings = settings
        self._log = log
        self._file_clock = file_clock
        self._disk = PendingWrites(file_clock)
        self._starts_at_s = math.inf
        self._bias_since_s = -math.inf
        self._curve_running = self._engages = False
        # as after a scan whose image is still open: the first spot is in the middle of the image
        self._image = self._frame()
        # the panel knows the calibration of detector and lever, as after a thermal tune
        metres_per_volt, force = rig.world.settings.feedback.sensitivity_m_per_v, rig.world.settings.force
        values.put("AmpInvOLS;InvOLS", metres_per_volt)
        values.put("AmplitudeSetpointMeters", metres_per_volt * values.get("AmplitudeSetpointVolts"))
        values.put("SpringConstant", force.spring_n_per_m)
        values.put("DeflectionSetpointVolts", force.trigger_n / (force.spring_n_per_m * metres_per_volt))
        values.put("ForceDist", force.range_m + force.trigger_n / force.spring_n_per_m)
        values.put("Velocity", 2.0 * values.get("ForceDist") / force.duration_s)
        self._curve_m = values.get("ForceDist")
        fast, slow = values.size()
        self.spots_m: list[tuple[float, float]] = [(fast / 2, slow / 2)]
        self._apply()

    def put(self, names: str, value: float, now_s: float) -> None:
        """Execute PV. A bias voltage that is changed again within a minute counts as a bias pulse."""
        before_v = self.values.get("TipVoltage")
        self.values.put(names, value)
        self._apply()
        if self.values.get("TipVoltage") == before_v:
            return
        if now_s - self._bias_since_s < _PULSE_S and math.isfinite(before_v):
            self.rig.pulsed(before_v, now_s - self._bias_since_s, now_s)
        self._bias_since_s = now_s

    # --- what goes on ---

    def advance(self, now_s: float) -> float | None:
        """Advance to `now_s`; return the time of the next event, apart from events of the rig."""
        if self._engages and not self.rig.busy(now_s):
            self._engages = False
            self.rig.engage(now_s)
        if now_s >= self._starts_at_s and not self.rig.busy(now_s):
            self._starts_at_s = math.inf
            self._start_or_interrupt(now_s)
        if self.scanning and self.rig.scan is not None and math.isinf(self._starts_at_s):
            if not self.rig.scan.running(now_s):
                self._image_done(now_s)
            elif self.faults.strikes("stopped", now_s):
                self.stop(now_s)
        if self._curve_running and self.rig.doing(now_s) != "spectrum":
            self._curve_done(now_s)
        due_s = self._disk.advance(now_s, there=not self.faults.lasts("drive-gone", now_s))
        times = [at_s for at_s in (due_s, self._starts_at_s) if at_s is not None and at_s > now_s]
        return min(times, default=None)

    @property
    def scanning(self) -> bool:
        return bool(self.values.get("ScanStatus"))

    def status(self, now_s: float) -> int:
        scanning = self.scanning or self.faults.lasts("status-stuck", now_s)
        bits = (_SCANNING if scanning else 0) | (_ENGAGED if self.rig.engaged or self._engages else 0)
        return bits | (_FORCE if self._curve_running else 0)

    # --- scans ---

    def scan(self, now_s: float, down: bool | None) -> None:
        """Start a scan downwards, upwards or in the previous direction (None), in place of a running scan."""
        if self.faults.strikes("scan-refused", now_s):
            return
        if self.scanning:
            self._leave_image(now_s)
        if down is not None:
            self.values.put("ScanDown", float(down))
        if self.faults.strikes("keeps-scanning", now_s):
            self.values.put("LastScan", 0)
        # the real software sets ScanStatus at once, and starts the scan after a ramp
        self.values.put("ScanStatus", 1)
        self.values.settle()
        self.rig.stop_spectrum(now_s)
        self.rig.engaged = True
        self._starts_at_s = now_s + self._settings.start_s

    # StopScan of the real software also stops the feedback and withdraws the tip.
    def stop(self, now_s: float) -> None:
        """Stop everything, including the feedback, and withdraw the tip."""
        if self.scanning:
            self._leave_image(now_s)
        self.values.put("ScanStatus;FMapStatus;DelayUpdate", 0)
        self._curve_running = self._engages = False
        self.rig.withdraw(now_s)

    def engage(self, now_s: float) -> None:
        """Switch the feedback on, and approach the sample once the present activity has ended."""
        self._engages = True
        self.rig.switch_feedback(now_s, on=True)

    def feedback_off(self, now_s: float) -> None:
        """Hold the tip at its present height."""
        self.rig.switch_feedback(now_s, on=False)

    def abandon(self) -> None:
        """Stop scan and curve after an unexpected error."""
        self._starts_at_s = math.inf
        self._curve_running = self._engages = False
        self.values.put("ScanStatus;FMapStatus", 0)

    def _start_or_interrupt(self, now_s: float) -> None:
        # A scan with impossible parameters ends like a scan that is stopped at the panel.
        try:
            if not self._can_be_scanned():
                raise InvalidValue("no scan is possible with these parameters")
            self._start(now_s)
        except (AfspmError, ArithmeticError, ValueError) as error:
            self._log.warning("the scan was interrupted: %s", error)
            self._leave_image(now_s)

    def _can_be_scanned(self) -> bool:
        # PV accepts any number without a range check.
        values = self.values
        positive = ("ScanSize", "FastRatio", "SlowRatio", "ScanRate", "ScanLines", "ScanPoints", "IntegralGain")
        near = ("ScanSize", "XOffset", "YOffset")
        finite = ("ScanAngle", "TipVoltage", "AmplitudeSetpointVolts", "ScanDown", "LastScan")
        return (
            all(0.0 < values.get(name) < math.inf for name in positive)
            and all(abs(values.get(name)) < _REACH_M for name in near)
            and all(math.isfinite(values.get(name)) for name in finite)
            and values.get("AmplitudeSetpointVolts") > 0.0
            and all(2 <= values.get(name) <= _MOST_POINTS for name in ("ScanLines", "ScanPoints"))
        )

    def _apply(self) -> None:
        # values that PV accepts and no hardware can have stay without effect
        bias_v, gain, setpoint = (
            self.values.get(name) for name in ("TipVoltage", "IntegralGain", "AmplitudeSetpointVolts")
        )
        setup = self.rig.setup
        if math.isfinite(bias_v):
            setup.bias_v = bias_v
        if math.isfinite(gain) and math.isfinite(setpoint):
            gain *= _INTEGRAL_GAIN
            setup.feedback = replace(setup.feedback, integral_gain=gain, setpoint=setpoint)

    def _start(self, now_s: float) -> None:
        values, rig = self.values, self.rig
        rig.setup.region = self._frame()
        rig.setup.shape = (round(values.get("ScanLines")), round(values.get("ScanPoints")))
        rig.setup.line_s = 1.0 / values.get("ScanRate")
        rig.setup.upwards = not values.get("ScanDown")
        rig.setup.feedback = replace(rig.setup.feedback, on=True)
        rig.start_scan(now_s)
        self._image = rig.setup.region

    def _frame(self) -> Region:
        center = (self.values.get("XOffset"), self.values.get("YOffset"))
        return Region(center, self.values.size(), 0.0 - math.radians(self.values.get("ScanAngle")))  # clockwise

    def _image_done(self, now_s: float) -> None:
        scan = self.rig.scan
        if scan is not None:
            self._save(
                "SaveImage", now_s, lambda name: files.image(name, scan, self.values, self._file_clock.shown_s(now_s))
            )
        # LastScan 0: the next frame follows in the other direction, until a person stops it
        if not self.values.get("LastScan"):
            self.scan(now_s, not self.values.get("ScanDown"))
            return
        self.values.put("ScanStatus", 0)
        if self.values.get("LastScanWithdraw"):
            self.stop(now_s)

    def _leave_image(self, now_s: float) -> None:
        running = self.rig.scan is not None and self.rig.scan.running(now_s)
        self.rig.stop_scan(now_s)
        self._starts_at_s = math.inf
        self.values.put("ScanStatus", 0)
        scan = self.rig.scan
        if running and self._settings.saves_partial and scan is not None:
            self._save(
                "SaveImage", now_s, lambda name: files.image(name, scan, self.values, self._file_clock.shown_s(now_s))
            )

    # --- force curves ---

    def curve(self, now_s: float) -> bool:
        """Take a force curve at the tip's place; return False if refused."""
        if self.scanning or self.rig.busy(now_s) or self.faults.strikes("force-refused", now_s):
            return False
        try:
            self._indent(now_s)
            self._apply_to_curves()
            self.rig.start_spectrum("force", now_s)
        except (AfspmError, ArithmeticError, ValueError) as error:
            self._log.warning("the force curve was refused: %s", error)
            return False
        self._curve_running = True
        return True

    def _indent(self, now_s: float) -> None:
        depth_m, speed_m_s = self.values.get("ForceDist"), self.values.get("Velocity")
        if depth_m > _INDENTS_M:
            self.rig.crash(min(depth_m, _REACH_M), speed_m_s, now_s)
            self.rig.abandon(now_s)  # the curve itself takes the time, not the crash

    def _apply_to_curves(self) -> None:
        world, values = self.rig.world, self.values
        self._curve_m = values.get("ForceDist")
        force = world.settings.force
        pressed_m = world.settings.feedback.sensitivity_m_per_v * values.get("DeflectionSetpointVolts")
        force = replace(
            force,
            range_m=self._curve_m,
            trigger_n=force.spring_n_per_m * pressed_m,
            duration_s=max(_SHORTEST_S, 2.0 * self._curve_m / values.get("Velocity")),
        )
        world.settings = replace(world.settings, force=force)

    def stop_curve(self, now_s: float) -> None:
        self._curve_running = False
        self.rig.stop_spectrum(now_s)

    def go_to_spot(self, now_s: float) -> None:
        """Send the tip to the spot ForceSpotNumber of the last image.

        Raises:
            InvalidValue: the spot does not exist, or a coordinate is not within 1 mm.
            InstrumentBusy: an activity other than a move is running.
        """
        number = self._whole("ForceSpotNumber")
        if not 0 <= number < len(self.spots_m) or not all(abs(along) < _REACH_M for along in self.spots_m[number]):
            raise InvalidValue(f"ForceSpotNumber is {number}, there are {len(self.spots_m)} spots")
        image = self._image
        x, y = (along - size / 2 for along, size in zip(self.spots_m[number], image.size_m, strict=True))
        cos, sin = math.cos(image.angle_rad), math.sin(image.angle_rad)
        self.rig.move_probe((image.center_m[0] + cos * x - sin * y, image.center_m[1] + sin * x + cos * y), now_s)

    def _curve_done(self, now_s: float) -> None:
        self._curve_running = False
        spectrum, distance_m = self.rig.spectrum, self._curve_m
        if spectrum is not None:
            self._save(
                "SaveForce",
                now_s,
                lambda name: files.curve(name, spectrum, distance_m, self.values, self._file_clock.shown_s(now_s)),
            )

    # --- files ---

    def check_suffix(self) -> None:
        """Increase BaseSuffix to the next number without a file."""
        base, suffix = self._base_name(), self._suffix()
        while (self._folder / f"{base}{suffix:04d}.ibw").exists():
            suffix += 1
        self.values.put("BaseSuffix", suffix)

    def _save(self, where: str, now_s: float, made: files.Made) -> None:
        faults = self.faults
        if faults.strikes("other-name", now_s):
            self.values.put_text("BaseName", "Panel")
        if not self._whole(where) & 2 or faults.strikes("no-file", now_s):
            return
        suffix = self._suffix()
        if faults.strikes("same-name", now_s):
            suffix = max(0, suffix - 1)
        name = f"{self._base_name()}{suffix:04d}"
        late = faults.strikes("late-file", now_s)
        half = faults.strikes("half-file", now_s)
        at_s = now_s + self._settings.file_s + (late.duration_s if late else 0.0)
        rest_at_s = at_s + self._settings.file_s + (half.duration_s if half else 0.0)
        self._disk.save(self._folder / f"{name}.ibw", made(name), at_s, rest_at_s)
        self.values.put("BaseSuffix", suffix + 1)

    def _base_name(self) -> str:
        # Igor allows a letter, then letters, digits and "_"; anything else could also lead out of the data folder.
        kept = re.sub(r"[^A-Za-z0-9_]", "", self.values.text("BaseName")).lstrip("0123456789_")
        return kept[:_LONGEST_NAME] or "Image"

    def _suffix(self) -> int:
        return min(max(0, self._whole("BaseSuffix")), 9999)

    def _whole(self, name: str) -> int:
        value = self.values.get(name)
        return int(value) if math.isfinite(value) else 0
