"""The provenance of a measurement, searched in the journal among earlier publications.

The journal alone is searched, and nothing is kept in memory, so a restarted recorder finds the same provenance.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

from afspm import wire
from afspm.basics.errors import WireError
from afspm.basics.plain_data import Plain
from afspm.model import (
    ActByHand,
    ControlState,
    Feedback,
    MeasurementConditions,
    Parameter,
    ProblemNames,
    Scan,
    ScanHistory,
    ScopeState,
    ScopeStatus,
    Spectrum,
    TipStatus,
    names,
)
from afspm.model.caption import SettingInForce
from afspm.model.caption import in_force as in_force_of
from afspm.model.state import FeedbackUnits
from afspm.record.drift_mapping import drift_knowledge
from afspm.record.instrument_values import RecordedReadings, earliest_ns

_BACK = 20
"""The number of earlier packets of each kind that are searched for the start of a measurement."""
_IN_FILES = ("name", "value", "unit", "target", "age_s", "reason", "lowest", "highest")
"""The facts of an instrument's value that each file has."""


@dataclass(frozen=True)
class ControlAtStart:
    """Control and feedback at the start of a measurement; None if unknown.

    Attributes:
        asked_by: the component that asked for it, as its translator says; empty: not known.
    """

    began_ns: int | None
    control: ControlState | None
    feedback: Feedback | None
    asked_by: str = ""

    def facts(self, problems: ProblemNames) -> Plain:
        """Return the facts in JSON's types, with readable names."""
        facts: dict[str, object] = {}
        if self.control is None and self.asked_by:
            facts["in_control"] = self.asked_by
        if self.control is not None:
            facts |= {
                "in_control": self.control.holder,
                "mode": self.control.mode.name.lower(),
                "problems": [problems.name(number) for number in self.control.problems],
            }
        if self.feedback is not None:
            facts["feedback"] = {
                "on": self.feedback.on,
                "proportional_gain": self.feedback.proportional_gain,
                "integral_gain": self.feedback.integral_gain,
                "setpoint": self.feedback.setpoint,
            }
        return facts


def control_at_start(journal: sqlite3.Connection, time_ns: int, result: Scan | Spectrum | None) -> ControlAtStart:
    """Return control and feedback at the start of a measurement, or at its publication if the start is unknown.

    Args:
        time_ns: the time of publication, or of the interruption.
        result: a channel of the scan, or the spectrum; None: of the scan that was interrupted.
    """
    history = _history(journal, time_ns if result else time_ns - 1)
    begun = history.of(result, time_ns) if result else history.running
    began_ns, asked_by = (None, "") if begun is None else (begun.began_ns, begun.asked_by)
    at_ns = time_ns if began_ns is None else began_ns
    control, feedback = _last(journal, "ControlState", at_ns), _last(journal, "ZCtrlParameters", at_ns)
    return ControlAtStart(
        began_ns,
        control if isinstance(control, ControlState) else None,
        feedback if isinstance(feedback, Feedback) else None,
        asked_by,
    )


def in_force(
    journal: sqlite3.Connection, time_ns: int, began_ns: int | None, filenames: Collection[str], measured_ns: int
) -> list[Plain]:
    """Return the settings in force at the begin and end of a measurement, as facts; see `SettingInForce`.

    A translator of another implementation publishes none: then the setpoint alone is known, at the begin.
    """
    conditions = _conditions(journal, time_ns, filenames, measured_ns)
    found = () if conditions is None else conditions.in_force
    if not found and began_ns is not None:
        found = setpoint_in_force(_last(journal, "ZCtrlParameters", began_ns), _last(journal, "ZCtrlUnits", began_ns))
    return [asdict(one) for one in found]


