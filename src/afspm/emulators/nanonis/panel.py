"""The state of the Nanonis software: its settings, its activity on the simulated instrument, and its files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any, Final

import numpy as np

from afspm.clock import Clock
from afspm.emulators.activities import RETRACE, SimulatedScan, SimulatedSpectrum
from afspm.emulators.faults import Faults
from afspm.emulators.nanonis import files
from afspm.emulators.nanonis.logger import TcpLogger
from afspm.emulators.nanonis.registers import Registers
from afspm.emulators.nanonis.sweeps import SweepSettings
from afspm.emulators.rig import Rig
from afspm.errors import InvalidValue
from afspm.model import Region

FAULT_KINDS: Final[Mapping[str, str]] = {
    "file-late": "a file appears only after the duration",
    "half-file": "a file is half written, and whole only after the duration",
    "file-missing": "a file is announced and never written",
    "stale-name": "the file of the scan before is announced for a scan",
    "autosave-off": "scans and spectra are not saved for the duration, whatever is set",
    "late-start": "a scan begins only after the duration, and is not told as running until then",
    "no-start": "a scan does not begin, and nobody is told",
    "ends-at-once": "for the duration, who waits for the end of a scan while there is none is answered at once",
    "safe-tip": "the safe tip withdraws the tip and ends the scan",
    "safe-tip-unnoticed": "the safe tip withdraws the tip, and the scan goes on in the air",
    "panel-stop": "somebody stops the scan at the panel",
}
MODULES: Final = {"BiasSpectr": "IV", "ZSpectr": "force"}
_PIXELS_AT_ONCE: Final = 16
MOST_POINTS: Final = 1 << 16
"""Of a spectrum."""
CURRENT: Final = 0
_BIAS: Final = 24
_SIGNALS: Final = {"Current": CURRENT, "Height": 14, "Phase": 16, "Amplitude": 17, "Frequency Shift": 18}
_UNITS: Final = {"Current": "A", "Height": "m", "Phase": "deg", "Amplitude": "V", "Frequency Shift": "Hz"}
_OF_CURVES: Final = {"Deflection": (20, "m"), "Force": (21, "N"), "dI/dV": (22, "S")}
"""Signals of spectra alone, with their units."""
_SLOTS: Final = 24
_NO_FILE_NAME: Final = frozenset('\\/:*?"<>|') | {chr(number) for number in range(32)}
_LONGEST_NAME: Final = 200
_STEP_M: Final = 100e-9
_STEP_S: Final = 1e-3
_NAMES: Final = {"Height": "Z", "Frequency Shift": "OC M1 Freq. Shift"}
_SWEPT: Final = {"Bias": "Bias calc", "Z": "Z rel"}
_CURVE_CHANNELS: Final = {"BiasSpectr": (CURRENT, 22), "ZSpectr": (20, 21)}
"""What the simulated curves have."""
_Z_AVERAGED: Final = 20
_EXPERIMENTS: Final = {"IV": "bias spectroscopy", "force": "Z spectroscopy"}
_BASE_NAMES: Final = {"IV": "Bias-Spectroscopy", "force": "Z-Spectroscopy"}


@dataclass
class StartedScan:
    """A scan that was started: as the panel was then."""

    scan: SimulatedScan
    frame: tuple[float, float, float, float, float]
    line_s: tuple[float, float]
    channels: list[int]


class NanonisState:
    """The state of the software.

    Args:
        folder: the session folder; told to clients as `session_path`.

    Attributes:
        frame: x, y, width, height in m, angle clockwise in degrees.
        speed: forward, backward in m/s and s a line, whether the time is kept (and not the speed), their ratio.
        autosave: "all", "next" or "off".
        ends: how many scans have ended; `ended_s` when the last, `last_path` where it was saved.
        slots: the signals in the 24 slots of the Signals Manager.
        logger: the TCP TcpLogger.
        client: what is remembered of the client that asks just now.
        pulse_holds: whether the z controller is on hold during a pulse.
        z_controller: "off", "on" or "safe"; `z_follows_s` is when it follows what was set.
    """

    def __init__(
        self,
        rig: Rig,
        faults: Faults,
        clock: Clock,
        folder: Path,
        *,
        session_path: str,
        range_m: float,
        release: int,
        rows_as_recorded: bool,
    ) -> None:
        self.rig, self.faults, self.clock = rig, faults, clock
        self.folder, self.session_path = folder, session_path or str(folder)
        self._root, self._root_path = self.folder, self.session_path
        self.range_m = (range_m, range_m, 2e-6)
        self.signals = _signal_names()
        self.channels = sorted(_SIGNALS[name] for name in rig.channels if name in _SIGNALS)
        self.pixels, self.lines = 128, 128
        self.frame = (0.0, 0.0, 1e-6, 1e-6, 0.0)
        self.speed = (2e-6, 2e-6, 0.5, 0.5, 0, 1.0)
        self.continuous = self.bouncy = False
        self.autosave, self.series, self.comment, self.modules = "all", "unnamed", "", ["Z-Controller"]
        self.scanning: StartedScan | None = None
        self.last: StartedScan | None = None
        self.curve: SimulatedSpectrum | None = None
        self.curve_name, self.curves_ended = "", 0
        self.sweeps = {module: SweepSettings() for module in MODULES}
        self.curve_names = dict(_BASE_NAMES)
        self.ends, self.ended_s, self.last_path = 0, -math.inf, ""
        used = [*_SIGNALS.values(), _BIAS]
        self.slots = [*used, *(index for index in range(len(self.signals)) if index not in used)][:_SLOTS]
        self.logger = TcpLogger()
        self.client: dict[str, Any] = {}
        self.opened: set[str] = set()
        self.autopaste, self.pulse_holds = 2, True
        self._motor_m, self._motor_walks = (0.0, 0.0, 0.0), (0, 0, 0.0)
        self.z_controller = "on" if rig.feedback.on else "off"
        self.z_follows_s = 0.0
        self.own_speed, self.own_speed_m_s = True, rig.move_speed_m_s
        self.registers = Registers()
        self._shifts = "Frequency Shift" in rig.channels
        if self._shifts:
            sensor = rig.world.settings.feedback.sensor
            self.registers.set("PLL.CenterFreqSet", [1, sensor.resonance_hz])
            self.registers.set("PLL.AmpCtrlSetpntSet", [1, sensor.oscillation_m])
        self._late: list[tuple[float, Path, bytes]] = []
        self._starts: tuple[float, bool] | None = None
        self._saved: dict[tuple[str, str], int] = {}
        self.release, self.rows_as_recorded = release, rows_as_recorded

    # --- what happens by itself ---

    def advance(self, now_s: float) -> float | None:
        """Up to now; returns when a file is to be written."""
        self._go_wrong(now_s)
        if self._starts is not None and now_s >= self._starts[0]:
            (_, upwards), self._starts = self._starts, None
            self.start_scan(upwards)
        if self.scanning is not None and not self.scanning.scan.running(now_s):
            self._end_scan(self.scanning, now_s)
        if self.curve is not None and not self.curve.running(now_s):
            self._end_curve(self.curve, now_s)
        due = [late for late in self._late if late[0] <= now_s]
        self._late = [late for late in self._late if late[0] > now_s]
        for _, path, content in due:
            self._write(path, content)
        starts = [] if self._starts is None else [self._starts[0]]
        return min((*starts, *(late[0] for late in self._late)), default=None)

    def _go_wrong(self, now_s: float) -> None:
        if self.scanning is not None and self.faults.strikes("panel-stop", now_s):
            self.rig.stop_scan()
        if self.faults.strikes("safe-tip", now_s):
            self.rig.withdraw()
            self.z_controller = "safe"
        if self.scanning is not None and self.faults.strikes("safe-tip-unnoticed", now_s):
            self.rig.engaged = False
            self.z_controller = "safe"

    def begin_scan(self, upwards: bool) -> None:
        """Start a scan on request, possibly late. Raises RigBusy."""
        now_s = self.clock.now_s()
        late = self.faults.strikes("late-start", now_s)
        if late is not None:
            self._starts = (now_s + late.duration_s, upwards)
        elif not self.faults.strikes("no-start", now_s):
            self.start_scan(upwards)

    def start_scan(self, upwards: bool) -> None:
        """Start a scan at once. Raises RigBusy."""
        x, y, width, height, clockwise_deg = self.frame
        size_m = (width * (self.pixels - 1) / self.pixels, height * max(self.lines - 1, 1) / self.lines)
        self.rig.region = Region((x, y), size_m, -math.radians(clockwise_deg))
        self.rig.shape = (self.lines, self.pixels)
        forward_s, backward_s = self.speed[2:4]
        self.rig.line_s, self.rig.upwards = forward_s + backward_s, upwards
        scan = self.rig.start_scan()
        self.scanning = self.last = StartedScan(scan, self.frame, (forward_s, backward_s), list(self.channels))

    def _end_scan(self, ended: StartedScan, now_s: float) -> None:
        self.scanning = None
        finished = ended.scan.stopped_s is None
        path = self.save_scan(ended, now_s) if finished and self._saves(now_s) else ""
        if not (path and self.faults.strikes("stale-name", now_s)):
            self.last_path = path
        self.ends, self.ended_s = self.ends + 1, ended.scan.end_s
        if finished and self.continuous:
            self.start_scan(ended.scan.upwards != self.bouncy)

    def _saves(self, now_s: float) -> bool:
        if self.autosave == "off" or self.faults.lasts("autosave-off", now_s):
            return False
        self.autosave = "off" if self.autosave == "next" else self.autosave
        return True

    def start_curve(self, module: str, base_name: str) -> None:
        """Raises RigBusy."""
        kind = MODULES[module]
        self.curve_names[kind] = self.name(base_name) or self.curve_names[kind]
        sweep = self.sweeps[module]
        curve = sweep.of(self.rig.start_spectrum(kind, sweep.sweeps))
        self.curve = curve if sweep.channels is None else self._recorded(curve, sweep.channels)

    def _recorded(self, curve: SimulatedSpectrum, channels: list[int]) -> SimulatedSpectrum:
        """The channels that were chosen; one that the simulated curve does not have does not change during it."""
        names, units, columns = [curve.names[0]], [curve.units[0]], [curve.values[:, 0]]
        for index in channels:
            having = [k for k, name in enumerate(curve.names) if _curve_signal(name) == index]
            for k in having:
                names.append(curve.names[k])
                units.append(curve.units[k])
                columns.append(curve.values[:, k])
            if not having:
                name, unit = _name_and_unit(self.signals[index])
                names.append(name)
                units.append(unit)
                columns.append(np.full(len(curve.values), self.signal_values([index], curve.start_s)[0]))
        return replace(curve, names=tuple(names), units=tuple(units), values=np.stack(columns, axis=1))

    def curve_channels(self, module: str) -> list[int]:
        """The indexes of the signals that a module records."""
        chosen = self.sweeps[module].channels
        return list(_CURVE_CHANNELS[module]) if chosen is None else chosen

    def stop_curve(self) -> None:
        if self.curve is not None:
            self.rig.stop_spectrum()
            self.curve = None
            self.curves_ended += 1

    def _end_curve(self, curve: SimulatedSpectrum, now_s: float) -> None:
        self.curve = None
        self.curves_ended += 1
        module = next(name for name, kind in MODULES.items() if kind == curve.kind)
        if self.sweeps[module].saves and not self.faults.lasts("autosave-off", now_s):
            content = files.dat(self._curve_header(curve, now_s), curve_columns(curve), curve.values)
            self._save(self._next_name(self.curve_names[curve.kind], 5, ".dat"), content, now_s)

    # --- what is set ---

    def set_buffer(self, channels: list[int], pixels: int, lines: int) -> None:
        """The pixels of a line come in packages of 16: any other number is made one of those."""
        ratio = self.lines / self.pixels
        self.channels = channels or self.channels
        self.pixels = max(_PIXELS_AT_ONCE, round(pixels / _PIXELS_AT_ONCE) * _PIXELS_AT_ONCE)
        self.lines = lines or max(1, round(self.pixels * ratio))

    def set_frame(self, x: float, y: float, width: float, height: float, angle_deg: float) -> None:
        """Set the frame, moved into the scanner's range as the real one does."""
        width, height = min(width, self.range_m[0]), min(height, self.range_m[1])
        x, y = (
            float(np.float32(np.clip(value, (size - whole) / 2, (whole - size) / 2)))
            for value, size, whole in zip((x, y), (width, height), self.range_m, strict=False)
        )
        self.frame = (x, y, width, height, angle_deg)
        forward, backward, forward_s, backward_s, keeps_time, ratio = self.speed
        if keeps_time:
            forward, backward = width / forward_s, width / backward_s
        else:
            forward_s, backward_s = width / forward, width / backward
        self.speed = (forward, backward, forward_s, backward_s, keeps_time, ratio)

    def set_z_controller(self, now_s: float, *, on: bool, off_delay_s: float = 0.0) -> None:
        """It follows after the delay; switched on it brings a withdrawn tip back."""
        self.z_controller = "on" if on else "off"
        self.z_follows_s = now_s + (0.0 if on else off_delay_s)
        if not on and self.rig.feedback.on and self.rig.engaged and self.scanning is None:
            lift_m = (*self.registers.get("ZCtrl.TipLift"), 0.0)[0]
            self.rig.hold(float(np.mean([self.z_m(now_s) for _ in range(_Z_AVERAGED)])) + lift_m)
        self.rig.feedback = replace(self.rig.feedback, on=on)
        if on:
            self.rig.engaged = True

    def z_status(self, now_s: float) -> int:
        """Off 1, on 2, hold 3, switching off 4, safe tip 5, withdrawing 6."""
        doing = self.rig.doing(now_s)
        if doing == "approach" and not self.rig.engaged:
            return 6
        if self.z_controller == "on" and (doing in ("crash", "shaper") or (doing == "pulse" and self.pulse_holds)):
            return 3
        if self.z_controller == "off" and now_s < self.z_follows_s:
            return 4
        return {"off": 1, "on": 2, "safe": 5}[self.z_controller]

    def z_is_on(self, now_s: float) -> bool:
        """True while the real-time controller has the z feedback on."""
        return self.z_status(now_s) in (2, 4)

    def set_session_path(self, path: str) -> None:
        """A folder within that of the session at the start. Raises InvalidValue."""
        root = self._root_path.rstrip("\\/")
        folders = path[len(root) :].replace("\\", "/").strip("/").split("/")
        if path.rstrip("\\/") != root and not path.startswith((f"{root}/", f"{root}\\")):
            raise InvalidValue(f"Session Path not valid: {path!r}", hint=f"{root}, or a folder in it")
        folder = self._root
        for name in filter(None, folders):
            folder = folder / self.name(name)
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.session_path = folder, path

    def name(self, text: str) -> str:
        """Check a part of a file's name. Raises InvalidValue: Windows, where Nanonis runs, does not allow it."""
        if not _NO_FILE_NAME.isdisjoint(text) or len(text) > _LONGEST_NAME or text.strip(". ") != text:
            raise InvalidValue(f"{text!r} can't be part of a file's name")
        return text

    def experiment_s(self, real_s: float) -> float:
        """Convert real to experiment seconds."""
        return real_s / self.clock.real_s(1.0)

    # --- what is measured ---

    def signal_values(self, indexes: Sequence[int], now_s: float) -> list[float]:
        """Return the values of signals at one moment; unconnected ones are zero."""
        shown = self.rig.signals(now_s)
        values = {_SIGNALS[name]: value for name, value in shown.items() if name in _SIGNALS}
        values |= {_SIGNALS["Height"]: self._z_m(shown["Height"]), _BIAS: self.rig.bias_v}
        return [values.get(index, 0.0) for index in indexes]

    def frequency_shift_hz(self, now_s: float) -> float | None:
        """Return the sensor's frequency shift; None if the feedback's mode has none."""
        index = _SIGNALS["Frequency Shift"]
        return self.signal_values([index], now_s)[0] if self._shifts else None

    @property
    def z_controller_name(self) -> tuple[str, str]:
        """Name and unit of what it holds."""
        return ("OC M1 Freq. Shift", "Hz") if self._shifts else ("log Current", "A")

    def z_m(self, now_s: float) -> float:
        """Return the height of the tip."""
        return self._z_m(self.rig.signals(now_s)["Height"])

    def _z_m(self, shown_m: float) -> float:
        """A tip that is withdrawn is at the upper end."""
        return shown_m if self.rig.engaged else self.range_m[2] / 2 + shown_m

    def start_motor(self, axis: int, steps: int) -> None:
        """Walk along X, Y or Z (0, 1, 2). Raises RigBusy."""
        now_s = self.clock.now_s()
        at_m = self.motor_at_m(now_s)
        self.rig.occupy("motor", abs(steps) * _STEP_S)
        self._motor_m, self._motor_walks = at_m, (axis, steps, now_s)

    def stop_motor(self, now_s: float) -> None:
        """Stay where the motor has come to."""
        self._motor_m, self._motor_walks = self.motor_at_m(now_s), (0, 0, now_s)
        self.rig.stop("motor")

    def motor_at_m(self, now_s: float) -> tuple[float, float, float]:
        """Return the position of the coarse motor."""
        axis, steps, since_s = self._motor_walks
        walked = math.copysign(min(abs(steps), (now_s - since_s) / _STEP_S), steps)
        at_m = list(self._motor_m)
        at_m[axis] += int(walked) * _STEP_M
        return at_m[0], at_m[1], at_m[2]

    # --- pictures and files ---

    def images(
        self, scanning: StartedScan, until_s: float | None
    ) -> dict[int, tuple[str, str, np.ndarray, np.ndarray]]:
        """Return for each channel name, unit, forward and backward values [y, x]; lines not yet scanned are NaN."""
        drawn = scanning.scan.channels(until_s)
        found = {}
        for channel, (unit, values) in drawn.items():
            if channel in _SIGNALS:
                back = drawn.get(f"{channel}{RETRACE}", (unit, values))[1]
                found[_SIGNALS[channel]] = (_NAMES.get(channel, channel), unit, values, back)
        nothing = np.zeros(scanning.scan.shape)
        for index in scanning.channels:
            if index not in found:
                found[index] = (*_name_and_unit(self.signals[index]), nothing, nothing)
        return {index: found[index] for index in scanning.channels}

    def save_scan(self, ended: StartedScan, now_s: float) -> str:
        """Save it, as well as the faults allow. Returns where it is said to be."""
        name = self._next_name(self.series, 3, ".sxm")
        path = self.told_path(name)
        scan, feedback = ended.scan, ended.scan.feedback
        images = self.images(ended, scan.stopped_s)
        x, y, width, height, angle_deg = ended.frame
        integral = feedback.integral_gain or 0.0
        controller, unit = self.z_controller_name
        z = (
            controller,
            bool(feedback.on),
            feedback.setpoint or 0.0,
            unit,
            feedback.proportional_gain or 0.0,
            integral,
        )
        saved = files.SxmContent(
            path,
            scan.start_s,
            scan.end_s - scan.start_s,
            (x, y),
            (width, height),
            angle_deg,
            scan.upwards,
            ended.line_s,
            scan.bias_v,
            z,
            self.comment,
            [(index, *image) for index, image in images.items()],
            self._settings(ended, images),
        )
        return path if self._save(name, files.sxm(saved), now_s) else ""

    def told_path(self, name: str) -> str:
        """Return the path of a session file on the controller's computer."""
        windows = "\\" in self.session_path
        return str(PureWindowsPath(self.session_path) / name) if windows else str(Path(self.session_path) / name)

    def _settings(
        self, ended: StartedScan, images: Mapping[int, tuple[str, str, np.ndarray, np.ndarray]]
    ) -> dict[str, str]:
        scan, number = ended.scan, files.engineering
        return {
            "NanonisMain>Session Path": self.session_path,
            "NanonisMain>SW Version": "Generic 5",
            "Bias>Bias (V)": number(scan.bias_v),
            "Z-Controller>Controller status": "ON" if scan.feedback.on else "OFF",
            "Z-Controller>Setpoint": number(scan.feedback.setpoint or 0.0),
            "Scan>Scanfield": ";".join(number(value) for value in ended.frame),
            "Scan>series name": self.series,
            "Scan>channels": ";".join(f"{name} ({unit})" for name, unit, _, _ in images.values()),
            "Scan>pixels/line": str(scan.shape[1]),
            "Scan>lines": str(scan.shape[0]),
            "Scan>speed forw. (m/s)": number(ended.frame[2] / ended.line_s[0]),
            "Scan>speed backw. (m/s)": number(ended.frame[2] / ended.line_s[1]),
        }

    def _curve_header(self, curve: SimulatedSpectrum, now_s: float) -> dict[str, str]:
        (x, y), number = curve.position_m, files.engineering
        return {
            "Experiment": _EXPERIMENTS[curve.kind],
            "Saved Date": files.moment(now_s),
            "User": "",
            "Date": "",
            "X (m)": number(x),
            "Y (m)": number(y),
            "Z (m)": number(0.0),
            "Start time": files.moment(curve.start_s),
            "Bias>Bias (V)": number(self.rig.bias_v),
        }

    def _next_name(self, base: str, digits: int, suffix: str) -> str:
        """The next number of which there is no file yet."""
        while True:
            number = self._saved[base, suffix] = self._saved.get((base, suffix), 0) + 1
            name = f"{base}{number:0{digits}d}{suffix}"
            if not (self.folder / name).exists():
                return name

    def _save(self, name: str, content: bytes, now_s: float) -> bool:
        """Save it, as well as the faults allow. Returns whether a file can be told of."""
        path = self.folder / name
        if self.faults.strikes("file-missing", now_s):
            return True
        late, half = self.faults.strikes("file-late", now_s), self.faults.strikes("half-file", now_s)
        if late or half:
            self._late.append((now_s + (late or half).duration_s, path, content))  # type: ignore[union-attr]
        return bool(late) or self._write(path, content[: len(content) // 2] if half else content)

    def _write(self, path: Path, content: bytes) -> bool:
        try:
            path.write_bytes(content)
        except OSError as error:
            self.rig.log.warning("%s can't be written: %s", path, error)
            return False
        return True


def curve_columns(curve: SimulatedSpectrum) -> list[str]:
    """Return a curve's column names as Nanonis writes them: "Current [bwd] (A)"; the swept signal comes first."""
    columns: list[str] = []
    for name, unit in zip(curve.names, curve.units, strict=True):
        forward = name.removesuffix(RETRACE)
        called = forward if columns else _SWEPT.get(forward, forward)
        columns.append(f"{called}{'' if forward == name else ' [bwd]'} ({unit})")
    return columns


def _signal_names() -> list[str]:
    """128 of them, as the signals manager has."""
    signals = [f"Input {number + 1} (V)" for number in range(128)]
    for name, index in _SIGNALS.items():
        signals[index] = f"{_NAMES.get(name, name)} ({_UNITS[name]})"
    for name, (index, unit) in _OF_CURVES.items():
        signals[index] = f"{name} ({unit})"
    signals[_BIAS] = "Bias (V)"
    return signals


def _name_and_unit(signal: str) -> tuple[str, str]:
    name, _, unit = signal.removesuffix(")").rpartition(" (")
    return name, unit


def _curve_signal(column: str) -> int | None:
    """The index of the signal of a simulated curve's column."""
    name = column.removesuffix(RETRACE)
    return _SIGNALS.get(name) if name in _SIGNALS else _OF_CURVES.get(name, (None,))[0]
