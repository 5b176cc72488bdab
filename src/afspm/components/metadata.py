"""`Metadata`: a table of all measurements, with facts that measurement files lack (control, problems)."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from afspm.basics.clock import iso_utc
from afspm.basics.errors import UnitError
from afspm.basics.units import convert, si_unit_or_none
from afspm.client.component import Component
from afspm.components.line_file import LineFile, csv_line
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    Feedback,
    JournalEntries,
    JournalEntry,
    Note,
    Scan,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.model.state import FeedbackUnits

COLUMNS = (
    "time", "measurement", "filename", "channel", "center_x", "center_y", "width", "height", "length_units",
    "angle_deg", "columns", "rows", "units", "in_control", "mode", "problems", "state",
    "note", "bias", "bias_units", "setpoint", "setpoint_units",
)  # fmt: skip
_BIASES_KEPT = 8
"""Number of kept values of the bias: the value at the start of a scan is needed at its end."""
_BUSY = {ScopeState.SCANNING: "scan", ScopeState.SPEC: "spectrum"}


class Metadata(Component):
    """The writer of `metadata.csv` in the run folder: a row for each channel of a scan, spectrum and note.

    Columns: end time (UTC); `scan`, `spectrum` or `note`; file; channel (or kind); place in metres; pixels; units; and,
    as they were when the measurement began, holder of control, mode, flagged problems and the microscope's state; for a
    note its author and text. A note on a scan has the time of that scan. Unknown values are empty, such as the
    holder of control when a scan began while this component was not running.

    The last columns are the bias and the setpoint of the feedback when the measurement began. The bias is not
    published: its column has the last requested value. It is empty before the first request and for a measurement
    begun at the controller. MANUAL mode, a lost controller or a restart of the scheduler empties it until the next
    request. `setpoint_units` is the unit that the translator publishes beside the setpoint, or of the last request for
    `zctrl-setpoint` with a unit; else empty.

    The file has one header, and each row exactly once, even if processes are killed.

    Args:
        file: name of the file in the run folder.
    """

    listens: ClassVar = (
        "Scan2d", "Spec1d", "ControlState", "ScopeStateMsg", "Note", "ZCtrlParameters", "ZCtrlUnits",
        "JournalEntries",
    )  # fmt: skip

    file_suffix: ClassVar[str] = ""

    def __init__(self, file: str = "metadata.csv") -> None:
        self.file = file
        self._control: ControlState | None = None
        self._feedback = Feedback()
        self._follows_journal = False
        self._saw_begin = False
        self._under_way: str | None = None

    def on_start(self) -> None:
        self._table = LineFile(Path(self.run_dir) / self.file, ",".join(COLUMNS))
        self._written = {_row_key(dict(zip(COLUMNS, row, strict=False))) for row in csv.reader(self._table.lines())}

    def on_control(self, control_state: ControlState) -> None:
        self._control = control_state

    def on_state(self, status: ScopeStatus) -> None:
        what = _BUSY.get(status.state)
        now_ns = self.packet.time_ns if self.packet else None
        goes_on, self._under_way = what == self._under_way, what
        if status.state is ScopeState.UNDEFINED and now_ns is not None:
            self._keep_bias(now_ns, None)  # a controller that starts again has its own value
        if what is None:
            self._saw_begin = self._saw_begin and status.state is not ScopeState.FREE
            return
        if goes_on:
            return  # a scan that goes on after a pause began before it
        if now_ns is not None and now_ns <= self.memory.get("began_ns", -1):
            return  # replayed after a restart: the first entry counts
        self._saw_begin = True
        self.memory["before_ns"] = self.memory.get("began_ns", -1)
        self.memory["began_ns"] = -1 if now_ns is None else now_ns
        self.memory["what"], self.memory["finished_ns"] = what, None
        self.memory["conditions"] = self._now(status)
        self.memory.save()

    def _now(self, status: ScopeStatus) -> dict[str, str]:
        found = {"state": status.state.name.lower()}
        if self._feedback.setpoint is not None:
            found["setpoint"] = _number(self._feedback.setpoint)
        if (control := self._control) is None:
            return found
        problems = " ".join(map(self.scope.problems.name, control.problems))
        return found | {
            "in_control": control.holder or "",
            "mode": control.mode.name.lower(),
            "problems": problems,
        }

    def on_feedback(self, feedback: Feedback) -> None:
        self._feedback = feedback

    def on_feedback_units(self, units: FeedbackUnits) -> None:
        if units.setpoint:
            self.memory["setpoint_units"] = units.setpoint

    def on_message(self, envelope: str, message: object) -> None:
        if isinstance(message, JournalEntries) and message.entries:
            known_ns = self.memory.get("journal_ns", -1)
            if not self._follows_journal and 0 <= known_ns < message.entries[0].time_ns:
                self._keep_bias(known_ns, None)  # entries since the last life of this component may be missing
            self._follows_journal = True
            for entry in message.entries:
                if entry.time_ns >= known_ns:  # older entries are replayed after a restart
                    self._follow(entry)

    def _follow(self, entry: JournalEntry) -> None:
        is_set = entry.request == ControlRequest.PARAM and bool(entry.value)
        if entry.mode is ControlMode.MANUAL or entry.event is ControlEvent.RESTARTED:
            self._keep_bias(entry.time_ns, None)  # changes at the panel, or just before a kill, are not in the journal
        elif entry.response not in (ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE):
            return
        elif entry.request == ControlRequest.ACTION and entry.subject in (names.START_SCAN, names.START_SPEC):
            self.memory["started_ns"] = entry.sent_ns
        elif is_set and entry.subject == names.TIP_BIAS_VOLTAGE:
            self._keep_bias(entry.time_ns, _in_volts(entry))
        elif is_set and entry.subject == names.ZCTRL_SETPOINT:
            self.memory["setpoint_units"] = si_unit_or_none(entry.unit) or self.memory.get("setpoint_units", "")
        else:
            return
        self.memory["journal_ns"] = entry.time_ns

    def _keep_bias(self, time_ns: int, volts: float | None) -> None:
        self.memory["bias"] = [*self.memory.get("bias", ()), [time_ns, volts]][-_BIASES_KEPT:]

    def _settings(self, conditions: Mapping[str, str]) -> dict[str, str]:
        settings = {"setpoint_units": self.memory.get("setpoint_units", "")} if "setpoint" in conditions else {}
        before_ns, began_ns = self.memory.get("before_ns", -1), self.memory.get("began_ns", -1)
        started_ns = self.memory.get("started_ns")
        # the journal comes later than the states: it is complete up to this measurement once it has the start of it
        if started_ns is not None and before_ns < started_ns <= began_ns:
            values = [volts for time_ns, volts in self.memory.get("bias", ()) if time_ns <= began_ns]
            if values and values[-1] is not None:
                settings |= {"bias": _number(values[-1]), "bias_units": "V"}
        return settings

    def on_scan(self, scan: Scan) -> None:
        if scan.values.size:
            rows, columns = scan.shape
            lengths = [_number(value) for value in (*scan.region.center_m, *scan.region.size_m)]
            place = dict(zip(("center_x", "center_y", "width", "height"), lengths, strict=True))
            angle = _number(math.degrees(scan.region.angle_rad))
            pixels = {"columns": str(columns), "rows": str(rows), "units": scan.unit}
            self._write("scan", scan, {"channel": scan.channel, **place, "angle_deg": angle, **pixels})

    def on_spectrum(self, spectrum: Spectrum) -> None:
        points, variables = spectrum.values.shape
        x, y = ("", "") if spectrum.position_m is None else map(_number, spectrum.position_m)
        of_values = {"columns": str(variables), "rows": str(points), "units": " ".join(spectrum.units)}
        self._write("spectrum", spectrum, {"channel": spectrum.kind, "center_x": x, "center_y": y, **of_values})

    def on_note(self, note: Note) -> None:
        self._append({"time": iso_utc(note.time_ns), "measurement": "note", "note": f"{note.who}: {note.text}"})

    def _write(self, what: str, measured: Scan | Spectrum, columns: dict[str, str]) -> None:
        self._under_way = None  # if the state stays SCANNING, the next scan begins now
        time_ns = measured.time_ns
        if time_ns is None and self.packet is not None:
            time_ns = self.packet.time_ns  # distinguishes rows
        row = {
            "time": iso_utc(time_ns),
            "measurement": what,
            "filename": measured.filename,
            "length_units": "m",
        } | columns
        if _row_key(row) not in self._written:
            self._append(row | self._conditions(what, measured.time_ns))

    def _append(self, row: dict[str, str]) -> None:
        if (identity := _row_key(row)) in self._written:
            return  # replayed after a restart
        self._table.append([csv_line(row.get(column, "") for column in COLUMNS)])
        self._written.add(identity)

    def _conditions(self, what: str, time_ns: int | None) -> dict[str, str]:
        if self.memory.get("what") != what:
            return {}
        finished_ns = self.memory["finished_ns"]
        if finished_ns is None and time_ns is not None:
            self.memory["finished_ns"] = time_ns
            self.memory.save()
        elif finished_ns != time_ns and not self._saw_begin:
            return {}  # a later measurement, which began while this component did not run
        conditions: dict[str, str] = self.memory["conditions"]
        return conditions | self._settings(conditions)


def _row_key(row: Mapping[str, str]) -> tuple[str, ...]:
    # no two rows share these cells; rows of older versions have no note
    return tuple(
        row.get(column, "").replace("\n", " ") for column in ("time", "measurement", "filename", "channel", "note")
    )


def _in_volts(entry: JournalEntry) -> float | None:
    # None: not known whether the request was carried out, or no voltage
    if entry.response != ControlResponse.SUCCESS:
        return None
    try:
        return convert(float(entry.value), entry.unit or "V", "V")
    except (ValueError, UnitError):
        return None


def _number(value: float) -> str:
    return f"{value:.9g}"
