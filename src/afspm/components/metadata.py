"""`Metadata`: a table of what was measured, with what the files of the microscope don't say: who was in control."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from afspm.client.component import Component
from afspm.clock import iso_utc
from afspm.components.line_file import LineFile, csv_line
from afspm.model import ControlState, Region, Scan, ScopeState, ScopeStatus, Spectrum

COLUMNS = (
    "time",
    "measurement",
    "filename",
    "channel",
    "center_x",
    "center_y",
    "width",
    "height",
    "length_units",
    "angle_deg",
    "columns",
    "rows",
    "units",
    "in_control",
    "mode",
    "problems",
    "state",
)
_BUSY = {ScopeState.SCANNING: "scan", ScopeState.SPEC: "spectrum"}


@dataclass(frozen=True)
class ControlProvenance:
    """The holder of control and the state when a measurement began; texts, empty where not known."""

    in_control: str = ""
    mode: str = ""
    problems: str = ""
    state: str = ""


class Metadata(Component):
    """Writes `metadata.csv` in the run folder: a row for each channel of each scan, and for each spectrum.

    Columns: the time it was finished (UTC), `scan` or `spectrum`, the file, the channel (or kind), its place in metres,
    pixels, units, and as it was when the measurement began: who was in control, the mode, the problems flagged and
    the microscope's state. What is not known is left empty: a scan that began while this component was not running.

    Whatever is killed, there is one header and no row is there twice or missing.

    Args:
        file: its name in the run folder.
    """

    listens: ClassVar = ("Scan2d", "Spec1d", "ControlState", "ScopeStateMsg")

    def __init__(self, file: str = "metadata.csv") -> None:
        self.file = file
        self._control: ControlState | None = None
        self._saw_begin = False
        self._under_way: str | None = None

    def on_start(self) -> None:
        self._table = LineFile(Path(self.run_dir) / self.file, ",".join(COLUMNS))
        self._written = {_identity(row) for row in csv.reader(self._table.lines())}

    def on_control(self, control_state: ControlState) -> None:
        self._control = control_state

    def on_state(self, status: ScopeStatus) -> None:
        what = _BUSY.get(status.state)
        now_ns = self.packet.time_ns if self.packet else None
        goes_on, self._under_way = what == self._under_way, what
        if what is None:
            self._saw_begin = self._saw_begin and status.state is not ScopeState.FREE
            return
        if goes_on:
            return  # it was paused, or goes on after that: it began before
        if now_ns is not None and now_ns <= self.memory.get("began_ns", -1):
            return  # replayed after a restart: what was noted then is what holds
        self._saw_begin = True
        self.memory["began_ns"] = -1 if now_ns is None else now_ns
        self.memory["what"], self.memory["finished_ns"] = what, None
        self.memory["circumstances"] = self._now(status)
        self.memory.save()

    def _now(self, status: ScopeStatus) -> list[str]:
        if self._control is None:
            return ["", "", "", status.state.name.lower()]
        problems = " ".join(self.scope.problems.name(number) for number in self._control.problems)
        return [self._control.holder or "", self._control.mode.name.lower(), problems, status.state.name.lower()]

    def on_scan(self, scan: Scan) -> None:
        if scan.values.size:
            timed = replace(scan, time_ns=self._time_ns(scan))
            self._write("scan", scan.time_ns, lambda at: scan_row(timed, at))

    def on_spectrum(self, spectrum: Spectrum) -> None:
        timed = replace(spectrum, time_ns=self._time_ns(spectrum))
        self._write("spectrum", spectrum.time_ns, lambda at: spectrum_row(timed, at))

    def _time_ns(self, measured: Scan | Spectrum) -> int | None:
        """Return when it was finished, or else when it was sent: rows are told apart by it."""
        if measured.time_ns is None and self.packet is not None:
            return self.packet.time_ns
        return measured.time_ns

    def _circumstances(self, what: str, time_ns: int | None) -> ControlProvenance:
        """Return those noted when it began, if it is the measurement that they were noted for."""
        if self.memory.get("what") != what:
            return ControlProvenance()
        finished_ns = self.memory["finished_ns"]
        if finished_ns is None and time_ns is not None:
            self.memory["finished_ns"] = time_ns
            self.memory.save()
        elif finished_ns != time_ns and not self._saw_begin:
            return ControlProvenance()  # a later one, that began while we were not running
        return ControlProvenance(*self.memory["circumstances"])

    def _write(self, what: str, time_ns: int | None, row_at: Callable[[ControlProvenance], list[str]]) -> None:
        self._under_way = None  # should it scan on without another state between them, that is the next one
        identity = _identity(row_at(ControlProvenance()))
        if identity in self._written:
            return  # replayed after a restart
        self._table.append([csv_line(row_at(self._circumstances(what, time_ns)))])
        self._written.add(identity)


def scan_row(scan: Scan, circumstances: ControlProvenance) -> list[str]:
    """One channel of a scan as a row."""
    rows, columns = scan.shape
    what = ["scan", scan.filename, scan.channel]
    return _row(scan.time_ns, what, _of_region(scan.region), [str(columns), str(rows), scan.unit], circumstances)


def spectrum_row(spectrum: Spectrum, circumstances: ControlProvenance) -> list[str]:
    """A spectrum as a row: its points are rows, its variables columns."""
    points, variables = spectrum.values.shape
    place = ["", ""] if spectrum.position_m is None else [_number(v) for v in spectrum.position_m]
    what = ["spectrum", spectrum.filename, spectrum.kind]
    of_values = [str(variables), str(points), " ".join(spectrum.units)]
    return _row(spectrum.time_ns, what, [*place, "", "", "m", ""], of_values, circumstances)


def _row(
    time_ns: int | None, what: list[str], place: list[str], of_values: list[str], at: ControlProvenance
) -> list[str]:
    return [iso_utc(time_ns), *what, *place, *of_values, at.in_control, at.mode, at.problems, at.state]


def _of_region(region: Region) -> list[str]:
    lengths = [_number(value) for value in (*region.center_m, *region.size_m)]
    return [*lengths, "m", _number(math.degrees(region.angle_rad))]


def _number(value: float) -> str:
    return f"{value:.9g}"


def _identity(row: list[str]) -> tuple[Any, ...]:
    """Return what no two rows share: time, measurement, file and channel."""
    return tuple(row[:4])
