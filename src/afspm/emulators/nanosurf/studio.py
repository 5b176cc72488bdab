"""Nanosurf Studio's own part: the values of its panels, and what it does with the instrument."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from afspm.emulators.activities import RETRACE, Channels, ScanActivity, SpectrumActivity
from afspm.emulators.nanosurf import files
from afspm.emulators.program import MakerProgram, NamedFile
from afspm.errors import InvalidValue
from afspm.model import Region
from afspm.plain_data import Plain

_INTEGRAL_GAIN: Final = 0.5
"""What Studio's integral gain of 1 is to the simulated feedback, in 1/s."""
_REACH_M: Final = 50e-6
_MOST_PIXELS: Final = 8192
SETPOINT: Final = "z_control.setpoint"


@dataclass(frozen=True)
class PanelValue:
    """One value of a panel.

    Attributes:
        at_first: before anybody sets it; its type stays.
        low, high: bounds of a number.
        enum: the choices of one that is chosen, by name.
        read_only: it can't be set.
    """

    at_first: float | int | str | bool
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    enum: tuple[tuple[str, int], ...] = ()
    read_only: bool = False


def _length(at_first: float, low: float = -_REACH_M, high: float = _REACH_M) -> PanelValue:
    return PanelValue(at_first, "m", low, high)


PANEL: Final[dict[str, PanelValue]] = {
    "imaging.points_per_line": PanelValue(128, low=2, high=_MOST_PIXELS),
    "imaging.lines_per_frame": PanelValue(128, low=2, high=_MOST_PIXELS),
    "imaging.scan_range_fast_axis": _length(1e-6, 1e-10, 2 * _REACH_M),
    "imaging.scan_range_slow_axis": _length(1e-6, 1e-10, 2 * _REACH_M),
    "imaging.frame_center_offset_x": _length(0.0),
    "imaging.frame_center_offset_y": _length(0.0),
    "imaging.rotation": PanelValue(0.0, "°", -360.0, 360.0),
    "imaging.line_rate": PanelValue(1.0, "Hz", 1e-4, 1e5),
    "imaging.slope_x": PanelValue(0.0, "°", -45.0, 45.0),
    "imaging.slope_y": PanelValue(0.0, "°", -45.0, 45.0),
    "imaging.scan_mode": PanelValue(1, enum=(("continuous", 0), ("single_frame", 1))),
    "imaging.slow_axis_scan_direction": PanelValue(1, enum=(("downward", 0), ("upward", 1), ("bounce", 2))),
    SETPOINT: PanelValue(0.7, "V", -10.0, 10.0),
    "z_control.i_gain": PanelValue(1000, low=0, high=100000),
    "z_control.feedback_signal": PanelValue("amplitude"),
    "scanner.offset_x": PanelValue(0.0, "m", read_only=True),
    "scanner.offset_y": PanelValue(0.0, "m", read_only=True),
    "scanner.offset_x_target": _length(0.0),
    "scanner.offset_y_target": _length(0.0),
    "scanner.move_speed_xy_on_surface": PanelValue(5e-6, "m/s", 1e-9, 1e-2),
    "approach.approach_speed": PanelValue(10.0, "%", 0.0, 100.0),
    "data.storage.gallery_directory": PanelValue(""),
    "data.storage.file_basename": PanelValue("Image_[INDEX]"),
    "data.storage.next_file_index": PanelValue(1, low=0, high=1e9),
    "data.storage.nhf_backend_enabled": PanelValue(at_first=True),
    "data.storage.nhf_auto_store_mode": PanelValue(1, enum=(("off", 0), ("new_file", 1), ("current_file", 2))),
    "data.storage.save_partial_measurements": PanelValue(at_first=False),
    "mode.name": PanelValue("dynamic_mode", read_only=True),
    "device.controller.name": PanelValue("SIMULATED", read_only=True),
    "device.controller.serial_number": PanelValue("91-01-000", read_only=True),
    "device.scan_head.name": PanelValue("SIMULATED", read_only=True),
    "device.scan_head.connected": PanelValue(at_first=True, read_only=True),
}
"""Below `root.workflow`."""


