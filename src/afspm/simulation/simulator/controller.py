"""The simulated controller: present settings, a panel, and files of the simulated instrument's measurements.

Every activity is saved with its settings and its start time. So a restarted process finds a measurement running or
finished, as with a real controller.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics.errors import AfspmError, FileError, InvalidValue, Refused
from afspm.driver import encode_spectrum
from afspm.model import ControlResponse, ScanLines, ScopeState, Spectrum, names
from afspm.simulation.activities import Channels, ScanActivity, SpectrumActivity
from afspm.simulation.faults import Faults
from afspm.simulation.instrument import InstrumentBusy, SimulatedInstrument
from afspm.simulation.spectra import SweptCurve
from afspm.simulation.world import WorldSettings
from afspm.storage.atomic import write_atomic
from afspm.translator.own_files import FileFacts, encode_scan
from afspm.translator.parameters import FEEDBACK_ON, ParameterTable, Value
from afspm.translator.setting_groups import feedback, frame
from afspm.translator.state import Kept

LISTED_RESULTS = 16
ADJUSTED: Final = (names.ZCTRL_SETPOINT, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN, names.TIP_BIAS_VOLTAGE)
"""Parameters that take effect from the next line on when set during a scan."""

_OF_KIND: Final = (*names.SPEC_Z_ENDS, names.SPEC_POINTS, names.SPEC_POINT_TIME)
"""Settings that each kind of curve has for itself."""
_SIGNALS: Final = {names.CURRENT: "Current", names.FREQUENCY_SHIFT: "Frequency Shift"}
MEASURED: Final = (names.TIP_Z, *_SIGNALS)
"""Parameters that are measured at each reading."""
_STATES: Final = {
    "": ScopeState.FREE,
    "scan": ScopeState.SCANNING,
    "spectrum": ScopeState.SPEC,
    "move": ScopeState.MOVING,
    "crash": ScopeState.MOVING,
    "pulse": ScopeState.BUSY_PARAM,
    "approach": ScopeState.COARSE_MOTOR,
    "stage": ScopeState.COARSE_MOTOR,
}
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class PanelEvent:
    """An action of a person at the controller's own panel, without a request to the translator.

    Attributes:
        at_s: experiment seconds after the start.
        set: values as in the experiment file.
        action: a generic action of the simulated microscope, e.g. "retract"; empty: none.
    """

    at_s: float
    set: dict[str, object] | None = None
    action: str = ""


class SimulatedController:
    """The controller of the simulated instrument.

    Args:
        kept: the saved state, JSON-able; every change of the instrument updates it.
        folder: folder for saved files.
        panel: actions of a person, in any order.
    """

    def __init__(
        self,
        instrument: SimulatedInstrument,
        table: ParameterTable,
        kept: Kept,
        folder: Path,
        *,
        faults: Faults,
        log: logging.Logger,
        panel: list[PanelEvent],
    ) -> None:
        self.instrument = instrument
        self._table = table
        self._kept = kept
        self._faults = faults
        self._files = SavedFiles(folder, kept, faults)
        self._log = log
        self._panel = sorted(panel, key=lambda event: event.at_s)
        kept["values"] = {**self._curves_at_first(kept["values"].get(names.SPEC_KIND, "IV")), **kept["values"]}
        self._put_in_force()
        instrument.engaged = bool(kept["values"][names.ENGAGED])
        if "instrument" in kept:
            instrument.restore(kept["instrument"])
        else:
            self._keep()
        # a power cut may take the state back to before files that are on the disk: they are never overwritten
        instrument.count_on(scans=self._files.last("scan"), spectra=self._files.last("spectrum"))
        self._actions: dict[str, Callable[[float], None]] = {
            names.START_SCAN: self.start_scan,
            names.STOP_SCAN: self.stop,
            names.START_SPEC: self.start_spectrum,
            names.STOP_SPEC: self.stop,
            names.PULSE: self.pulse,
            names.CRASH: self.crash,
            names.RETRACT: self.retract,
            names.ENGAGE: self.engage,
            names.APPROACH: self.approach,
        }

    # --- the running activity ---

    def state(self, now_s: float) -> ScopeState:
        """Return the state of the instrument, after all events up to now."""
        self._advance(now_s)
        if self.instrument.doing(now_s) == "scan":
            if self._faults.strikes("stopped", now_s):
                self.stop(now_s)
            elif self._faults.strikes("withdrawn", now_s):
                self.retract(now_s)
        return _STATES[self.instrument.doing(now_s)]

    def next_event_s(self) -> float | None:
        """Return the time of the next event, without the end of a scan that is being computed; None without events."""
        times = (self._panel_s(), self._files.whole_s(), self.instrument.ends_s)
        return min((at_s for at_s in times if at_s is not None), default=None)

    def results(self) -> list[str]:
        """Return the files of the last `LISTED_RESULTS` scans and spectra, oldest first."""
        return list(self._kept["results"])

    def lines(self, start: int, now_s: float) -> list[ScanLines]:
        """Return the complete lines of the running scan, without the first `start` lines."""
        scan = self.instrument.scan
        if scan is None or scan.drawing or self.instrument.doing(now_s) != "scan":
            return []
        rows = np.sort(scan.course.order[start : scan.lines_done(now_s)])
        if not rows.size:
            return []
        return [
            ScanLines(scan.region, scan.shape, channel, unit, int(rows[0]), values[rows])
            for channel, (unit, values) in _in_single_precision(scan).items()
        ]

    def _advance(self, now_s: float) -> None:
        while (at_s := self.next_event_s()) is not None and at_s <= now_s:
            if at_s == self._files.whole_s():
                self._files.complete()
            elif at_s == self._panel_s():
                self._someone_at_the_panel(at_s)
            else:
                self._end(at_s)

    def _end(self, end_s: float) -> None:
        ended = self.instrument.ended(end_s)
        try:
            if isinstance(ended, ScanActivity) and ended.stopped_s is None:
                self._save_scan(ended)
            elif isinstance(ended, SpectrumActivity):
                self._save_spectrum(ended)
        except AfspmError as error:
            # like a controller that fails: free again, without a file
            self._log.error("the simulated measurement failed: %s; it has no file", error)
        self._keep()

    def is_engaged(self, now_s: float) -> bool:
        """Return whether the tip is at the sample."""
        self.instrument.doing(now_s)  # an approach may have ended
        return self.instrument.engaged

    def _keep(self) -> None:
        self._kept["values"][names.ENGAGED] = self.instrument.engaged
        self._kept["instrument"] = self.instrument.state()

    # --- values ---

    def set(self, values: dict[str, Value], now_s: float) -> None:
        """Change values, by their generic names, in the table's units; move to a new frame or position.

        A move ends the running measurement.
        """
        self.instrument.account(now_s)  # with the feedback as it was
        before = self._si()
        if names.SPEC_KIND in values:
            self._choose_kind(str(values[names.SPEC_KIND]))
        self._kept["values"].update(values)
        after = self._si()
        # before the rest, so that setpoint and bias are remembered with which the feedback has held z
        if after.get(FEEDBACK_ON) is False:
            self.instrument.switch_feedback(now_s, on=False)
        self._put_in_force()
        self.instrument.note_changes(now_s)
        rate_m_s = (float(after[names.DRIFT_RATE_X]), float(after[names.DRIFT_RATE_Y]))
        if rate_m_s != (float(before[names.DRIFT_RATE_X]), float(before[names.DRIFT_RATE_Y])):
            self.instrument.follow(rate_m_s, now_s)
        is_on_again = after.get(FEEDBACK_ON) is True and before.get(FEEDBACK_ON) is False
        is_adjusted = any(before.get(name) != after.get(name) for name in ADJUSTED)  # a table may lack some
        if is_adjusted:
            self.instrument.adjust(now_s)
        if is_adjusted or is_on_again:
            self.instrument.press(now_s)
        way_m = _distance(before, after, names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y)
        if way_m > 0.0 or _distance(before, after, names.PROBE_POS_X, names.PROBE_POS_Y) > 0.0:
            self.stop(now_s)  # a change allowed at this moment ends the measurement
            place_m = (float(after[names.PROBE_POS_X]), float(after[names.PROBE_POS_Y]))
            with _refusing():
                frame_m = self.instrument.setup.region.center_m if way_m > 0.0 else None
                self.instrument.move_probe(place_m, now_s, way_m=way_m, frame_m=frame_m)
        self._keep()

    def move_z(self, z_m: float, now_s: float) -> None:
        """Set z, as long as the feedback is off.

        Raises:
            Refused: the feedback is on.
        """
        if self.instrument.setup.feedback.on is not False:
            raise Refused(ControlResponse.ACTION_ERROR, "the z feedback is on")
        with _refusing():
            self.instrument.hold(z_m, now_s)
        self._keep()

    def measured(self, name: str, now_s: float) -> float:
        """Return z, the current or the frequency shift as measured now."""
        if name == names.TIP_Z:
            return self.instrument.z_m(now_s)
        return self.instrument.signals(now_s)[_SIGNALS[name]]

    def _curves_at_first(self, kind: str) -> dict[str, Value]:
        found = _first_settings(kind, self.instrument.world.settings)
        return {name: self._table[name].to_vendor(value) for name, value in found.items() if name in self._table}

    def _choose_kind(self, kind: str) -> None:
        values, of_kinds = self._kept["values"], self._kept.setdefault("curves", {})
        of_kinds[values[names.SPEC_KIND]] = {name: values[name] for name in _OF_KIND if name in values}
        of_kind = of_kinds.get(kind) or self._curves_at_first(kind)
        values.update({name: value for name, value in of_kind.items() if name in _OF_KIND})

    def _put_in_force(self) -> None:
        values, setup = self._si(), self.instrument.setup
        setup.region, setup.shape = frame(values)
        setup.line_s = 2.0 * setup.region.size_m[0] / float(values[names.SCAN_SPEED])
        setup.upwards = values[names.SCAN_DIRECTION] == names.UP
        setup.feedback = feedback(values)
        setup.bias_v = float(values[names.TIP_BIAS_VOLTAGE])
        setup.slope = (float(values[names.SAMPLE_SLOPE_X]), float(values[names.SAMPLE_SLOPE_Y]))
        setup.move_speed_m_s = float(values[names.MOVE_SPEED])

    def _si(self, values: Kept | None = None) -> dict[str, Value]:
        found: dict[str, Value] = self._kept["values"] if values is None else values
        return {name: self._table[name].from_vendor(value) for name, value in found.items() if name in self._table}

    # --- actions ---

    def start_scan(self, now_s: float) -> None:
        """Start a scan of the frame, trace and retrace at the scan speed."""
        self._prepare(now_s)
        if not self._faults.strikes("scan-refused", now_s):
            with _refusing():
                self.instrument.start_scan(now_s)
            self._measures()

    def start_spectrum(self, now_s: float) -> None:
        """Start a curve of the selected kind at the probe's position."""
        self._prepare(now_s)
        if not self._faults.strikes("spectrum-refused", now_s):
            with _refusing():
                kind = str(self._kept["values"][names.SPEC_KIND])
                self.instrument.start_spectrum(kind, now_s, curve=_swept(kind, self._si()))
            self._measures()

    def stop(self, now_s: float) -> None:
        """Interrupt the running measurement, which then has no result."""
        self.instrument.stop_scan(now_s)
        self.instrument.stop_spectrum(now_s)
        self._keep()

    def pulse(self, now_s: float) -> None:
        """Pulse the bias at the probe's position."""
        self._prepare(now_s)
        values = self._si()
        with _refusing():
            self.instrument.pulse(float(values[names.PULSE_VOLTAGE]), float(values[names.PULSE_DURATION]), now_s)
        self._keep()

    def crash(self, now_s: float) -> None:
        """Drive the tip into the sample and back at the probe's position."""
        self._prepare(now_s)
        values = self._si()
        with _refusing():
            self.instrument.crash(float(values[names.CRASH_DEPTH]), float(values[names.CRASH_SPEED]), now_s)
        self._keep()

    def retract(self, now_s: float) -> None:
        """Stop the activity and withdraw the tip."""
        self.instrument.withdraw(now_s)
        self._keep()

    def engage(self, now_s: float) -> None:
        """Stop the measurement and bring the tip to the sample by its piezo."""
        self.stop(now_s)
        with _refusing():
            self.instrument.engage(now_s)
        self._keep()

    def approach(self, now_s: float) -> None:
        """Bring the tip to the sample with the coarse motor."""
        false = self._faults.strikes("false-landing", now_s)
        with _refusing():
            self.instrument.approach(now_s, seems_s=None if false is None else false.duration_s)
        self._keep()

    def step(self, direction: tuple[int, int, int], steps: int, step_m: float, now_s: float) -> None:
        """Let the coarse motor go steps; see `SimulatedInstrument.step`."""
        with _refusing():
            self.instrument.step(direction, steps, step_m, now_s)
        self._keep()

    def _prepare(self, now_s: float) -> None:
        # an ended measurement is saved before another takes its place
        self._advance(now_s)
        doing = self.instrument.doing(now_s)
        if doing:
            raise Refused(ControlResponse.NOT_FREE, f"the instrument is busy: {doing}")
        if not self.instrument.engaged:
            raise Refused(ControlResponse.ACTION_ERROR, f"the tip is retracted: {names.ENGAGE} it first")

    def _measures(self) -> None:
        self._kept["taken"] = dict(self._kept["values"])
        self._keep()

    # --- what comes of it ---

    def _save_scan(self, scan: ScanActivity) -> None:
        content = encode_scan(scan.region, _in_single_precision(scan), self._facts(scan.end_s))
        self._saved("scan", f"scan-{scan.number:04d}.nc", content, scan.end_s, {"scan": dict(scan.truth)})

    def _save_spectrum(self, curve: SpectrumActivity) -> None:
        spectrum = Spectrum(curve.position_m, curve.kind, curve.names, curve.units, curve.values)
        content = encode_spectrum(spectrum, self._facts(curve.end_s))
        name = f"spectrum-{curve.number:04d}-{curve.kind}.nc"
        self._saved("spectrum", name, content, curve.end_s, {"position_m": curve.position_m, "kind": curve.kind})

    def _saved(self, event: str, name: str, content: bytes, end_s: float, facts: Kept) -> None:
        self._files.save(name, content, end_s)
        self.instrument.note(end_s, event, {"file": name, **facts})

    def _facts(self, end_s: float) -> FileFacts:
        rows, facts = self._table, dict[str, str | float]()
        for name, value in self._si(self._kept["taken"]).items():
            key = f"{name} [{rows[name].si_unit}]" if rows[name].si_unit else name
            facts[key] = value if isinstance(value, str) else float(value)
        return FileFacts(int(end_s * NS_PER_S), facts)

    # --- the panel ---

    def _panel_s(self) -> float | None:
        left = self._panel[self._kept["panel"] :]
        return self._kept["start_s"] + left[0].at_s if left else None

    def _someone_at_the_panel(self, at_s: float) -> None:
        event = self._panel[self._kept["panel"]]
        self._kept["panel"] += 1
        try:
            if event.set:
                values = self._table.written(event.set, where="panel")
                self.set({name: self._table[name].to_vendor(value) for name, value in values.items()}, at_s)
            if event.action:
                self._actions[event.action](at_s)
        except Refused as refused:
            self._log.warning("a scripted action at the panel was refused: %s", refused)


