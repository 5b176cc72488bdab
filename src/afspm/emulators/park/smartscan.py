"""SmartScan's own part: the values and methods below `spm`, and what it does with the instrument."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

from afspm.emulators.activities import ScanActivity, SpectrumActivity
from afspm.emulators.park import files
from afspm.emulators.park.engine import Wait
from afspm.emulators.program import MakerProgram, NamedFile
from afspm.errors import InvalidValue
from afspm.files.park_header import MICROMETRE
from afspm.model import Region
from afspm.plain_data import Plain

GEOMETRY: Final[dict[str, tuple[type, float, float]]] = {
    "pixelHeight": (int, 1, 8192),
    "pixelWidth": (int, 1, 8192),
    "width": (float, 1e-6, 100.0),
    "height": (float, 1e-6, 100.0),
    "offsetX": (float, -50.0, 50.0),
    "offsetY": (float, -50.0, 50.0),
    "rotation": (float, -360.0, 360.0),
}
"""The frame, in the order in which it is told: type and bounds, in micrometres and degrees."""
_CURVES: Final = {"fd": "force", "iv": "IV"}
_LOCATION: Final = {"subDir": "", "fileName": "SIMULATED", "fileSuffix": "", "direction": "auto", "jpegSave": False}
_RETRACTED_UM, _EXTENDED_UM = 7.5, -7.5
_SETPOINT, _ENABLE, _RATE, _BIAS = "zservo.setpoint.value", "zservo.enable", "scan.rate", "bias.tip"
_GAIN: Final = "zservo.gain"
_PROPORTIONAL, _INTEGRAL = 0.2, 3000.0
"""What SmartScan's gains of 1 are to the simulated feedback; the second in 1/s."""
_BOUNDS: Final = {_SETPOINT: (-10.0, 10.0), _RATE: (1e-4, 1e5), _BIAS: (-10.0, 10.0), "bias.sample": (-10.0, 10.0)}


