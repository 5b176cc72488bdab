"""`open_run`: the record of a run as tables and arrays, read on demand."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from afspm import wire
from afspm.basics import NoSuchItem
from afspm.basics.argument_checks import PATH, checked
from afspm.basics.entry_points import DISPLAYS, required
from afspm.basics.errors import FileError, InvalidValue, WireError
from afspm.basics.formatting import counted
from afspm.basics.plain_data import from_json
from afspm.basics.toml import parse_toml
from afspm.model import (
    ControlState,
    Feedback,
    Frame,
    JournalEntries,
    JournalEntry,
    LogLine,
    Note,
    Packet,
    ProbePosition,
    Problem,
    ProblemNames,
    ProcessCondition,
    ScanSet,
    Spectrum,
)
from afspm.night.bad_scans import LINE_VERDICT_MESSAGE, VERDICT_MESSAGE, bad_scans, read_verdict
from afspm.night.measured_tables import (
    KeyedTable,
    R,
    Row,
    SpectrumTable,
    read_scans,
    read_spectra,
    scan_row,
    spectrum_row,
)
from afspm.night.packets import PacketLookup, packets, without_reading_files
from afspm.night.tables import ControlRow, NoteRow, ProblemRow, ProcessRow, ScanRow, SpectrumRow, Table
from afspm.night.treatment_ledger import KEEP_AWAY_M, TreatmentLedger, treatment_ledger, treatment_times
from afspm.record import REPLAY_OF, journal, latest_run
from afspm.record.instrument_values import RecordedReadings
from afspm.record.journal import SCHEDULER
from afspm.record.run_json import EXPERIMENT_FILE, METADATA, STATE_DIR, run_json_or_empty
from afspm.record.run_lock import is_locked, unrecorded_message
from afspm.storage.packet_log import log_folder
from afspm.wire import described_types
from afspm.wire.message_types import register_all
from afspm.wire.messages import SpatialROIWithScoreList, TipVerdict, WatchCounts

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from afspm.night.overview import DriftPoint, Overview
    from afspm.record import AllowedBands
    from afspm.report.film import Film
    from afspm.storage.formats.content import FileContent

_SAME_SCAN_NS = 1_000_000_000
_log = logging.getLogger("afspm.night")


@checked({"path": PATH})
def open_run(path: str | Path = "runs", *, messages: Sequence[str] = ()) -> Run:
    """Open the record of a run, also of a running or killed one.

    A warning is logged if the packet log of a stopped run has results that are not recorded.

        run = afspm.open_run("runs/tip_repair-20261120-040000")
        run.scan(-1)["height"].to_xarray()
        run.scans.to_xarray()
        [entry.reason for entry in run.refusals]

    Args:
        path: the folder of the run, or of all runs: then the newest run. For a replay, the replayed run is opened.
        messages: modules and .proto files with message types of your own, as in the experiment file.

    Raises:
        FileError: the record is missing or damaged.
        ConfigError: `messages` can't be imported.
    """
    register_all(messages)
    run = Run(_folder(Path(path)))
    if not is_locked(run.folder) and (lacking := unrecorded_message(run.folder, log_folder(run.folder / STATE_DIR))):
        _log.warning("%s: %s", run.folder, lacking)
    return run


class Run:
    """The record of a run.

    Every access except `experiment` reads the files again, so a running experiment shows its newest data.

    Only `experiment` is read once, since the experiment file of a run does not change.

    Attributes:
        folder: the folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._journal = journal.open_to_read(folder)
        self._readings = RecordedReadings(float((self.facts.get("clock") or {}).get("speed", 1.0)))

    # --- measurements ---

    @property
    def scans(self) -> KeyedTable[ScanRow]:
        """One row for each scan, also if interrupted, in the order of recording."""
        return read_scans(self._query, self.verdicts(), self._readings, self._bands)

    @property
    def spectra(self) -> SpectrumTable:
        """One row for each spectrum, in the order of recording."""
        return read_spectra(self._query, self.spectrum, self._readings, self._bands)

    def scan(self, which: int | str | ScanRow) -> ScanSet:
        """Return all channels of a scan: by its index in `scans` (-1: the last), its key, or its row.

        Raises:
            FileError: the file is missing or damaged, or the scan was interrupted before its first line.
            NoSuchItem: there is no such scan.
        """
        row = self.scans[which] if isinstance(which, str) else which
        row = row if isinstance(row, ScanRow) else self._row("scans", row, scan_row)
        return ScanSet(self._content(row.file, f"scan {row.number}").scans)

    def spectrum(self, which: int | str | SpectrumRow) -> Spectrum:
        """Return a spectrum: by its index in `spectra` (-1: the last), its key, or its row. Raises as `scan`."""
        row = self.spectra[which] if isinstance(which, str) else which
        row = row if isinstance(row, SpectrumRow) else self._row("spectra", row, spectrum_row)
        return self._content(row.file, f"spectrum {row.number}").spectra[0]

    def about(self, row: ScanRow | SpectrumRow) -> dict[str, Any]:
        """Return the facts beside the values: drift, feedback, the controller's header, notes … Raises as `scan`."""
        header: dict[str, Any] = dict(self._content(row.file, f"number {row.number}").header)
        notes = [f"{note.text} ({note.who})" for note in self.notes_on(row)]
        settings = {setting.column: setting.value for setting in row.settings}
        return (
            header
            | ({"notes": notes} if notes else {})
            | ({"key": row.key} if row.key else {})
            | ({"settings": settings} if settings else {})
        )

    def film(self, scans: Sequence[ScanRow] | None = None, channel: str | None = None) -> Film:
        """Return scans of one place as a film aligned on the sample: `run.film().save("night.gif")`.

        A scan with a missing or damaged file is left out and logged.

        Args:
            scans: rows of `scans`; None: all scans of the place that was scanned most often.
            channel: the shown channel; None: the first.

        Raises:
            InvalidValue: fewer than two readable scans, not of one place, or a scan without the channel.
        """
        made: Film = required(DISPLAYS, "film")(self, scans, channel)
        return made

    def scan_at(self, time_ns: int, channel: str = "") -> ScanRow | None:
        """Return the scan that ended at a time; None if there is none.

        The channels of one scan may have different times, so the time may differ by up to a second.

        Args:
            channel: required channel; empty: any.
        """
        near = "SELECT * FROM scans WHERE abs(time_ns - ?) <= ? ORDER BY abs(time_ns - ?), number"
        rows = map(scan_row, self._query(near, (time_ns, _SAME_SCAN_NS, time_ns)))
        return next((row for row in rows if not channel or channel in dict(row.channels)), None)

    # --- events ---

    @property
    def notes(self) -> Table[NoteRow]:
        """Notes of persons and components, in the order of the moments that they are about."""
        return Table(map(self._note_row, self._notes()), NoteRow)

    def notes_on(self, row: ScanRow | SpectrumRow) -> Table[NoteRow]:
        """Return the notes on a scan; empty for a spectrum."""
        near = (note for note in self._notes() if note.scan_ns and abs(note.scan_ns - row.time_ns) <= _SAME_SCAN_NS)
        return Table(map(self._note_row, near), NoteRow).where(
            lambda note: isinstance(row, ScanRow) and note.scan == row.number
        )

    def _notes(self) -> list[Note]:
        payloads = self._query("SELECT payload FROM packets WHERE message = 'Note' ORDER BY time_ns")
        notes = [note for (payload,) in payloads if isinstance(note := self._decoded("Note", payload), Note)]
        return sorted(notes, key=lambda note: note.time_ns)

    def _note_row(self, note: Note) -> NoteRow:
        scan = None if note.scan_ns is None else self.scan_at(note.scan_ns)
        return NoteRow(note.time_ns, note.who, note.text, None if scan is None else scan.number, note.written_ns)

    @property
    def journal(self) -> Table[JournalEntry]:
        """Requests with their answers, changes of control, orders and notes; oldest first."""
        rows = self._query("SELECT payload FROM packets WHERE message = 'JournalEntries' ORDER BY time_ns, rowid")
        published = (self._decoded("JournalEntries", payload) for (payload,) in rows)
        entries = [entry for message in published if isinstance(message, JournalEntries) for entry in message.entries]
        notes = (JournalEntry(*row) for row in self._query("SELECT * FROM entries WHERE kind = 'note' ORDER BY rowid"))
        return Table(sorted((*entries, *notes), key=lambda entry: entry.time_ns), JournalEntry)

    @property
    def refusals(self) -> Table[JournalEntry]:
        """The refused requests with their reasons; waiting for control is not a refusal."""
        return self.journal.where(lambda entry: entry.refused)

    @property
    def control(self) -> Table[ControlRow]:
        """Holder, mode and problems: a row for each change."""
        rows: list[ControlRow] = []
        for time_ns, payload in self._query(
            "SELECT time_ns, payload FROM packets WHERE message = 'ControlState' ORDER BY time_ns"
        ):
            state = self._decoded("ControlState", payload)
            if isinstance(state, ControlState) and (not rows or rows[-1].state != state):
                rows.append(ControlRow(time_ns, state))
        return Table(rows, ControlRow)

    @property
    def problems(self) -> Table[ProblemRow]:
        """A row for each flag of a problem, without routine flags; see `Overview.is_routine`."""
        overview = self.overview()
        numbers = overview.problems
        rows = [
            ProblemRow(span.label, numbers.get(span.label, 0), span.start_ns, span.end_ns, span.by)
            for span in overview.problem_spans
        ]
        return Table(rows, ProblemRow)

    @property
    def processes(self) -> Table[ProcessRow]:
        """A row for each change of a process."""
        rows = self._query("SELECT * FROM processes ORDER BY time_ns, rowid")
        made = (
            ProcessRow(time_ns, name, role, ProcessCondition(condition), *rest)
            for time_ns, name, role, condition, *rest in rows
        )
        return Table(made, ProcessRow)

    @property
    def restarts(self) -> Table[ProcessRow]:
        """Each restart of a process: the first row with that number of starts."""
        starts: dict[str, int] = {}
        rows = []
        for row in self.processes:
            if row.starts > starts.get(row.name, 1):
                rows.append(row)
            starts[row.name] = row.starts
        return Table(rows, ProcessRow)

    @property
    def log(self) -> Table[LogLine]:
        """The log lines of all processes, oldest first."""
        rows = self._query("SELECT * FROM log ORDER BY time_ns, rowid")
        return Table((LogLine(*row) for row in rows), LogLine)

    @property
    def drift(self) -> Table[DriftPoint]:
        """The drift at each scan; empty without a Drift Compensated Scheduler."""
        from afspm.night.overview import DriftPoint

        return Table(self.overview(messages=("DriftMapping",)).drift, DriftPoint)

    def ledger(self, keep_away_m: float = KEEP_AWAY_M) -> TreatmentLedger:
        """Return the totals of the recorded treatments of tip and sample.

        Args:
            keep_away_m: distance from scanned regions within which a treatment counts as near.
        """
        positions, feedback = list[tuple[int, tuple[float, float]]](), list[tuple[int, bool]]()
        for packet, _, thing in self.messages(("ProbePosition", "ZCtrlParameters")):
            if isinstance(thing, ProbePosition):
                positions.append((packet.time_ns or 0, thing.xy_m))
            elif isinstance(thing, Feedback) and thing.on is not None:
                feedback.append((packet.time_ns or 0, thing.on))
        scanned = [(row.began_ns or row.time_ns, row.region) for row in self.scans if row.region is not None]
        return treatment_ledger(self.journal, positions, scanned, feedback, self.newest_ns, keep_away_m)

    def verdicts(self) -> list[tuple[int, float]]:
        """Return (time of the scan, score) of each verdict on a scan, in the order of arrival."""
        sql = "SELECT payload FROM packets WHERE message = ? ORDER BY time_ns, rowid"
        messages = (self._decoded(VERDICT_MESSAGE, payload) for (payload,) in self._query(sql, (VERDICT_MESSAGE,)))
        verdicts = (read_verdict(message) for message in messages if isinstance(message, SpatialROIWithScoreList))
        return [verdict for verdict in verdicts if verdict is not None]

    def judgements(self) -> Iterator[tuple[int, TipVerdict | SpatialROIWithScoreList]]:
        """Yield (time of publication, message) of each verdict of a component, on a scan or on the lines of one."""
        sql = "SELECT time_ns, message, payload FROM packets WHERE message IN (?, ?) ORDER BY time_ns, rowid"
        for time_ns, message, payload in self._query(sql, (VERDICT_MESSAGE, LINE_VERDICT_MESSAGE)):
            verdict = self._decoded(message, payload)
            if isinstance(verdict, TipVerdict | SpatialROIWithScoreList):
                yield time_ns, verdict

    def tip_changes_ns(self) -> list[int]:
        """Return the times at which the tip was seen to be changed, or was treated, oldest first.

        A change that a verdict on a whole scan shows has the time of this scan's end: the verdict may follow another
        scan. Flags of `tip-shape-changed` count in a run without verdicts, each from the end of the scan before it.
        """
        alarms = [
            time_ns for time_ns, verdict in self.judgements() if isinstance(verdict, TipVerdict) and verdict.stops
        ]
        flags = [] if alarms else [row.flagged_ns for row in self.problems if row.number == Problem.TIP_SHAPE_CHANGED]
        ends_ns = [row.time_ns for row in self.scans]
        bad = bad_scans(ends_ns, self.verdicts(), {int(Problem.TIP_SHAPE_CHANGED): flags})
        return sorted({*alarms, *bad, *treatment_times(self.journal)})

    def changed_rows(self) -> dict[int, int]:
        """Return the index of the first row after a tip change, by the end of the scan in ns.

        Only changes are included that were found while the scan ran; the last verdict on a scan counts.
        """
        sql = "SELECT payload FROM packets WHERE message = ? ORDER BY time_ns, rowid"
        rows: dict[int, int] = {}
        ends_ns = [row.time_ns for row in self.scans]
        for (payload,) in self._query(sql, (LINE_VERDICT_MESSAGE,)):
            verdict = self._decoded(LINE_VERDICT_MESSAGE, payload)
            if not isinstance(verdict, TipVerdict) or not verdict.HasField("timestamp"):
                continue
            began_ns = verdict.timestamp.ToNanoseconds()
            ended_ns = next((end_ns for end_ns in ends_ns if end_ns > began_ns), None)
            if ended_ns is not None:
                rows[ended_ns] = verdict.since_row
        return rows

    def watch_counts(self) -> dict[str, WatchCounts]:
        """Return what each watch on running scans has counted, by the name of the component."""
        name, counts_of = WatchCounts.DESCRIPTOR.name, {}
        sql = "SELECT envelope, payload FROM packets WHERE message = ? ORDER BY time_ns, rowid"
        for envelope, payload in self._query(sql, (name,)):
            counts = self._decoded(name, payload)
            if isinstance(counts, WatchCounts):
                counts_of[envelope.removeprefix(f"{name}_")] = counts
        return counts_of

    # --- everything ---

    def packets(
        self,
        *,
        since_ns: int = -1,
        messages: Sequence[str] | None = None,
        tell: Callable[[str], None] | None = None,
    ) -> Iterator[Packet]:
        """Yield the scheduler's packets newer than `since_ns`, oldest first, as they were published.

        The packets whose values are in a missing or damaged file are left out.

        Args:
            messages: names of the wanted messages, e.g. "ControlState"; None: all.
            tell: called with a message for each missing or damaged file; None: log it as a warning.
        """
        yield from packets(self._query, self.folder, since_ns, messages, tell)

    def packet_lookup(self) -> PacketLookup:
        """Return a function that returns the scheduler's packet of a time and an envelope, as it was published."""
        return PacketLookup(self._query, self.folder)

    def messages(self, messages: Sequence[str] | None = None) -> Iterator[tuple[Packet, str, Any]]:
        """Yield packet, name of its message and decoded content, without reading files.

        Scans and spectra have NaN for values; lines of running scans and unreadable packets are left out.
        """
        yield from without_reading_files(self._query, self.frame, messages, self._described_types())

    def own_messages(self) -> Iterator[tuple[Packet, str, Any]]:
        """Yield as `messages` the messages of the user's own types that the scheduler published."""
        names = self._own_names()
        return self.messages(names) if names else iter(())

    def unread_messages(self) -> list[str]:
        """Return a sentence for each envelope whose messages can't be read: the record lacks their description."""
        types, known = self._described_types(), wire.known_messages()
        unread = [name for name in self._own_names() if name not in types and name not in known]
        sql = f"SELECT envelope, count(*) FROM packets WHERE source = ? AND message IN ({', '.join('?' * len(unread))})"
        rows = self._query(f"{sql} GROUP BY envelope ORDER BY envelope", (SCHEDULER, *unread)) if unread else []
        modules = ", ".join((self.facts.get("guest") or {}).get("messages") or ()) or "the module of their type"
        why = f"this record does not describe the type, and {modules} is not imported"
        return [f"{counted(count, 'message')} {envelope} can't be read: {why}" for envelope, count in rows]

    def overview(self, messages: Sequence[str] | None = None, problems: ProblemNames | None = None) -> Overview:
        """Return the overview that the dashboard shows, without reading the files of scans.

        Args:
            messages: names of the messages to reduce; None: all.
            problems: names of problems that replace the recorded names.
        """
        from afspm.night.overview import Overview

        overview = Overview(problems or self.problem_names, bands=self._bands)
        for packet, message, thing in self.messages(messages):
            overview.take(message, thing, packet.time_ns or 0, packet.envelope)
        overview.unread = tuple(self.unread_messages())
        return overview

    # --- the run itself ---

    @cached_property
    def experiment(self) -> dict[str, Any]:
        """The content of the expanded experiment file. Raises FileError if the file can't be read."""
        try:
            return parse_toml((self.folder / EXPERIMENT_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise FileError(f"can't be read: {error}", where=str(self.folder / EXPERIMENT_FILE)) from error

    @property
    def facts(self) -> dict[str, Any]:
        """The content of run.json: clock, addresses, the end. Empty if the file can't be read."""
        return run_json_or_empty(self.folder)

    @property
    def metadata(self) -> dict[str, str]:
        """Sample, person, technique … where known.

        From [metadata] of the experiment file, the microscope's class, and entries made at the start of the run.
        """
        return dict(self.facts.get(METADATA) or {})

    @property
    def name(self) -> str:
        """The name of the experiment."""
        return str(self._note("experiment") or self.facts.get("name") or self.folder.name)

    @property
    def oldest_ns(self) -> int:
        """The time of the scheduler's first packet; 0 without packets."""
        return int(self._query("SELECT coalesce(min(time_ns), 0) FROM packets WHERE source = ?", (SCHEDULER,))[0][0])

    @property
    def newest_ns(self) -> int:
        """The time of the scheduler's last packet; 0 without packets."""
        return int(self._query("SELECT coalesce(max(time_ns), 0) FROM packets WHERE source = ?", (SCHEDULER,))[0][0])

    @property
    def simulated(self) -> bool:
        """Whether the microscope was simulated."""
        return bool(self._note("simulated"))

    @property
    def seeds(self) -> dict[str, Any]:
        """The seeds of random numbers, by component."""
        return dict(self._note("seeds") or {})

    @property
    def frame(self) -> Frame:
        """The frame of positions: the sample frame if drift was compensated, else the tip frame.

        Scans and spectra from before `correct_after` are in the tip frame.
        """
        return Frame(self._note("frame") or Frame.TIP.value)

    def numbered(self, number: int) -> ScanRow:
        """Return the scan with a number, as in reports and exports. Raises InvalidValue without such a scan."""
        rows = {row.number: row for row in self.scans}
        if number not in rows:
            hint = f"the last is {max(rows)}" if rows else "there is none yet"
            raise InvalidValue(f"there is no scan {number}", hint=hint)
        return rows[number]

    @property
    def problem_names(self) -> ProblemNames:
        """The names of the experiment's problems."""
        return ProblemNames((self.facts.get("guest") or {}).get("problems") or {})

    def close(self) -> None:
        """Close the journal. Safe to repeat."""
        self._journal.close()

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        scans, spectra = (self._query(f"SELECT count(*) FROM {kind}")[0][0] for kind in ("scans", "spectra"))
        return f"<Run {self.folder.name}: {counted(scans, 'scan')}, {counted(spectra, 'spectrum', 'spectra')}>"

    @cached_property
    def _bands(self) -> AllowedBands:
        from afspm.record import bands_allowed as allowed_bands

        return allowed_bands(self.folder)

    def _query(self, sql: str, values: Sequence[object] = ()) -> list[Row]:
        with self._naming_damage():
            return self._journal.execute(sql, values).fetchall()

    @contextmanager
    def _naming_damage(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.ProgrammingError as error:
            raise FileError("the run was closed", where=str(self.folder)) from error
        except sqlite3.DatabaseError as error:
            raise journal.damaged(self.folder / journal.JOURNAL_FILE, error) from error

    def _described_types(self) -> dict[str, type[Message]]:
        return described_types.read(self._note(journal.OWN_MESSAGES) or {})

    def _own_names(self) -> list[str]:
        # of all sources: the index then has the answer, and payloads are not read
        names = self._query("SELECT DISTINCT message FROM packets")
        return [name for (name,) in names if not wire.is_of_afspm(name)]

    def _note(self, name: str) -> Any:
        rows = self._query("SELECT value FROM about WHERE name = ?", (name,))
        return from_json(rows[0][0]) if rows else None

    def _row(self, table: str, index: int, made: Callable[[Row], R]) -> R:
        order, offset = ("ASC", index) if index >= 0 else ("DESC", -index - 1)
        rows = self._query(f"SELECT * FROM {table} ORDER BY number {order} LIMIT 1 OFFSET ?", (offset,))
        if not rows:
            raise NoSuchItem(f"there is no number {index} among the {table} of {self.folder.name}")
        return made(rows[0])

    def _content(self, file: str, what: str) -> FileContent:
        from afspm.storage.formats import read

        if not file:
            raise FileError(f"{what} was interrupted before anything of it was seen", where=str(self.folder))
        return read(journal.measured_file(self.folder, file))

    @staticmethod
    def _decoded(message: str, payload: bytes) -> object:
        try:
            return wire.decode(message, payload)
        except WireError:
            return None


def declare_described(folder: Path) -> bool:
    """Declare the types of messages that a record describes, as relayed; return whether there are any."""
    try:
        with open_run(folder) as run:
            types = run._described_types()
    except FileError:
        return False
    for message in types.values():
        wire.declare(wire.MessageDeclaration(type=message, relayed=True))
    return bool(types)


def _folder(path: Path) -> Path:
    if not (path / journal.JOURNAL_FILE).is_file():
        path = latest_run(path) or path
    path = path.resolve() if path.is_symlink() else path  # the link `latest` moves to the next run
    replayed = None if (path / journal.JOURNAL_FILE).is_file() else run_json_or_empty(path).get(REPLAY_OF)
    return Path(replayed) if isinstance(replayed, str) else path