class StudioProgram(MakerProgram):
    """The program, to which the tree of commands leads.

    Attributes:
        values: of the panels, by path.
        on_signal: called with "scanning_started" and "scanning_finished".
    """

    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self.values: Plain = {path: value.at_first for path, value in PANEL.items()}
        self.values["data.storage.gallery_directory"] = str(self.folder)
        self.on_signal: Callable[[str], None] = lambda name: None
        self._told_scanning = False
        feedback = self.rig.setup.feedback
        if feedback.setpoint is not None:
            self.values[SETPOINT] = feedback.setpoint
        if feedback.integral_gain is not None:
            self.values["z_control.i_gain"] = round(feedback.integral_gain / _INTEGRAL_GAIN)

    def get(self, path: str) -> object:
        """Return a value of a panel, or where the tip is."""
        if path in ("scanner.offset_x", "scanner.offset_y"):
            return self.rig.probe_at(self.rig.clock.now_s())[path.endswith("y")]
        return self.values[path]

    def put(self, path: str, value: object) -> None:
        """Set a value of a panel. Raises InvalidValue: it is read-only, out of bounds or of another type."""
        row = PANEL[path]
        if row.read_only:
            raise InvalidValue(f"{path} can't be set")
        if isinstance(row.at_first, str | bool):
            if type(value) is not type(row.at_first):
                raise InvalidValue(f"{path}: {value!r} is no {type(row.at_first).__name__}")
        else:
            low, high = (0, max(number for _, number in row.enum)) if row.enum else (row.low, row.high)
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise InvalidValue(f"{path}: {value!r} is not within {low:g} to {high:g}")
            value = type(row.at_first)(value)
        self.values[path] = value

    def advance(self, now_s: float) -> float | None:
        again_s = super().advance(now_s)
        if self.scanning is not self._told_scanning:
            self._told_scanning = self.scanning
            self.on_signal("scanning_started" if self.scanning else "scanning_finished")
        return again_s

    def pause(self, now_s: float) -> None:
        """Stay on the line."""
        if self.rig.scan is not None:
            self.rig.scan.pause(now_s)

    def resume(self, now_s: float) -> None:
        """Go on with the line."""
        if self.rig.scan is not None:
            self.rig.scan.resume(now_s)

    def move(self) -> None:
        """Send the tip to the target. Raises RigBusy, InvalidValue."""
        self.rig.setup.move_speed_m_s = self.values["scanner.move_speed_xy_on_surface"]
        self.rig.move_probe((self.values["scanner.offset_x_target"], self.values["scanner.offset_y_target"]))

    def lines(self, channel: int) -> tuple[str, str, list[float]]:
        """Return name, unit and the complete lines of the running scan, one after the other as they were scanned."""
        scan = self.rig.scan
        if scan is None:
            return "", "", []
        name, (unit, values) = list(_named(scan.channels(self.rig.clock.now_s())).items())[channel]
        done = scan.lines_done(self.rig.clock.now_s())
        rows = values if scan.upwards else values[::-1]
        return name, unit, [float(one) for one in rows[:done].ravel()]

    # -- what the base asks

    def prepare_scan(self) -> None:
        values, setup = self.values, self.rig.setup
        center = (values["imaging.frame_center_offset_x"], values["imaging.frame_center_offset_y"])
        size = (values["imaging.scan_range_fast_axis"], values["imaging.scan_range_slow_axis"])
        setup.region = Region(center, size, math.radians(values["imaging.rotation"]))
        setup.shape = (values["imaging.lines_per_frame"], values["imaging.points_per_line"])
        setup.line_s = 1.0 / values["imaging.line_rate"]
        setup.upwards = values["imaging.slow_axis_scan_direction"] != 0
        setup.slope = (
            math.tan(math.radians(values["imaging.slope_x"])),
            math.tan(math.radians(values["imaging.slope_y"])),
        )
        self.repeats = values["imaging.scan_mode"] == 0
        self.saves_partial = values["data.storage.save_partial_measurements"]
        self.prepare_curve()

    def prepare_curve(self) -> None:
        gain = _INTEGRAL_GAIN * self.values["z_control.i_gain"]
        self.rig.setup.feedback = replace(
            self.rig.setup.feedback, setpoint=self.values[SETPOINT], integral_gain=gain, on=True
        )

    def scan_files(self, scan: ScanActivity, now_s: float) -> Sequence[NamedFile]:
        return self._files(lambda: files.image(scan, now_s, self.values["mode.name"]), now_s)

    def curve_files(self, curve: SpectrumActivity, now_s: float) -> Sequence[NamedFile]:
        return self._files(lambda: files.curves([curve], (1, 1), now_s, self.values["mode.name"]), now_s)

    def _files(self, made: Callable[[], bytes], now_s: float) -> Sequence[NamedFile]:
        values = self.values
        if not values["data.storage.nhf_backend_enabled"] or values["data.storage.nhf_auto_store_mode"] == 0:
            return []
        while (self.folder / (name := self._next_name(now_s))).exists():
            pass
        return [(name, made())]

    def _next_name(self, now_s: float) -> str:
        """Return the name of the next file, and count on; a file never leaves its folder."""
        index = self.values["data.storage.next_file_index"]
        self.values["data.storage.next_file_index"] = index + 1
        base = re.sub(r"[^A-Za-z0-9_\[\]-]", "_", self.values["data.storage.file_basename"])[:100]
        marked = base if "[INDEX]" in base else f"{base}_[INDEX]"
        return f"{marked.replace('[INDEX]', f'{index:05d}').replace('[DATE]', f'{int(now_s)}')}.nhf"


def _named(channels: Channels) -> Channels:
    """The channels by the names that a file gives them."""
    return {
        f"{name.removesuffix(RETRACE)} {'Backward' if name.endswith(RETRACE) else 'Forward'}": data
        for name, data in channels.items()
    }
