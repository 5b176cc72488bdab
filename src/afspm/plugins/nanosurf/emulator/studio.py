"""The program Nanosurf Studio: the values of its panels, and its use of the instrument."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from afspm.basics import InvalidValue, Plain
from afspm.emulation import RETRACE, Channels, MakerProgram, NamedFile, ScanActivity, SpectrumActivity
from afspm.model import Region
from afspm.plugins.nanosurf.emulator import files

_INTEGRAL_GAIN: Final = 0.5
"""Simulated integral gain, in 1/s, for a gain of 1 in Studio."""
_GAIN_SHARE: Final = 0.4
"""Result of the Gain Finder, as a share of the gain at which the simulated feedback oscillates."""
_NOMINAL: Final = 1.2
"""The maker's nominal cantilever values, as a multiple of the true values."""
_REACH_M: Final = 50e-6
_MOST_PIXELS: Final = 8192
_MOST_GAIN: Final = 100000
_MOST_CURVES: Final = 128
SETPOINT: Final = "z_control.setpoint"
_MOST_SHIFT_HZ: Final = 1e3


@dataclass(frozen=True)
class PanelValue:
    """A value of a panel.

    Attributes:
        at_first: initial value; its type is fixed.
        low, high: bounds of a number.
        enum: names and numbers of the choices.
        read_only: True if the value can't be set.
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
    "z_control.i_gain": PanelValue(1000, low=0, high=_MOST_GAIN),
    "z_control.feedback_signal": PanelValue("amplitude"),
    "scanner.offset_x": PanelValue(0.0, "m", read_only=True),
    "scanner.offset_y": PanelValue(0.0, "m", read_only=True),
    "scanner.offset_x_target": _length(0.0),
    "scanner.offset_y_target": _length(0.0),
    "scanner.move_speed_xy_on_surface": PanelValue(5e-6, "m/s", 1e-9, 1e-2),
    "approach.approach_speed": PanelValue(10.0, "%", 0.0, 100.0),
    "spectroscopy.grid_center_offset_x": _length(0.0),
    "spectroscopy.grid_center_offset_y": _length(0.0),
    "spectroscopy.grid_width": _length(1e-6, 0.0, 2 * _REACH_M),
    "spectroscopy.grid_height": _length(1e-6, 0.0, 2 * _REACH_M),
    "spectroscopy.grid_columns": PanelValue(1, low=1, high=_MOST_CURVES),
    "spectroscopy.grid_rows": PanelValue(1, low=1, high=_MOST_CURVES),
    "spectroscopy.grid_rotation": PanelValue(0.0, "°", -360.0, 360.0),
    "spectroscopy.selected_cycle": PanelValue("force_distance_z_z", read_only=True),
    "laser.readout.enabled": PanelValue(at_first=True),
    "laser.readout.power": PanelValue(1e-3, "W", 0.0, 5e-3),
    "probe.selected_probe": PanelValue("SIMULATED", read_only=True),
    "probe.current_deflection_sensitivity": PanelValue(0.0, "m/V", read_only=True),
    "probe.current_spring_constant": PanelValue(0.0, "N/m", read_only=True),
    "probe.cantilever_calibration.operation_mode": PanelValue(0, enum=(("non_contact", 0), ("contact", 1))),
    "probe.cantilever_calibration.wavemode_calibration_enabled": PanelValue(at_first=False),
    "mode.static_feedback.lift_height": _length(100e-9),
    "mode.dynamic_feedback.lift_height": _length(100e-9),
    "mode.wavemode_feedback.lift_height": _length(100e-9),
    "automation.stage_move_speed": PanelValue(100.0, "%", 0.0, 100.0),
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
    "device.scan_head.serial_number": PanelValue("SIMULATED", read_only=True),
    "device.scan_head.connected": PanelValue(at_first=True, read_only=True),
}
"""Values of the panels by their paths below `root.workflow`."""

FRAMES: Final = {
    "frame": ("imaging.frame_center_offset_x", "imaging.frame_center_offset_y", "imaging.scan_range_fast_axis",
              "imaging.scan_range_slow_axis", "imaging.points_per_line", "imaging.lines_per_frame", "imaging.rotation"),
    "grid": tuple(f"spectroscopy.grid_{name}" for name in
                  ("center_offset_x", "center_offset_y", "width", "height", "columns", "rows", "rotation")),
}  # fmt: skip
"""Paths of the values of a frame or grid of curves: centre, size, number of columns and rows, rotation."""

PROCEDURES_S: Final = {
    "laser.alignment.align_all": 20.0,
    "laser.alignment.align_readout": 10.0,
    "laser.alignment.align_cleandrive": 10.0,
    "laser.alignment.optimize_focus": 5.0,
    "laser.alignment.center_detector": 2.0,
    "probe.cantilever_calibration.run": 10.0,
    "probe.frequency_sweep.run": 5.0,
    "z_control.gain_finder.run": 10.0,
}
"""Duration of each procedure, experiment time."""

MODES: Final = {
    "static_mode": ("load",),
    **dict.fromkeys(("dynamic_mode", "wavemode", "wavemode_nma"), ("load", "update")),
}
"""The modes of measurement with the commands of each; every mode measures like the emulator's own
(! modes-measure-alike)."""

CYCLES: Final = ("force_distance_z_z",)
"""The ids of spectroscopy cycles."""


@dataclass
class CurveGrid:
    """A running measurement of a grid of curves.

    Attributes:
        shape: (rows, columns) of the grid.
        points_m: remaining points, (x, y).
        curves: curves taken so far.
        at_point: True if the tip is at the next curve's point, or on its way there.
    """

    shape: tuple[int, int]
    points_m: list[tuple[float, float]]
    curves: list[SpectrumActivity] = field(default_factory=list)
    at_point: bool = False


class StudioProgram(MakerProgram):
    """The program behind the tree of commands.

    Attributes:
        values: values of the panels, by path; the setpoint in V, in Hz for a frequency shift.
        on_signal: called with "scanning_started" and "scanning_finished".
        when_advanced: called after each advance; returns True if it has started a measurement.
        setpoint_unit: unit of the setpoint in `get` and `put`.
    """

    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self.values: Plain = {path: value.at_first for path, value in PANEL.items()}
        self.values["data.storage.gallery_directory"] = str(self.folder)
        self.on_signal: Callable[[str], None] = lambda name: None
        self.when_advanced: Callable[[float], bool] = lambda now_s: False
        self.setpoint_unit = "Hz" if self._holds_frequency else "V"
        self._item_name = "Image"
        self._grid: CurveGrid | None = None
        self._calibrated = False
        self._signalled_scanning = self._was_stopped = False
        feedback = self.rig.setup.feedback
        if feedback.setpoint is not None:
            self.values[SETPOINT] = feedback.setpoint
        if feedback.integral_gain is not None:
            self.values["z_control.i_gain"] = round(feedback.integral_gain / _INTEGRAL_GAIN)
        world = self.rig.world.settings
        self._cantilever = {
            "probe.current_deflection_sensitivity": world.feedback.sensitivity_m_per_v,
            "probe.current_spring_constant": world.force.spring_n_per_m,
        }
        # nominal values until the calibration
        self.values |= {path: _NOMINAL * value for path, value in self._cantilever.items()}

    @property
    def _holds_frequency(self) -> bool:
        return self.rig.world.settings.feedback.mode == "frequency-shift"

    @property
    def setpoint_units(self) -> Mapping[str, float]:
        """Units of the setpoint, each with its factor from 1 V, or from 1 Hz for a frequency shift."""
        if self._holds_frequency:
            return {"Hz": 1.0}
        return {"V": 1.0, "m": float(self.values["probe.current_deflection_sensitivity"])}

    def scale(self, path: str) -> float:
        """Return the factor from a value in `values` to the result of `get`."""
        return self.setpoint_units[self.setpoint_unit] if path == SETPOINT else 1.0

    def bounds(self, path: str) -> tuple[float, float]:
        """Return the bounds of a number, in the unit of `get`."""
        row, scale = PANEL[path], self.scale(path)
        if path == SETPOINT and self._holds_frequency:
            return -_MOST_SHIFT_HZ, _MOST_SHIFT_HZ
        return row.low * scale, row.high * scale

    def set_setpoint_unit(self, unit: str) -> None:
        """Change the setpoint's unit for `get` and `put`. Raises InvalidValue."""
        if unit not in self.setpoint_units:
            raise InvalidValue(f"{SETPOINT} has no unit {unit!r}", hint=f"one of {', '.join(self.setpoint_units)}")
        self.setpoint_unit = unit

    def get(self, path: str) -> object:
        """Return a value of a panel, or the position of the tip."""
        if path in ("scanner.offset_x", "scanner.offset_y"):
            return self.rig.probe_at(self.now_s)[path.endswith("y")]
        value: object = self.values[path] * self.scale(path) if path == SETPOINT else self.values[path]
        return value

    def put(self, path: str, value: object) -> None:
        """Set a value of a panel. Raises InvalidValue: the value is read-only, out of bounds or of another type."""
        row = PANEL[path]
        if row.read_only:
            raise InvalidValue(f"{path} can't be set")
        if isinstance(row.at_first, str | bool):
            if type(value) is not type(row.at_first):
                raise InvalidValue(f"{path}: {value!r} is no {type(row.at_first).__name__}")
        else:
            low, high = (0, max(number for _, number in row.enum)) if row.enum else self.bounds(path)
            takes_all = self.faults.lasts("takes-all", self.now_s)
            fits = takes_all or (isinstance(value, int | float) and low <= value <= high)
            if isinstance(value, bool) or not isinstance(value, int | float) or not fits:
                raise InvalidValue(f"{path}: {value!r} is not within {low:g} to {high:g}")
            value = type(row.at_first)(value / self.scale(path))
        self.values[path] = value
        self._apply_feedback()

    def advance(self, now_s: float) -> float | None:
        again_s = super().advance(now_s)
        self._go_on_with_grid(now_s)
        if self.when_advanced(now_s):
            again_s = super().advance(now_s)
            self._go_on_with_grid(now_s)
        # a stop and a start since the last advance are two signals
        if self._signalled_scanning and (self._was_stopped or not self.scanning):
            self._signalled_scanning = False
            self.on_signal("scanning_finished")
        if self.scanning and not self._signalled_scanning:
            self._signalled_scanning = True
            self.on_signal("scanning_started")
        self._was_stopped = False
        return again_s

    def stop_scan(self, now_s: float) -> None:
        super().stop_scan(now_s)
        self._was_stopped = True

    @property
    def measuring_curve(self) -> bool:
        return super().measuring_curve or self._grid is not None

    def occupied(self, now_s: float) -> bool:
        """Return True during a measurement, or if the instrument is busy otherwise."""
        return self.scanning or self.measuring_curve or self.engages or self.rig.busy(now_s)

    def start_curves(self, now_s: float) -> None:
        """Start taking the curves of the grid. Raises InstrumentBusy."""
        x, y, width, height, columns, rows, rotation_deg = (self.values[path] for path in FRAMES["grid"])
        region = Region((x, y), (max(width, 1e-12), max(height, 1e-12)), math.radians(rotation_deg))
        points = np.stack([of.ravel() for of in region.pixels_m((rows, columns))], axis=1)
        self._start_grid(CurveGrid((rows, columns), [(px, py) for px, py in points.tolist()]), now_s)

    def measure_at(self, kind: str, name: str, place: Sequence[float], now_s: float) -> None:
        """Start measuring a workspace item: a frame, a grid or a point.

        Args:
            place: centre (x, y), width, height, columns, rows and rotation, as in `FRAMES`.

        Raises:
            InstrumentBusy. InvalidValue: a value is out of bounds.
        """
        self._item_name = name
        for path, value in zip(FRAMES.get(kind, ()), place, strict=False):
            self.put(path, value)
        if kind == "frame":
            self.values["imaging.scan_mode"] = 1
            self.start_scan(now_s)
        elif kind == "grid":
            self.start_curves(now_s)
        else:
            self._start_grid(CurveGrid((1, 1), [(place[0], place[1])]), now_s)

    def stop_curve(self) -> None:
        """Stop the curve, or the whole grid."""
        super().stop_curve()
        if self._grid is not None:
            self._grid = None
            self.rig.stop_spectrum(self.now_s)
            self.rig.stop_move(self.now_s)

    def withdraw(self, now_s: float) -> None:
        self._grid = None
        super().withdraw(now_s)

    def abandon(self) -> None:
        super().abandon()
        self._grid = None

    def begin_procedure(self, path: str) -> None:
        """Start one of `PROCEDURES_S`. Raises InstrumentBusy."""
        self._refuse_busy()
        self.rig.occupy(path, PROCEDURES_S[path], self.now_s)
        if path == "probe.cantilever_calibration.run":
            self._calibrated = True
        elif path == "z_control.gain_finder.run":
            highest = _GAIN_SHARE / (self.rig.world.settings.feedback.delay_s * _INTEGRAL_GAIN)
            self.values["z_control.i_gain"] = min(round(highest), _MOST_GAIN)

    def apply_calibration(self) -> None:
        """Apply the results of the calibration. Raises InvalidValue: there was no calibration."""
        if not self._calibrated:
            raise InvalidValue("the cantilever has not been calibrated: run the calibration first")
        self.values |= self._cantilever

    def load_mode(self, name: str) -> None:
        """Load a measurement mode. Raises InstrumentBusy."""
        self._refuse_busy()
        self.values["mode.name"] = name

    def select_cycle(self, cycle: str | float) -> None:
        """Select a spectroscopy cycle by its id or number. Raises InvalidValue: the cycle is unknown."""
        number = CYCLES.index(cycle) if cycle in CYCLES else cycle
        if not (isinstance(number, int | float) and number in range(len(CYCLES))):
            raise InvalidValue(f"there is no cycle {cycle!r}", hint=f"{', '.join(CYCLES)}, or 0 to {len(CYCLES) - 1}")
        self.values["spectroscopy.selected_cycle"] = CYCLES[int(number)]

    def pause(self, now_s: float) -> None:
        if self.rig.scan is not None:
            self.rig.scan.pause(now_s)

    def resume(self, now_s: float) -> None:
        if self.rig.scan is not None:
            self.rig.scan.resume(now_s)

    def move(self) -> None:
        """Start moving the tip to the target. Raises InstrumentBusy, InvalidValue."""
        self.rig.setup.move_speed_m_s = self.values["scanner.move_speed_xy_on_surface"]
        self.rig.move_probe(
            (self.values["scanner.offset_x_target"], self.values["scanner.offset_y_target"]), self.now_s
        )

    def lines(self) -> list[tuple[str, str, list[float]]]:
        """Return name, unit and the complete lines of each channel of the last started scan, as of one moment.

        Lines are flattened in scanning order. Empty before the first scan.
        """
        scan, now_s = self.rig.scan, self.now_s
        if scan is None:
            return []
        done = scan.lines_done(now_s)
        found = []
        for name, (unit, values) in _named(scan.channels(now_s)).items():
            rows = values if scan.upwards else values[::-1]
            found.append((name, unit, [float(one) for one in rows[:done].ravel()]))
        return found

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
        self._apply_feedback()
        self.rig.setup.feedback = replace(self.rig.setup.feedback, on=True)

    def _apply_feedback(self) -> None:
        gain, setup = _INTEGRAL_GAIN * self.values["z_control.i_gain"], self.rig.setup
        setup.feedback = replace(setup.feedback, setpoint=self.values[SETPOINT], integral_gain=gain)

    def scan_files(self, scan: ScanActivity, shown_s: float) -> Sequence[NamedFile]:
        return self._files(lambda: files.image(scan, shown_s, self.values["mode.name"]), shown_s)

    def curve_files(self, curve: SpectrumActivity, shown_s: float) -> Sequence[NamedFile]:
        return self._files(lambda: files.curves([curve], (1, 1), shown_s, self.values["mode.name"]), shown_s)

    def _start_grid(self, grid: CurveGrid, now_s: float) -> None:
        self._refuse_busy()
        if not self.faults.strikes("spectrum-refused", now_s):
            self.prepare_curve()
            self._grid = grid

    def _go_on_with_grid(self, now_s: float) -> None:
        # Studio moves on to the next point of its grid once it regulates again
        grid = self._grid
        while grid is not None and not self.rig.busy(now_s) and not self.rig.is_held(now_s):
            if grid.at_point:
                grid.at_point = False
                try:
                    grid.curves.append(self.rig.start_spectrum("force", self.now_s))
                except InvalidValue as error:  # no command is open that could be refused
                    self._log.warning("the curves were interrupted: %s", error)
                    self._grid = None
                    return
            elif grid.points_m:
                self.rig.setup.move_speed_m_s = self.values["scanner.move_speed_xy_on_surface"]
                self.rig.move_probe(grid.points_m.pop(0), self.now_s)
                grid.at_point = True
            else:
                self._grid = None
                self._save(self._grid_files(grid, self.file_clock.shown_s(now_s)), now_s)
                return

    def _grid_files(self, grid: CurveGrid, shown_s: float) -> Sequence[NamedFile]:
        return self._files(lambda: files.curves(grid.curves, grid.shape, shown_s, self.values["mode.name"]), shown_s)

    def _files(self, made: Callable[[], bytes], shown_s: float) -> Sequence[NamedFile]:
        values = self.values
        if not values["data.storage.nhf_backend_enabled"] or values["data.storage.nhf_auto_store_mode"] == 0:
            return []
        while (self.folder / (name := self._next_name(shown_s))).exists():
            pass
        return [(name, made())]

    def _next_name(self, shown_s: float) -> str:
        # A file never leaves its folder.
        index = self.values["data.storage.next_file_index"]
        self.values["data.storage.next_file_index"] = index + 1
        base = _fit_for_a_name(self.values["data.storage.file_basename"])
        marked = base if "[INDEX]" in base else f"{base}_[INDEX]"
        written = datetime.fromtimestamp(shown_s, UTC).astimezone()
        for mark, text in (
            ("[INDEX]", f"{index:05d}"),
            ("[DATE]", f"{written:%Y-%m-%d}"),
            ("[TIME]", f"{written:%H-%M-%S}"),
            ("[ITEM_NAME]", _fit_for_a_name(self._item_name)),
        ):
            marked = marked.replace(mark, text)
        return f"{marked}.nhf"


def _fit_for_a_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_\[\]-]", "_", text)[:100]


def _named(channels: Channels) -> Channels:
    return {
        f"{name.removesuffix(RETRACE)} {'Backward' if name.endswith(RETRACE) else 'Forward'}": data
        for name, data in channels.items()
    }