class SmartScanProgram(MakerProgram):
    """The program, which scripts lead to.

    Attributes:
        geometry: the frame.
        tells_gains: whether the gains of the feedback can be read, or only set.
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
            "scan.options": {"twoWay": False, "overScan": {"enable": False, "percent": 5}},
            "dataLocation": {"baseDir": str(self.folder), **_LOCATION},
        }
        self._told: dict[str, Callable[[], object]] = {
            "zscanner.pos": lambda: 0.0 if self.rig.engaged else _RETRACTED_UM,
            "zscanner.fullyRetractedPos": lambda: _RETRACTED_UM,
            "zscanner.fullyExtendedPos": lambda: _EXTENDED_UM,
            "zstage.pos": lambda: self.stage_um[2],
            "xystage.pos": lambda: {"x": self.stage_um[0], "y": self.stage_um[1]},
            "approach.state": lambda: "approaching" if self.engages else "idle",
        }
        self._methods: dict[str, Callable[..., object]] = {
            "scan.setScanGeometry": self._set_geometry,
            "scan.triggerImageScan": lambda: self.start_scan(self.now_s),
            "scan.startImageScan": self._start_and_wait,
            "scan.stop": lambda: self.stop_scan(self.now_s),
            "scan.channels.names": lambda: list(self.rig.channels),
            "spect.start": self._measure_curve,
            "spect.trigger": self._start_curve,
            "spect.stop": self.stop_curve,
            "approach.start": self._approach,
            "approach.stop": self.stop_engaging,
            "zscanner.retractAll": self._retract,
            "zstage.move": self._lift,
            "xyscanner.moveTo": self._move,
            "readChannel": self._read_channel,
        }
        self.tells_gains = True
        self.stage_um = [0.0, 0.0, 0.0]
        self._saved = 0
        self._apply()

    @property
    def now_s(self) -> float:
        return self.rig.clock.now_s()

    @property
    def names(self) -> str:
        """What there is below `spm`, in JSON."""
        return json.dumps({"values": [*self._values, *self._told], "methods": list(self._methods)})

    def ask(self, kind: str, path: str, given: list[Any]) -> object:
        """Do what a script asks for. Raises AfspmError, TypeError."""
        if kind == "call":
            return self._methods[path](*given)
        if kind == "set":
            self._set(path, given[0])
            return None
        if path == _GAIN and not self.tells_gains:
            return None
        return self._told[path]() if path in self._told else self._values[path]

    # -- methods

    def _set(self, path: str, value: Any) -> None:
        if path not in self._values:
            raise InvalidValue(f"{path} can't be set")
        present = self._values[path]
        if path in _BOUNDS:
            low, high = _BOUNDS[path]
            _number(path, value, low, high)
        elif isinstance(present, dict):
            if not isinstance(value, dict):
                raise InvalidValue(f"{path}: {value!r} is no object")
            value = {**present, **value}
            for member, number in value.items() if path == _GAIN else ():
                _number(f"{path}.{member}", number, 0.0, 100.0)
        elif isinstance(value, bool) is not isinstance(present, bool):
            raise InvalidValue(f"{path}: {value!r}")
        self._values[path] = value
        self._apply()

    def _set_geometry(self, wanted: Plain) -> None:
        for name, (kind, low, high) in GEOMETRY.items():
            _number(name, wanted.get(name, self.geometry[name]), low, high, whole=kind is int)
        self.geometry |= {name: wanted[name] for name in GEOMETRY if name in wanted}

    def _start_and_wait(self) -> Wait:
        self.start_scan(self.now_s)
        return Wait(lambda: self.scanning)

    def _start_curve(self, mode: str | Plain = "fd", place: str = "given") -> None:
        told = mode if isinstance(mode, dict) else {"mode": mode, "type": place}
        if told.get("mode") not in _CURVES or told.get("type") != "here":
            raise InvalidValue(f"no points are given for {mode!r}, or there is no such spectroscopy")
        self.start_curve(_CURVES[told["mode"]], self.now_s)

    def _measure_curve(self, *given: Any) -> Wait:
        self._start_curve(*given)
        return Wait(lambda: self.measuring_curve)

    def _approach(self, mode: str = "q+s") -> Wait:
        if mode not in ("q", "quick", "q+s", "quickAndsafe", "inc", "incremental", "incz", "incrementalzscanner"):
            raise InvalidValue(f"there is no approach {mode!r}")
        self.engage()
        return Wait(lambda: self.engages or self.rig.doing(self.now_s) == "approach")

    def _retract(self) -> Wait:
        self.withdraw(self.now_s)
        return Wait(lambda: self.rig.busy(self.now_s))

    def _lift(self, distance_um: float, speed: float = 1.0) -> Wait:
        _number("distance", distance_um, -1e4, 1e4)
        self.stage_um[2] += distance_um
        if distance_um > 0.0 and self.rig.engaged:
            self.withdraw(self.now_s)
        return Wait(lambda: self.rig.busy(self.now_s))

    def _move(self, x_um: float, y_um: float) -> Wait:
        for name, value in (("x", x_um), ("y", y_um)):
            _number(name, value, -50.0, 50.0)
        self.rig.move_probe((x_um * MICROMETRE, y_um * MICROMETRE))
        return Wait(lambda: self.rig.doing(self.now_s) == "move")

    def _read_channel(self, name: str) -> Plain:
        signals = self.rig.signals(self.now_s)
        if name not in signals:
            raise InvalidValue(f"there is no channel {name!r}")
        return {"value": signals[name], "unit": self.rig.channels[name]}

    # -- what the base asks

    def prepare_scan(self) -> None:
        found, setup = self.geometry, self.rig.setup
        center = (found["offsetX"] * MICROMETRE, found["offsetY"] * MICROMETRE)
        size = (found["width"] * MICROMETRE, found["height"] * MICROMETRE)
        setup.region = Region(center, size, math.radians(found["rotation"]))
        setup.shape = (int(found["pixelHeight"]), int(found["pixelWidth"]))
        setup.line_s = 1.0 / self._values[_RATE]

    def prepare_curve(self) -> None: ...

    def scan_files(self, scan: ScanActivity, now_s: float) -> Sequence[NamedFile]:
        name = self._next_name()
        return [(f"{name}_{_plain(channel)}.tiff", content) for channel, content in files.images(scan, now_s, "NCM")]

    def curve_files(self, curve: SpectrumActivity, now_s: float) -> Sequence[NamedFile]:
        return [(f"{self._next_name()}_{curve.kind}.tiff", files.curve(curve, now_s, "NCM"))]

    def _next_name(self) -> str:
        """Return the beginning of the next files' names, which no file has."""
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
        setup.feedback = replace(
            setup.feedback,
            setpoint=self._values[_SETPOINT],
            on=self._values[_ENABLE],
            proportional_gain=_PROPORTIONAL * gain["p"],
            integral_gain=_INTEGRAL * gain["i"],
        )
        setup.bias_v = self._values[_BIAS]


def _plain(name: object) -> str:
    """Return a part of a file's name: a file never leaves its folder."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", str(name))[:100]


def _number(name: str, value: Any, low: float, high: float, *, whole: bool = False) -> None:
    """Raises InvalidValue."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not low <= value <= high or (whole and value != int(value)):
        raise InvalidValue(f"{name}: {value!r} is not within {low:g} to {high:g}")
