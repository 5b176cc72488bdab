"""The simulated controller with its hardware: what it is doing, from when to when, and what comes of it.

Everything is a function of experiment time. What is going on is written down as "this, with these values, from then
to then": whoever reads it later, a restarted process too, finds it still running or finished, as with a controller
that has a life of its own.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from afspm.errors import AfspmError, FileError, Refused
from afspm.microscopes.simulator.faults import Faults
from afspm.microscopes.simulator.scan_drawing import ScanDrawing, in_si, line_s
from afspm.microscopes.simulator.truth import Truth
from afspm.model import ControlResponse, ScanLines, ScopeState, Spectrum, names
from afspm.simulation import SimulatedScan, World
from afspm.storage.atomic import write_atomic
from afspm.translator.own_files import FileFacts, encode_scan, encode_spectrum
from afspm.translator.parameters import ParameterTable, Value
from afspm.translator.setting_groups import feedback, frame
from afspm.translator.state import Kept

LISTED_RESULTS = 16
ADJUSTED: Final = (names.ZCTRL_SETPOINT, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN, names.TIP_BIAS_VOLTAGE)
"""What holds from the next line on, when it is set during a scan."""

_STATES: Final = {
    "scan": ScopeState.SCANNING,
    "spectrum": ScopeState.SPEC,
    "move": ScopeState.MOVING,
    "crash": ScopeState.MOVING,
    "pulse": ScopeState.BUSY_PARAM,
    "approach": ScopeState.COARSE_MOTOR,
}
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class PanelEvent:
    """An action of a person at the controller's own panel, without a request to the translator.

    Attributes:
        at_s: experiment seconds after the start.
        set: values as in the experiment file.
        action: one of the instrument's own actions.
    """

    at_s: float
    set: dict[str, object] | None = None
    action: str = ""


class Instrument:
    """The simulated hardware.

    Args:
        kept: everything that lasts, JSON-able. It is brought up to date by every call.
        folder: for the files that it saves.
        panel: what a person does at it, in any order.
        approach_s: how long engaging and retracting take.
        wake: called, from any thread, when `state` has something new to say earlier than `next_change_s`.
    """

    def __init__(
        self,
        world: World,
        table: ParameterTable,
        kept: Kept,
        folder: Path,
        *,
        faults: Faults,
        truth: Truth,
        log: logging.Logger,
        panel: list[PanelEvent],
        approach_s: float,
        wake: Callable[[], None],
    ) -> None:
        self._world = world
        self._table = table
        self._kept = kept
        self._files = SavedFiles(folder, kept, faults)
        self._truth = truth
        self._log = log
        self._panel = sorted(panel, key=lambda event: event.at_s)
        self._approach_s = approach_s
        self._drawing = ScanDrawing(world, table, wake)
        if "world" in kept:
            world.restore(kept["world"])
        if kept["doing"] is not None and kept["doing"]["what"] == "scan":
            self._drawing.begin(kept["doing"])
        self._actions: dict[str, Callable[[float], None]] = {
            names.START_SCAN: self.start_scan,
            names.STOP_SCAN: self.stop,
            names.START_SPEC: self.start_spectrum,
            names.STOP_SPEC: self.stop,
            names.PULSE: self.pulse,
            names.CRASH: self.crash,
            names.RETRACT: self.retract,
            names.ENGAGE: self.engage,
        }

    # --- what is going on ---

    def state(self, now_s: float) -> ScopeState:
        """Return the state of the instrument, after everything has happened that was to happen until now."""
        self._advance(now_s)
        doing = self._kept["doing"]
        return ScopeState.FREE if doing is None else _STATES[doing["what"]]

    def next_change_s(self) -> float | None:
        """When the next thing happens by itself; None if nothing will, or `wake` will tell."""
        times = [self._panel_s(), self._files.whole_s()]
        if self._kept["doing"] is not None and not self._drawing.is_going_on:
            times.append(self._kept["doing"]["end_s"])
        return min((at_s for at_s in times if at_s is not None), default=None)

    def results(self) -> list[str]:
        """Return the files of the last scans and spectra, oldest first."""
        return list(self._kept["results"])

    def lines(self, start: int, now_s: float) -> list[ScanLines]:
        """The lines of the running scan beyond the first `start`, as far as they are complete."""
        doing = self._kept["doing"]
        if doing is None or self._drawing.is_going_on or (scan := self._drawing.wait()) is None:
            return []
        course = scan.course
        rows = np.sort(course.order[start : int(course.rows_taken(now_s).sum())])
        if not rows.size:
            return []
        return [
            ScanLines(course.region, course.shape, channel, unit, int(rows[0]), values[rows])
            for channel, (unit, values) in scan.channels().items()
        ]

    def _advance(self, now_s: float) -> None:
        while (at_s := self.next_change_s()) is not None and at_s <= now_s:
            if at_s == self._files.whole_s():
                self._files.complete()
            elif at_s == self._panel_s():
                self._someone_at_the_panel(at_s)
            else:
                self._end(at_s)

    def _begin(self, what: str, now_s: float, lasts_s: float) -> None:
        values = dict(self._kept["values"])
        self._kept["doing"] = {"what": what, "start_s": now_s, "end_s": now_s + lasts_s, "values": values}

    def _end(self, end_s: float) -> None:
        doing, self._kept["doing"] = self._kept["doing"], None
        try:
            if doing["what"] == "scan" and (scan := self._drawing.wait()) is not None:
                self._save_scan(scan, doing)
            elif doing["what"] == "spectrum":
                self._save_spectrum(doing)
        except AfspmError as error:
            # as with a controller that fails: it is free again, and there is no file
            self._log.error("the simulated %s failed: %s; it has no file", doing["what"], error)
        if doing["what"] in ("scan", "spectrum"):
            self._settle()

    def _settle(self) -> None:
        """Nothing works on the world any more, and its state is kept."""
        self._drawing.end()
        self._kept["world"] = self._world.state()

    # --- what it can be told to do ---

    def set(self, values: dict[str, Value], now_s: float) -> None:
        """Change values, by their generic names, in the table's units; a new frame or position is moved to."""
        before = self._si(self._kept["values"])
        self._kept["values"].update(values)
        after = self._si(self._kept["values"])
        rate_m_s = (float(after[names.DRIFT_RATE_X]), float(after[names.DRIFT_RATE_Y]))
        if rate_m_s != (float(before[names.DRIFT_RATE_X]), float(before[names.DRIFT_RATE_Y])):
            self._world.compensate(rate_m_s, now_s)
            self._settle()
        if any(before.get(name) != after.get(name) for name in ADJUSTED):  # a driver may lack some
            self._adjust(values, now_s)
        speed_m_s = float(after[names.MOVE_SPEED])
        distance_m = max(
            _distance(before, after, names.PROBE_POS_X, names.PROBE_POS_Y),
            _distance(before, after, names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y),
        )
        if distance_m > 0.0:
            self.stop(now_s)  # as far as that is allowed, it ends what is being measured
            self._begin("move", now_s, distance_m / speed_m_s)

    def _adjust(self, values: dict[str, Value], now_s: float) -> None:
        """Draw the rest of a running scan with new values; as before a restart, from the world before the scan."""
        doing = self._kept["doing"]
        if doing is None or doing["what"] != "scan":
            return
        self._drawing.end()
        doing["adjusted"] = [*doing.get("adjusted", ()), {"t_s": now_s, "values": values}]
        self._world.restore(self._kept["world"])
        self._drawing.begin(doing)

    def start_scan(self, now_s: float) -> None:
        """Scan the frame: every line there and back at the scan speed."""
        self._prepare()
        values = self._si(self._kept["values"])
        region, (rows, _) = frame(values)
        self._kept["scans"] += 1
        self._begin("scan", now_s, rows * line_s(values, region.size_m[0]))
        self._note(now_s, "scan starts", {"number": self._kept["scans"]})
        self._drawing.begin(self._kept["doing"])

    def start_spectrum(self, now_s: float) -> None:
        """Take a curve of the kind that is set, where the probe is."""
        self._prepare()
        self._kept["spectra"] += 1
        kind = str(self._kept["values"][names.SPEC_KIND])
        self._begin("spectrum", now_s, self._world.spectrum_s(kind))
        self._note(now_s, "spectrum starts", {"number": self._kept["spectra"], "kind": kind})

    def stop(self, now_s: float) -> None:
        """Break off what is being measured. What would have come of it is lost."""
        doing = self._kept["doing"]
        if doing is not None and doing["what"] in ("scan", "spectrum"):
            self._kept["doing"] = None
            if not self._drawing.is_going_on:
                self._settle()
            self._note(now_s, f"{doing['what']} stopped", {})

    def pulse(self, now_s: float) -> None:
        """A bias pulse where the probe is."""
        self._prepare()
        values = self._si(self._kept["values"])
        position_m = (float(values[names.PROBE_POS_X]), float(values[names.PROBE_POS_Y]))
        voltage_v, duration_s = float(values[names.PULSE_VOLTAGE]), float(values[names.PULSE_DURATION])
        outcome = self._world.pulse(voltage_v, duration_s, now_s, position_m)
        facts = {"voltage_v": voltage_v, "duration_s": duration_s, "position_m": position_m, "outcome": outcome}
        self._treated("pulse", now_s, duration_s, facts)

    def crash(self, now_s: float) -> None:
        """Drive the tip into the sample where the probe is, and out again."""
        self._prepare()
        values = self._si(self._kept["values"])
        position_m = (float(values[names.PROBE_POS_X]), float(values[names.PROBE_POS_Y]))
        speed_m_s, depth_m = float(values[names.CRASH_SPEED]), float(values[names.CRASH_DEPTH])
        outcome = self._world.crash(position_m, depth_m, speed_m_s, now_s)
        facts = {"position_m": position_m, "speed_m_per_s": speed_m_s, "depth_m": depth_m, "outcome": outcome}
        self._treated("crash", now_s, 2.0 * depth_m / speed_m_s, facts)

    def retract(self, now_s: float) -> None:
        """Take the tip away from the sample, whatever is going on."""
        self.stop(now_s)
        self._kept["values"][names.ENGAGED] = False
        self._begin("approach", now_s, self._approach_s)

    def engage(self, now_s: float) -> None:
        """Bring the tip to the sample."""
        self.stop(now_s)
        self._kept["values"][names.ENGAGED] = True
        self._begin("approach", now_s, self._approach_s)

    def _treated(self, what: str, now_s: float, lasts_s: float, facts: Kept) -> None:
        self._settle()
        self._begin(what, now_s, lasts_s)
        self._note(now_s, what, facts)

    def _prepare(self) -> None:
        """Raises Refused if the tip can't be used now; waits for what is left of a scan that was stopped."""
        if self._kept["doing"] is not None:
            raise Refused(ControlResponse.NOT_FREE, f"the instrument is busy: {self._kept['doing']['what']}")
        if not self._kept["values"][names.ENGAGED]:
            raise Refused(ControlResponse.ACTION_ERROR, f"the tip is retracted: {names.ENGAGE} it first")
        self._settle()

    # --- what comes of it ---

    def _save_scan(self, scan: SimulatedScan, doing: Kept) -> None:
        content = encode_scan(scan.course.region, scan.channels(), self._facts(doing))
        name = f"scan-{self._kept['scans']:04d}.nc"
        self._files.save(name, content, doing["end_s"])
        self._note(doing["end_s"], "scan", {"file": name, "scan": dict(scan.truth)})

    def _save_spectrum(self, doing: Kept) -> None:
        values = self._si(doing["values"])
        position_m = (float(values[names.PROBE_POS_X]), float(values[names.PROBE_POS_Y]))
        kind = str(values[names.SPEC_KIND])
        bias_v = float(values[names.TIP_BIAS_VOLTAGE])
        variables, units, curve = self._world.spectrum(kind, position_m, doing["start_s"], feedback(values), bias_v)
        spectrum = Spectrum(position_m, kind, tuple(variables), tuple(units), curve)
        name = f"spectrum-{self._kept['spectra']:04d}-{kind}.nc"
        self._files.save(name, encode_spectrum(spectrum, self._facts(doing)), doing["end_s"])
        self._note(doing["end_s"], "spectrum", {"file": name, "position_m": position_m, "kind": kind})

    def _facts(self, doing: Kept) -> FileFacts:
        rows, facts = self._table, dict[str, str | float]()
        for name, value in self._si(doing["values"]).items():
            key = f"{name} [{rows[name].si_unit}]" if rows[name].si_unit else name
            facts[key] = value if isinstance(value, str) else float(value)
        return FileFacts(int(doing["end_s"] * NS_PER_S), facts)

    # --- the panel, and the truth ---

    def _panel_s(self) -> float | None:
        left = self._panel[self._kept["panel"] :]
        return self._kept["start_s"] + left[0].at_s if left else None

    def _someone_at_the_panel(self, at_s: float) -> None:
        event = self._panel[self._kept["panel"]]
        self._kept["panel"] += 1
        if event.set:
            values = self._table.written(event.set, where="panel")
            self.set({name: self._table[name].to_vendor(value) for name, value in values.items()}, at_s)
        if event.action:
            try:
                self._actions[event.action](at_s)
            except Refused as refused:
                self._log.warning("a scripted action at the panel was refused: %s", refused)

    def _note(self, time_s: float, event: str, facts: Kept) -> None:
        if not self._drawing.is_going_on:
            facts = {**facts, "truth": self._world.truth(time_s)}
        self._truth.note(time_s, event, facts)

    def _si(self, values: dict[str, Value]) -> dict[str, Value]:
        return in_si(values, self._table)


