"""Driver of Nion's scanning transmission microscope, by its instrument software. See the README of this package.

**Theory of operation.** Nion's software runs in the translator's own process (`microscope`), without a window. A scan
is started with all its parameters, and its channels come at its end. The microscope has neither tip nor feedback.

    inputs        channels of an ended scan, from Nion's thread
    state         frame and speed, in `memory`; the running scan
    outputs       recordings; a file for each scan in the run's folder, since Nion's software saves none by itself
    invariants    pixels are square; a stopped scan has no file
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import afspm
from afspm.basics import ConfigError, Refused, Speed
from afspm.components import write_atomic
from afspm.driver import FRAME, Driver, FileFacts, SettingsGroup, Value, action, encode_scan, frame, frame_values
from afspm.model import ControlResponse, Region, Scan, ScopeState, ScopeStatus, Spectrum, names

if TYPE_CHECKING:
    from afspm_nion.microscope import SimulatedMicroscope

_AT_FIRST = {**frame_values(Region((0.0, 0.0), (400e-9, 400e-9)), (128, 128)), names.SCAN_SPEED: 4e-6}
_DETECTORS = ("HAADF", "MAADF")


class Nion(Driver):
    """Nion's simulated scanning transmission microscope.

    Args:
        detectors: the channels of a scan.
        drift: velocity (x, y) with which the stage, and with it the sample, moves.
        settings: common to all drivers.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*FRAME, names.SCAN_SPEED, names.CONTROLLER)
    channel_roles: ClassVar = {"intensity": ("HAADF",), "other": ("MAADF", "X1", "X2")}
    maker: ClassVar[str] = "Nion"
    software: ClassVar[str] = "Nion Swift instrumentation"
    simulated: ClassVar[bool] = True
    has_tip: ClassVar[bool] = False
    memory_is_all: ClassVar[bool] = True
    program_s: ClassVar[float] = 2.0
    never_shows: ClassVar = {
        "another one begun": "Nion's software runs without a panel",
        "start in the file": "afspm writes the file",
        "end in the file": "afspm writes the file",
        "frame in the file": "afspm writes the file, with the frame that was set",
        "missing rows": "a stopped scan hands over nothing",
        "stop of a scan": "Nion's software runs without a panel",
        "stop of a spectrum": "it takes no spectra",
    }

    def __init__(
        self,
        *,
        detectors: Sequence[str] = _DETECTORS,
        drift: tuple[Speed, Speed] = (0.0, 0.0),
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        known = self.channels.all_names()
        wrong = [one for one in detectors if one not in known]
        if wrong or not detectors:
            raise ConfigError(
                f"there is no detector {wrong[0]!r}" if wrong else "a scan needs a detector",
                where="detectors",
                hint=f"some of {', '.join(known)}",
            )
        self._detectors, self._drift_m_s = tuple(detectors), drift
        self._microscope: SimulatedMicroscope | None = None
        self._ends_s: float | None = None
        self.groups = (FrameOfScan(self),)

    @classmethod
    def excused(cls, controller: str) -> Mapping[str, str]:
        return dict.fromkeys(("frame/shape-only", "scan/not-square"), "Nion's pixels are square")

    # --- the microscope ---

    def connect(self) -> None:
        """Start the microscope, unless it runs already."""
        if self._microscope is None:
            # imported here: Nion's software takes seconds, and `afspm check` needs the class alone
            from afspm_nion.microscope import SimulatedMicroscope

            folder = self.run_dir / "nion"
            folder.mkdir(exist_ok=True)
            self._microscope = SimulatedMicroscope(folder)
        self.memory.setdefault("values", dict(_AT_FIRST))
        self.memory.setdefault("results", [])
        self.memory.setdefault("start_s", self.clock.now_s())

    def close(self) -> None:
        """Stop the microscope."""
        if self._microscope is not None:
            self._microscope.close()
            self._microscope = None

    def status(self) -> ScopeStatus:
        """Return SCANNING until the scan's file is written."""
        if self._nion.is_recording:
            return ScopeStatus(ScopeState.SCANNING)
        if self._ends_s is None:
            return ScopeStatus(ScopeState.FREE)
        self._ends_s = None
        counts = self._nion.take()
        if counts is None:
            self.log.error("Nion's software ended the scan without data")
            return ScopeStatus(ScopeState.INTERRUPTED)
        self._save(counts)
        return ScopeStatus(ScopeState.FREE)

    def next_change_s(self) -> float | None:
        return self._ends_s

    def get(self, vendor: str) -> Value:
        if vendor == names.CONTROLLER:
            return self._nion.name
        raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"Nion's microscope has no parameter {vendor!r}")

    def set(self, values: Mapping[str, Value]) -> None:
        raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"Nion's microscope can't set {', '.join(values)}")

    def results(self) -> Sequence[str]:
        return list(self.memory["results"])

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return afspm.read(result).scans

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once."""
        values = self.memory["values"]
        region, (rows, columns) = frame(values)
        dwell_s = region.size_m[0] / (columns - 1) / values[names.SCAN_SPEED]
        lasts_s = rows * columns * dwell_s
        now_s = self.clock.now_s()
        # A simulated scan shows the sample of one moment.
        self._put_stage(now_s, now_s + lasts_s / 2.0, region)
        self._nion.record(region, (rows, columns), self.clock.real_s(dwell_s), self._detectors, self.wake)
        self._ends_s = now_s + lasts_s

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        """Abort the scan, which has no result."""
        self._ends_s = None
        self._nion.stop()

    # --- inside ---

    @property
    def _nion(self) -> SimulatedMicroscope:
        assert self._microscope is not None, "the translator connects first"
        return self._microscope

    def _put_stage(self, start_s: float, at_s: float, region: Region) -> None:
        since_s = at_s - self.memory["start_s"]
        x, y = (speed_m_s * since_s for speed_m_s in self._drift_m_s)
        self._nion.move_stage((x, y))
        with (self.run_dir / "stage.csv").open("a", encoding="utf-8") as file:
            file.write(",".join(map(repr, (at_s, x, y, start_s, *region.center_m, *region.size_m))) + "\n")

    def _save(self, counts: Mapping[str, Any]) -> None:
        time_ns = self.clock.now_ns()
        region, _ = frame(self.memory["values"])
        folder = self.run_dir / "scans"
        folder.mkdir(exist_ok=True)
        path = (folder / f"scan-{len(self.memory['results']) + 1:04}.nc").resolve()
        # Nion's counts grow with the dwell time in real time, which the speed of the clock divides.
        factor = self.clock.real_s(1.0)
        channels = {name: ("", values / factor) for name, values in counts.items()}
        write_atomic(path, [encode_scan(region, channels, FileFacts(time_ns, {"microscope": self._nion.name}))])
        self.memory["results"].append(str(path))


class FrameOfScan(SettingsGroup):
    """Frame and speed, which Nion's software takes with each scan."""

    names = (*FRAME, names.SCAN_SPEED)

    def __init__(self, driver: Nion) -> None:
        self._driver = driver

    def read(self) -> dict[str, Value]:
        return dict(self._driver.memory["values"])

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = self.merged(values)
        region, (rows, columns) = frame(wanted)
        width, height = region.size_m
        pitch_m = width / (columns - 1)
        if abs(pitch_m * (rows - 1) - height) > 1e-6 * height:
            raise Refused(
                ControlResponse.PARAM_ERROR,
                f"pixels must be square: {columns} x {rows} pixels of a frame {width * 1e9:.6g} nm wide are "
                f"{pitch_m * (rows - 1) * 1e9:.6g} nm high, not {height * 1e9:.6g} nm",
            )
        self._driver.memory["values"] = wanted