def setpoint_in_force(feedback: object, units: object) -> tuple[SettingInForce, ...]:
    """Return the setpoint of the published feedback, if its unit was published, too."""
    if not isinstance(feedback, Feedback) or feedback.setpoint is None:
        return ()
    unit = units.setpoint if isinstance(units, FeedbackUnits) else ""
    return in_force_of((Parameter(names.ZCTRL_SETPOINT, repr(feedback.setpoint), unit),), ())


def _conditions(
    journal: sqlite3.Connection, time_ns: int, filenames: Collection[str], measured_ns: int
) -> MeasurementConditions | None:
    for _, payload in _newest(journal, "MeasurementConditions", time_ns):
        one = _decoded("MeasurementConditions", payload)
        if not isinstance(one, MeasurementConditions):
            continue
        if one.time_ns == measured_ns or (one.filename and one.filename in filenames):
            return one
    return None


def drift(journal: sqlite3.Connection, time_ns: int, since_ns: int | None, filenames: Collection[str]) -> Plain | None:
    """Return the drift mapping published just before a scan; None if there was none, or it is about another file.

    Args:
        time_ns: the time of the scan's publication.
        since_ns: the start of the scan; earlier mappings belong to other scans. None: unknown.
        filenames: the controller's files of the scan's channels; a mapping for another file does not count.
    """
    row = journal.execute(
        "SELECT payload FROM packets WHERE message = 'DriftMapping' AND time_ns <= ? AND time_ns > ?"
        " ORDER BY time_ns DESC LIMIT 1",
        (time_ns, -1 if since_ns is None else since_ns),
    ).fetchone()
    mapping = None if row is None else _decoded("DriftMapping", row[0])
    if mapping is None or (mapping.filename and any(filenames) and mapping.filename not in filenames):
        return None
    outcome, sd_m = drift_knowledge(mapping)
    return {
        "time_ns": mapping.timestamp.ToNanoseconds(),
        "matrix": list(mapping.matrix),
        "rate_m_s": list(mapping.rate),
        "center_m": list(mapping.center),
        "matched": mapping.matched,
        "lost": mapping.lost,
        "correcting": mapping.correcting,
        "reason": mapping.reason,
        "registration": outcome.label,
        "sd_m": sd_m,
    }


def instruments(journal: sqlite3.Connection, time_ns: int, since_ns: int | None, speed: float) -> list[Plain]:
    """Return the last values of other instruments in the real minute before `time_ns`, and their ranges.

    Args:
        time_ns: the time of publication.
        since_ns: the start of the measurement, and of the ranges; None: unknown.
        speed: experiment seconds per real second.
    """
    first_ns = earliest_ns(time_ns, speed)
    first_ns = first_ns if since_ns is None else min(since_ns, first_ns)
    rows = journal.execute(
        "SELECT time_ns, payload FROM packets WHERE message = 'InstrumentReadings' AND time_ns > ? AND time_ns <= ?"
        " ORDER BY time_ns",
        (first_ns, time_ns),
    )
    readings = RecordedReadings(speed)
    for at_ns, payload in rows:
        readings.take(at_ns, payload)
    return [{name: getattr(one, name) for name in _IN_FILES} for one in readings.values(time_ns, since_ns)]


def tip(
    journal: sqlite3.Connection, time_ns: int, since_ns: int | None, filenames: Collection[str], measured_ns: int
) -> Plain:
    """Return the tip and its feedback at the begin and end of a measurement, and the acts at the microscope meanwhile.

    Args:
        time_ns: the time of publication.
        since_ns: the start of the measurement; None: unknown.
        filenames: the controller's files of the measurement.
        measured_ns: the end of the measurement.

    Returns:
        "begin", "end" and "by_hand", "settings" of the run for it at begin and end, "asked_by" and "unproved", each
        only if known.
    """
    found: Plain = {}
    if (one := _conditions(journal, time_ns, filenames, measured_ns)) is not None:
        ends = {"begin": one.begin, "end": one.end}
        found = {name: _tip_facts(status) for name, status in ends.items() if status not in (None, TipStatus())}
        values = {"begin": one.begin_values, "end": one.end_values}
        in_force = {name: {each.name: _text(each) for each in given} for name, given in values.items() if given}
        found |= {"settings": in_force} if in_force else {}
        found |= {"asked_by": one.holder} if one.holder else {}
        found |= {"unproved": list(one.unproved)} if one.unproved else {}
    if since_ns is not None:
        acts = journal.execute(
            "SELECT payload FROM packets WHERE message = 'ActByHand' AND time_ns BETWEEN ? AND ? ORDER BY time_ns",
            (since_ns, time_ns),
        )
        told = [str(one) for (payload,) in acts if isinstance(one := _decoded("ActByHand", payload), ActByHand)]
        found |= {"by_hand": told} if told else {}
    return found


