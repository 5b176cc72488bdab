"""The program SmartScan: the values and methods below `spm`, and their use of the instrument."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

from afspm.basics import InvalidValue, Plain
from afspm.emulation import RETRACE, MakerProgram, NamedFile, ScanActivity, SpectrumActivity
from afspm.model import Region
from afspm.plugins.park.emulator import files
from afspm.plugins.park.emulator.engine import Wait
from afspm.plugins.park.file_header import MICROMETRE

GEOMETRY: Final[dict[str, tuple[type, float, float]]] = {
    "pixelHeight": (int, 1, 8192),
    "pixelWidth": (int, 1, 8192),
    "width": (float, 1e-6, 100.0),
    "height": (float, 1e-6, 100.0),
    "offsetX": (float, -50.0, 50.0),
    "offsetY": (float, -50.0, 50.0),
    "rotation": (float, -360.0, 360.0),
}
"""The frame in the order of `geometry_query`: type and bounds, in µm and degrees."""
_CURVES: Final = {"fd": "force", "iv": "IV"}
_OTHER_NAMES: Final = {
    "zheight": "Height",
    "topography": "Height",
    "ncmamplitude": "Amplitude",
    "ncmphase": "Phase",
    "ncmfrequency": "Frequency Shift",
}
"""Names of channels in users' scripts; "Channel" before a name, capitals and spaces are ignored."""
_SHOWN: Final = {"m": ("um", 1e6), "A": ("pA", 1e12)}
"""Units of read values, with the factor from SI."""
_MOST_READ: Final = 10_000
_LOCATION: Final = {
    "subDir": "", "fileName": "SIMULATED", "fileSuffix": "", "direction": "auto", "envLogDir": "", "fieldWidth": 4,
    "precision": 1, "jpegSave": False, "cameraSave": False, "imageQualitySave": False,
}  # fmt: skip
"""Members of `dataLocation` besides the base folder, as users' scripts set them; folder and name have an effect."""
_RETRACTED_UM, _EXTENDED_UM = 7.5, -7.5
_SCANNER_UM_S, _STAGE_UM_S = 10.0, 1000.0
"""Default speed of the scanner; speed of a stage at its normalized speed of 1."""
_STAGE_TOP_UM: Final = 1e4
_TOUCHES_UM: Final = 0.02
"""Depth below the height of contact at which a move starts to damage the tip."""
_SWEEP_S: Final = 3.0
_LINE_SCAN: Final = "line scan"
_LINE_SCAN_S: Final = 1e9
"""Duration of a line scan, experiment time: SmartScan repeats the line until the scan is stopped."""
_SETPOINT, _ENABLE, _RATE, _BIAS = "zservo.setpoint.value", "zservo.enable", "scan.rate", "bias.tip"
_GAIN: Final = "zservo.gain"
_PROPORTIONAL, _INTEGRAL = 0.2, 3000.0
"""Simulated gains for gains of 1 in SmartScan; the second in 1/s."""
_BOUNDS: Final = {_SETPOINT: (-10.0, 10.0), _RATE: (1e-4, 1e5), _BIAS: (-10.0, 10.0), "bias.sample": (-10.0, 10.0)}


