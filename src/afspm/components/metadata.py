"""`Metadata`: a table of all measurements, with facts that measurement files lack (control, problems)."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from afspm.basics.clock import iso_utc
from afspm.basics.errors import UnitError
from afspm.basics.plain_data import Plain
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
    ScanHistory,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.model.scan_history import BegunMeasurement
from afspm.model.state import FeedbackUnits

COLUMNS = (
    "time", "measurement", "filename", "channel", "center_x", "center_y", "width", "height", "length_units",
    "angle_deg", "columns", "rows", "units", "in_control", "mode", "problems", "state",
    "note", "bias", "bias_units", "setpoint", "setpoint_units",
)  # fmt: skip
_BIASES_KEPT = 8
"""Number of kept values of the bias: the value at the start of a scan is needed at its end."""


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
        "Scan2d", "Spec1d", "ControlState", "ScopeStateMsg", "MeasurementConditions", "Note", "ZCtrlParameters",
        "ZCtrlUnits", "JournalEntries",
    )  # fmt: skip

    file_suffix: ClassVar[str] = ""

    def __init__(self, file: str = "metadata.csv") -> None:
        self.file = file
        self._history = ScanHistory()
        self._follows_journal = False

    def on_start(self) -> None:
        self._history = self._recalled()
        self._table = LineFile(Path(self.run_dir) / self.file, ",".join(COLUMNS))
        self._written = {_row_key(dict(zip(COLUMNS, row, strict=False))) for row in csv.reader(self._table.lines())}

    def on_control(self, control_state: ControlState) -> None:
        self._history = self._history.step(control_state, self._packet_ns)

    def on_state(self, status: ScopeStatus) -> None:
        if status.state is ScopeState.UNDEFINED:
            self._keep_bias(self._packet_ns, None)  # a controller that starts again has its own value
        self._follow_scans(status)

    def _follow_scans(self, thing: object) -> None:
        # kept by number: what a measurement began with is needed at its end, perhaps by a later life of this component
        before, self._history = self._history, self._history.step(thing, self._packet_ns)
        if (self._history.begun, self._history.is_running) == (before.begun, before.is_running):
            return
        kept = {one["number"]: one for one in self.memory.get("begun", ())}
        if self._history.count > before.count:
            newest = self._history.begun[-1]
            kept[newest.number] = {"number": newest.number, "conditions": self._at_start(newest)} | {
                "doing": newest.doing.name, "began_ns": newest.began_ns, "before_ns": self.memory.get("newest_ns", -1)
            }  # fmt: skip
            self.memory["newest_ns"] = newest.began_ns
        self.memory["begun"] = [
            kept[one.number] | {"ended_ns": one.ended_ns, "channels": one.channels, "is_presumed": one.is_presumed}
            for one in self._history.begun
        ]
        self.memory["is_running"] = self._history.is_running
        self.memory["state_ns"] = self._history.state_ns
        self.memory.save()

    def _recalled(self) -> ScanHistory:
        begun = tuple(
            BegunMeasurement(
                ScopeState[one["doing"]], one["number"], one["began_ns"],
                ended_ns=one["ended_ns"], channels=tuple(one["channels"]), is_presumed=one["is_presumed"],
            )
            for one in self.memory.get("begun", ())
        )  # fmt: skip
        count = max((one.number for one in begun), default=0)
        is_running = bool(begun) and self.memory.get("is_running", False)
        state_ns = self.memory.get("state_ns", -1)
        return ScanHistory(begun=begun, is_running=is_running, count=count, is_observed=bool(begun), state_ns=state_ns)

    @property
    def _packet_ns(self) -> int:
        time_ns = self.packet.time_ns if self.packet else None
        return self.clock.now_ns() if time_ns is None else time_ns

    def _at_start(self, begun: BegunMeasurement) -> dict[str, str]:
        found = {"state": begun.doing.name.lower()}
        if begun.feedback is not None and begun.feedback.setpoint is not None:
            found["setpoint"] = _number(begun.feedback.setpoint)
        if (control := begun.control) is None:
            return found
        problems = " ".join(map(self.scope.problems.name, control.problems))
        return found | {
            "in_control": control.holder or "",
            "mode": control.mode.name.lower(),
            "problems": problems,
        }

    def on_feedback(self, feedback: Feedback) -> None:
        self._history = self._history.step(feedback, self._packet_ns)

    def on_feedback_units(self, units: FeedbackUnits) -> None:
        if units.setpoint:
            self.memory["setpoint_units"] = units.setpoint

    def on_message(self, envelope: str, message: object) -> None:
        self._history = self._history.step(message, self._packet_ns)
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

    def _settings(self, kept: Plain) -> dict[str, str]:
        units = self.memory.get("setpoint_units", "")
        settings = {"setpoint_units": units} if "setpoint" in kept["conditions"] else {}
        before_ns, began_ns = kept["before_ns"] or -1, kept["began_ns"]
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
            self._follow_scans(scan)

    def on_spectrum(self, spectrum: Spectrum) -> None:
        points, variables = spectrum.values.shape
        x, y = ("", "") if spectrum.position_m is None else map(_number, spectrum.position_m)
        of_values = {"columns": str(variables), "rows": str(points), "units": " ".join(spectrum.units)}
        self._write("spectrum", spectrum, {"channel": spectrum.kind, "center_x": x, "center_y": y, **of_values})
        self._follow_scans(spectrum)

    def on_note(self, note: Note) -> None:
        self._append({"time": iso_utc(note.time_ns), "measurement": "note", "note": f"{note.who}: {note.text}"})

    def _write(self, what: str, measured: Scan | Spectrum, columns: dict[str, str]) -> None:
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
            self._append(row | self._conditions(measured))

    def _append(self, row: dict[str, str]) -> None:
        if (identity := _row_key(row)) in self._written:
            return  # replayed after a restart
        self._table.append([csv_line(row.get(column, "") for column in COLUMNS)])
        self._written.add(identity)

    def _conditions(self, measured: Scan | Spectrum) -> dict[str, str]:
        begun = self._history.of(measured, self._packet_ns)
        kept = next((one for one in self.memory.get("begun", ()) if one["number"] == begun.number), None)
        if kept is None or kept["began_ns"] is None:  # it began while this component did not run
            return {"in_control": begun.asked_by} if begun.asked_by else {}
        conditions: dict[str, str] = kept["conditions"]
        return conditions | self._settings(kept)


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