@contextmanager
def _refusing() -> Iterator[None]:
    try:
        yield
    except InstrumentBusy as busy:
        raise Refused(ControlResponse.NOT_FREE, str(busy)) from busy
    except InvalidValue as invalid:
        raise Refused(ControlResponse.ACTION_ERROR, str(invalid)) from invalid


def _distance(before: dict[str, Value], after: dict[str, Value], *axes: str) -> float:
    return math.hypot(*(float(after[axis]) - float(before[axis]) for axis in axes))


class SavedFiles:
    """The files of the simulated controller; faults delay some files or leave them incomplete at first."""

    def __init__(self, folder: Path, kept: Kept, faults: Faults) -> None:
        self._folder = folder
        self._kept = kept
        self._faults = faults

    def last(self, kind: str) -> int:
        """Return the highest number of a saved "scan" or "spectrum" file; 0 without one."""
        names = (path.stem.split("-") for path in self._folder.glob(f"{kind}-*.nc"))
        return max((int(words[1]) for words in names if words[1].isdecimal()), default=0)

    def save(self, name: str, content: bytes, end_s: float) -> None:
        """Save the file of a measurement that ended at `end_s`; a fault may omit, delay or halve the file."""
        path, faults = self._folder / name, self._faults
        if faults.strikes("no-file", end_s):
            return
        half = faults.strikes("half-file", end_s)
        late = half or faults.strikes("late-file", end_s)
        if late is None:
            write_atomic(path, [content])
        else:
            write_atomic(_hidden(path), [content])
            self._kept["late"] = [*self._kept.get("late", []), [end_s + late.duration_s, str(path)]]
        if half is not None:
            path.write_bytes(content[: len(content) // 2])
        self._kept["results"] = [*self._kept["results"], str(path)][-LISTED_RESULTS:]

    def whole_s(self) -> float | None:
        """Return the time at which the next late or incomplete file becomes complete, or None."""
        return min((float(at_s) for at_s, _ in self._kept.get("late", [])), default=None)

    def complete(self) -> None:
        """Put the next late or incomplete file, whole, in its place.

        Raises:
            FileError: the file can't be moved.
        """
        (_, name), *later = sorted(self._kept["late"])
        self._kept["late"], path = later, Path(name)
        try:
            _hidden(path).replace(path)
        except OSError as error:
            raise FileError(f"can't be completed: {error}", where=str(path)) from error


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.whole")


def _in_single_precision(scan: ScanActivity) -> Channels:
    # as most controllers deliver their values
    return {
        name: (unit, values.astype(np.float32).astype(np.float64)) for name, (unit, values) in scan.channels().items()
    }


def _first_settings(kind: str, world: WorldSettings) -> dict[str, float]:
    # before they are changed, by generic names, in SI
    iv, force, z = world.iv, world.force, world.z
    of_kind = world.of_curves(kind)
    nearest_m, farthest_m = (z.nearest_m, z.farthest_m) if kind == "z" else (-force.range_m, force.range_m)
    return {
        names.SPEC_FROM: -iv.range_v,
        names.SPEC_TO: iv.range_v,
        names.SPEC_Z_FROM: nearest_m,
        names.SPEC_Z_TO: farthest_m,
        names.SPEC_POINTS: of_kind.points,
        names.SPEC_POINT_TIME: of_kind.duration_s / (2.0 * of_kind.points),
        names.SPEC_Z_OFFSET: 0.0,
        names.LOCK_IN_AMPLITUDE: iv.modulation_v,
    }


def _swept(kind: str, values: Mapping[str, Value]) -> SweptCurve:
    # settings by generic names, in SI; a table of parameters may lack some
    def number(name: str) -> float | None:
        return float(values[name]) if name in values else None

    first, last = map(number, names.SPEC_ENDS if kind == "IV" else names.SPEC_Z_ENDS)
    points = number(names.SPEC_POINTS)
    return SweptCurve(
        None if first is None or last is None else (first, last),
        None if points is None else int(points),
        number(names.SPEC_POINT_TIME),
        number(names.SPEC_Z_OFFSET) or 0.0,
        number(names.LOCK_IN_AMPLITUDE),
    )