class SmartScanProgram(MakerProgram):
    """The program behind the scripts.

    Attributes:
        geometry: the scan frame.
        reports_gains: True if the gains of the feedback can be read, False if only set.
    """

    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self.geometry: dict[str, float] = dict(zip(GEOMETRY, (128, 128, 1.0, 1.0, 0.0, 0.0, 0.0), strict=True))
        feedback = self.rig.setup.feedback
        self._values: Plain = {
            _RATE: 1.0,
            _SETPOINT: 0.7 if feedback.setpoint is None else feedback.setpoint,
            _ENABLE: True,
            _BIAS: self.rig.setup.bias_v,
            "bias.sample": 0.0,
            "zservo.setpoint.normalized": False,
            "zservo.setpoint.normValue": 1.0,
            _GAIN: {"p": 0.5, "i": 0.5, "z+": 1.0, "z-": 1.0},
            "spect.iv": self._sweep_at_first(),
            "scan.options": {"twoWay": False, "overScan": {"enable": False, "percent": 5}},
            "dataLocation": {"baseDir": str(self.folder), **_LOCATION},
        }
        self._reported: dict[str, Callable[[], object]] = {
            "zscanner.pos": lambda: self._z_um,
            "zscanner.fullyRetractedPos": lambda: _RETRACTED_UM,
            "zscanner.fullyExtendedPos": lambda: _EXTENDED_UM,
            "zstage.pos": lambda: self.stage_um[2],
            "xystage.pos": lambda: {"x": self.stage_um[0], "y": self.stage_um[1]},
            "focusstage.pos": lambda: self._focus_um,
            "approach.state": lambda: "approaching" if self.engages else "idle",
        }
        self._methods: dict[str, Callable[..., object]] = {
            "scan.setScanGeometry": self._set_geometry,
            "scan.triggerImageScan": lambda: self.start_scan(self.now_s),
            "scan.startImageScan": self._start_and_wait,
            "scan.triggerLineScan": self._scan_line,
            "scan.stop": lambda: self.stop_scan(self.now_s),
            "scan.channels.names": lambda: list(self._recorded),
            "scan.channels.add": self._add_channel,
            "scan.channels.remove": self._remove_channel,
            "addChannel": self._add_channel,
            "spect.start": self._measure_curve,
            "spect.trigger": self._start_curve,
            "spect.stop": self.stop_curve,
            "approach.start": self._approach,
            "approach.stop": self.stop_engaging,
            "ncm.sweepAuto": self._sweep,
            "ncm.sweepAutoFullRange": self._sweep,
            "zscanner.retractAll": self._retract,
            "zscanner.moveTo": self._move_scanner,
            "zstage.move": lambda by_um, speed=1.0: self._move_z_stage(self.stage_um[2] + by_um, speed),
            "zstage.moveTo": self._move_z_stage,
            "zstage.reset": lambda: self._move_z_stage(_STAGE_TOP_UM),
            "xystage.moveTo": self._move_xy_stage,
            "xystage.reset": lambda: self._move_xy_stage(0.0, 0.0),
            "focusstage.moveTo": self._move_focus,
            "focusstage.reset": lambda: self._move_focus(0.0),
            "xyscanner.moveTo": self._move,
            "readChannel": self._read_channel,
            "readChannelAveraged": self._average_channel,
            "sleep": self._sleep,
        }
        self.reports_gains = True
        self.stage_um = [0.0, 0.0, 0.0]
        self._z_um = self._focus_um = 0.0
        self._recorded = dict.fromkeys(name.removesuffix(RETRACE) for name in self.rig.channels)
        self._wakings_s: list[float] = []
        self._saved = 0
        self._apply()

    def _sweep_at_first(self) -> Plain:
        # the names are those of users' scripts; the sweep itself is a setting of the emulator
        iv = self.rig.world.settings.iv
        bias = {"start": 0.0, "end": 0.0, "lowest": -iv.range_v, "highest": iv.range_v, "isReversed": False}
        return {
            "bias": {**bias, "useStartEndSplit": False},
            "pixels": iv.points,
            "speed": 4.0 * iv.range_v / iv.duration_s,
            "period": iv.duration_s,
            "usePeriod": False,
            "cycle": {"count": 1, "use": False},
            "lift": {"enabled": False, "height": 0.0},
            "limit": {"enabled": False, "current": 10.0},
            "isLaserOff": False,
        }

    @property
    def names(self) -> str:
        """The names below `spm` as JSON: an object with the lists "values" and "methods"."""
        return json.dumps({"values": [*self._values, *self._reported], "methods": list(self._methods)})

    def ask(self, kind: str, path: str, given: list[object]) -> object:
        """Execute a request of a script, in the form of `Ask`. Raises AfspmError; TypeError: wrong arguments.

        A script sees the time of the controller's clock.
        """
        if kind == "now":
            return round(self.file_clock.shown_s(self.now_s) * 1e3)
        if kind == "call":
            return self._methods[path](*given)
        if kind == "set":
            self._set(path, given[0])
            return None
        if path == _GAIN and not self.reports_gains:
            return None
        if path == _ENABLE:
            return self.rig.feedback_reads(self.now_s)
        return self._reported[path]() if path in self._reported else self._values[path]

    def next_waking_s(self, now_s: float) -> float | None:
        """Return the experiment time at which the next sleeping script continues; None without a sleeping script."""
        self._wakings_s = [at_s for at_s in self._wakings_s if at_s > now_s]
        return min(self._wakings_s, default=None)

    # -- methods

    def _set(self, path: str, value: object) -> None:
        if path not in self._values:
            raise InvalidValue(f"{path} can't be set")
        present = self._values[path]
        if path in _BOUNDS:
            self._number(path, value, *_BOUNDS[path])
        elif isinstance(present, dict):
            if not isinstance(value, dict):
                raise InvalidValue(f"{path}: {value!r} is no object")
            value = {**present, **value}
            for member, number in value.items() if path == _GAIN else ():
                self._number(f"{path}.{member}", number, 0.0, 100.0)
        elif isinstance(value, bool) is not isinstance(present, bool):
            raise InvalidValue(f"{path}: {value!r}")
        self.rig.account(self.now_s)  # with the feedback as it was
        self._values[path] = value
        self._apply()

    def _number(self, name: str, value: object, low: float, high: float, *, whole: bool = False) -> None:
        if not self.faults.lasts("takes-all", self.now_s):
            _number(name, value, low, high, whole=whole)

    def _set_geometry(self, wanted: object) -> None:
        if not isinstance(wanted, dict):
            raise InvalidValue(f"the geometry: {wanted!r} is no object")
        for name, (kind, low, high) in GEOMETRY.items():
            self._number(name, wanted.get(name, self.geometry[name]), low, high, whole=kind is int)
        self.geometry |= {name: wanted[name] for name in GEOMETRY if name in wanted}

    def _start_and_wait(self) -> Wait:
        self.start_scan(self.now_s)
        return Wait(lambda: self.scanning)

    def _start_curve(self, mode: str | Plain = "fd", place: str = "given") -> None:
        wanted = mode if isinstance(mode, dict) else {"mode": mode, "type": place}
        if wanted.get("mode") not in _CURVES or wanted.get("type") != "here":
            raise InvalidValue(f"no points are given for {mode!r}, or there is no such spectroscopy")
        self.start_curve(_CURVES[wanted["mode"]], self.now_s)

    def _measure_curve(self, mode: str | Plain = "fd", place: str = "given") -> Wait:
        self._start_curve(mode, place)
        return Wait(lambda: self.measuring_curve)

    def _scan_line(self) -> None:
        self._refuse_busy()
        self.rig.occupy(_LINE_SCAN, _LINE_SCAN_S, self.now_s)

    def _sweep(self, *given: float) -> Wait:
        for number, value in enumerate(given, 1):
            _number(f"number {number} of a sweep", value, 0.0, 1e9)
        self._refuse_busy()
        self.rig.occupy("sweep of the drive frequency", _SWEEP_S, self.now_s)
        return Wait(lambda: self.rig.busy(self.now_s))

    def _approach(self, mode: str = "q+s") -> Wait:
        if mode not in ("q", "quick", "q+s", "quickAndsafe", "inc", "incremental", "incz", "incrementalzscanner"):
            raise InvalidValue(f"there is no approach {mode!r}")
        self.engage()
        self._z_um = self.stage_um[2] = 0.0  # the height of contact
        return Wait(lambda: self.engages or self.rig.doing(self.now_s) == "approach")

    def _retract(self) -> Wait:
        self.withdraw(self.now_s)
        return Wait(lambda: self.rig.busy(self.now_s))

    def _move_scanner(self, z_um: float, speed_um_s: float = _SCANNER_UM_S) -> Wait:
        _number("z of the scanner", z_um, _EXTENDED_UM, _RETRACTED_UM)
        _number("the speed of the scanner", speed_um_s, 1e-6, 1e4)
        return self._move_along_z(z_um, self.stage_um[2], abs(z_um - self._z_um), speed_um_s)

    def _move_z_stage(self, z_um: float, speed: float = 1.0) -> Wait:
        _number("z of the stage", z_um, -_STAGE_TOP_UM, _STAGE_TOP_UM)
        _number("the normalized speed", speed, 1e-6, 1.0)
        return self._move_along_z(self._z_um, z_um, abs(z_um - self.stage_um[2]), speed * _STAGE_UM_S)

    def _move_along_z(self, scanner_um: float, stage_um: float, way_um: float, speed_um_s: float) -> Wait:
        # Below the height at which the tip touches, the move drives it into the sample.
        self._refuse_busy()
        self.rig.occupy("move along z", way_um / speed_um_s, self.now_s)
        self._z_um, self.stage_um[2] = scanner_um, stage_um
        height_um = scanner_um + stage_um
        self.rig.account(self.now_s)
        self.rig.engaged = height_um <= 0.0
        if height_um < -_TOUCHES_UM:
            self.rig.stop("move along z", self.now_s)
            self.rig.crash(-height_um * MICROMETRE, speed_um_s * MICROMETRE, self.now_s)
        return Wait(lambda: self.rig.busy(self.now_s))

    def _move_xy_stage(self, x_um: float, y_um: float, x_speed: float = 1.0, y_speed: float = 1.0) -> Wait:
        # The stage moves the sample: afterwards the tip is over another place.
        for name, value in (("x", x_um), ("y", y_um)):
            _number(f"{name} of the stage", value, -_STAGE_TOP_UM, _STAGE_TOP_UM)
        for value in (x_speed, y_speed):
            _number("the normalized speed", value, 1e-6, 1.0)
        self._refuse_busy()
        by_um = (x_um - self.stage_um[0], y_um - self.stage_um[1])
        lasts_s = max(abs(by_um[0]) / x_speed, abs(by_um[1]) / y_speed) / _STAGE_UM_S
        self.rig.shift_sample((by_um[0] * MICROMETRE, by_um[1] * MICROMETRE), lasts_s, self.now_s)
        self.stage_um[:2] = [x_um, y_um]
        return Wait(lambda: self.rig.busy(self.now_s))

    def _move_focus(self, z_um: float, speed: float = 1.0) -> None:
        _number("z of the focus stage", z_um, -_STAGE_TOP_UM, _STAGE_TOP_UM)
        _number("the normalized speed", speed, 1e-6, 1.0)
        self._focus_um = z_um

    def _move(self, x_um: float, y_um: float) -> Wait:
        for name, value in (("x", x_um), ("y", y_um)):
            self._number(name, value, -50.0, 50.0)
        self.rig.move_probe((x_um * MICROMETRE, y_um * MICROMETRE), self.now_s)
        return Wait(lambda: self.rig.doing(self.now_s) == "move")

    def _sleep(self, lasts_ms: float) -> Wait:
        _number("milliseconds to sleep", lasts_ms, 0.0, 1e9)
        until_s = self.now_s + lasts_ms * 1e-3
        self._wakings_s.append(until_s)
        return Wait(lambda: self.now_s < until_s)

    # -- channels

    def _add_channel(self, wanted: str | Plain) -> None:
        self._recorded[self._channel(wanted)] = None

    def _remove_channel(self, wanted: str | Plain) -> None:
        name = self._channel(wanted)
        if name not in self._recorded:
            raise InvalidValue(f"channel {name!r} is not recorded")
        del self._recorded[name]

    def _channel(self, wanted: str | Plain) -> str:
        given = str(wanted.get("name") if isinstance(wanted, dict) else wanted)
        plain = re.sub(r"[\W_]", "", given.casefold()).removeprefix("channel")
        known = {re.sub(r"\W", "", name.casefold()): name for name in self.rig.channels if not name.endswith(RETRACE)}
        name = known.get(plain) or _OTHER_NAMES.get(plain, "")
        if name not in known.values():
            raise InvalidValue(f"there is no channel {given!r}", hint=f"there are {', '.join(known.values())}")
        return name

    def _read_channel(self, wanted: str) -> Plain:
        return self._shown(self._channel(wanted), 1)

    def _average_channel(self, wanted: str, count: int, interval_ms: float) -> Wait:
        name = self._channel(wanted)
        _number("the count", count, 1, _MOST_READ, whole=True)
        _number("the interval", interval_ms, 0.0, 1e6)
        slept = self._sleep(count * interval_ms)
        return Wait(slept.waiting, lambda: self._shown(name, count))

    def _shown(self, name: str, count: int) -> Plain:
        value = sum(self.rig.signals(self.now_s)[name] for _ in range(count)) / count
        unit, factor = _SHOWN.get(self.rig.channels[name], (self.rig.channels[name], 1.0))
        return {"value": value * factor, "unit": unit, "rawValue": value}

    # -- what the base asks

    @property
    def scanning(self) -> bool:
        return super().scanning or self.rig.doing(self.now_s) == _LINE_SCAN

    def stop_scan(self, now_s: float) -> None:
        super().stop_scan(now_s)
        self.rig.stop(_LINE_SCAN, self.now_s)

    def stop_engaging(self) -> None:
        super().stop_engaging()
        if not self.rig.engaged:
            self._z_um = _RETRACTED_UM

    def withdraw(self, now_s: float) -> None:
        super().withdraw(now_s)
        self._z_um = _RETRACTED_UM

    def prepare_scan(self) -> None:
        found, setup = self.geometry, self.rig.setup
        center = (found["offsetX"] * MICROMETRE, found["offsetY"] * MICROMETRE)
        size = (found["width"] * MICROMETRE, found["height"] * MICROMETRE)
        setup.region = Region(center, size, math.radians(found["rotation"]))
        setup.shape = (int(found["pixelHeight"]), int(found["pixelWidth"]))
        setup.line_s = 1.0 / self._values[_RATE]

    def prepare_curve(self) -> None: ...

    def scan_files(self, scan: ScanActivity, shown_s: float) -> Sequence[NamedFile]:
        name = self._next_name()
        made = files.images(scan, shown_s, "NCM", self._recorded)
        return [(f"{name}_{_plain(channel)}.tiff", content) for channel, content in made]

    def curve_files(self, curve: SpectrumActivity, shown_s: float) -> Sequence[NamedFile]:
        return [(f"{self._next_name()}_{curve.kind}.tiff", files.curve(curve, shown_s, "NCM"))]

    def _next_name(self) -> str:
        location = self._values["dataLocation"]
        folder = f"{_plain(location['subDir'])}/" if location["subDir"] else ""
        while True:
            self._saved += 1
            name = f"{folder}{_plain(location['fileName'])}_{self._saved:04d}"
            if not list(self.folder.glob(f"{name}_*")):
                return name

    def _apply(self) -> None:
        setup = self.rig.setup
        gain = self._values[_GAIN]
        if not self._values[_ENABLE]:
            self.rig.switch_feedback(self.now_s, on=False)
        setup.feedback = replace(
            setup.feedback,
            setpoint=self._values[_SETPOINT],
            on=self._values[_ENABLE],
            proportional_gain=_PROPORTIONAL * gain["p"],
            integral_gain=_INTEGRAL * gain["i"],
        )
        setup.bias_v = self._values[_BIAS]


def _plain(name: object) -> str:
    # A file never leaves its folder.
    return re.sub(r"[^A-Za-z0-9_-]", "_", str(name))[:100]


def _number(name: str, value: object, low: float, high: float, *, whole: bool = False) -> None:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not low <= value <= high
        or (whole and value != int(value))
    ):
        raise InvalidValue(f"{name}: {value!r} is not within {low:g} to {high:g}")