def _text(one: Parameter) -> str:
    return " ".join(filter(None, (one.value, one.unit)))


def _tip_facts(status: TipStatus | None) -> Plain:
    facts = {} if status is None else {"engaged": status.engaged, "feedback_on": status.feedback_on}
    return {name: value for name, value in facts.items() if value is not None}


def is_corrected(journal: sqlite3.Connection) -> bool:
    """Return whether the newest `DriftMapping` says that drift is corrected; True without any."""
    mapping = _last(journal, "DriftMapping", 2**63 - 1)
    return mapping is None or corrects(mapping)


def corrects(mapping: Any) -> bool:
    """Return whether a `DriftMapping` says that drift is corrected; True for a message without this field."""
    return bool(mapping.correcting) or not mapping.HasField("correcting")


def last_state(journal: sqlite3.Connection) -> ScopeState:
    status = _last(journal, "ScopeStateMsg", 2**63 - 1)
    return status.state if isinstance(status, ScopeStatus) else ScopeState.UNDEFINED


def _history(journal: sqlite3.Connection, until_ns: int) -> ScanHistory:
    found: list[tuple[int, object]] = []
    for message in ("ScopeStateMsg", "MeasurementConditions"):
        found += [(at_ns, _decoded(message, payload)) for at_ns, payload in _newest(journal, message, until_ns)]
    for table, column, doing in (("scans", "scan", ScopeState.SCANNING), ("spectra", "spectrum", ScopeState.SPEC)):
        message = "Scan2d" if doing is ScopeState.SCANNING else "Spec1d"
        rows = journal.execute(
            f"SELECT packets.time_ns, {table}.time_ns, packets.channel FROM packets"
            f" JOIN {table} ON packets.{column} = {table}.number WHERE packets.message = ? AND packets.time_ns <= ?"
            f" ORDER BY packets.time_ns DESC LIMIT {_BACK}",
            (message, until_ns),
        )
        found += [(at_ns, (doing, at_ns, ended_ns, channel or "")) for at_ns, ended_ns, channel in rows]
    history = ScanHistory()
    for at_ns, thing in sorted(found, key=lambda one: one[0]):
        history = history.with_result(*thing) if isinstance(thing, tuple) else history.step(thing, at_ns)
    return history


def _newest(journal: sqlite3.Connection, message: str, until_ns: int) -> list[tuple[int, bytes]]:
    rows = journal.execute(
        f"SELECT time_ns, payload FROM packets WHERE message = ? AND time_ns <= ? ORDER BY time_ns DESC LIMIT {_BACK}",
        (message, until_ns),
    )
    return rows.fetchall()


def _last(journal: sqlite3.Connection, message: str, time_ns: int) -> Any:
    row = journal.execute(
        "SELECT payload FROM packets WHERE message = ? AND time_ns <= ? ORDER BY time_ns DESC LIMIT 1",
        (message, time_ns),
    ).fetchone()
    return None if row is None else _decoded(message, row[0])


def _decoded(message: str, payload: bytes) -> Any:
    try:
        return wire.decode(message, payload)
    except WireError:
        return None