def _distance(before: dict[str, Value], after: dict[str, Value], *axes: str) -> float:
    return math.hypot(*(float(after[axis]) - float(before[axis]) for axis in axes))


class SavedFiles:
    """The files that the simulated controller saves, some of them half at first."""

    def __init__(self, folder: Path, kept: Kept, faults: Faults) -> None:
        self._folder = folder
        self._kept = kept
        self._faults = faults

    def save(self, name: str, content: bytes, end_s: float) -> None:
        """Save a file that was finished at an experiment time."""
        path = self._folder / name
        whole_after_s = self._faults.strikes("half-file")
        if whole_after_s is None:
            write_atomic(path, [content])
        else:
            write_atomic(_hidden(path), [content])
            path.write_bytes(content[: len(content) // 2])
            self._kept["half"] = [str(path), end_s + whole_after_s]
        self._kept["results"] = [*self._kept["results"], str(path)][-LISTED_RESULTS:]

    def whole_s(self) -> float | None:
        """Return when a file that is half becomes whole; None: none is."""
        half = self._kept.get("half")
        return None if half is None else float(half[1])

    def complete(self) -> None:
        """Make the file whole that is half."""
        path = Path(self._kept.pop("half")[0])
        try:
            _hidden(path).replace(path)
        except OSError as error:
            raise FileError(f"can't be completed: {error}", where=str(path)) from error


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.whole")
