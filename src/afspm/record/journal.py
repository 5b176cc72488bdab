"""journal.sqlite: its tables, and functions that open it. One process writes; any number of processes read."""

from __future__ import annotations

import atexit
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePath

from afspm.basics.errors import FileError

JOURNAL_FILE = "journal.sqlite"
FORMAT = "afspm record 1"
OWN_MESSAGES = "messages"
"""The fact about a run that describes the types of its user's messages; see `described_types`."""
SCHEDULER = ""
"""The source of the scheduler's packets; other publishers are recorded by address."""

_TABLES = """
CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
-- All published packets. Values of scans and spectra are in files: the payload is the rest of the message.
CREATE TABLE IF NOT EXISTS packets (
  time_ns INTEGER NOT NULL, envelope TEXT NOT NULL, message TEXT NOT NULL, source TEXT NOT NULL,
  payload BLOB NOT NULL, scan INTEGER, spectrum INTEGER, channel TEXT, first_row INTEGER, rows INTEGER);
CREATE UNIQUE INDEX IF NOT EXISTS packets_once ON packets (time_ns, envelope);
CREATE INDEX IF NOT EXISTS packets_by_message ON packets (message, time_ns);
-- Lengths in m, angles in rad; channels and problems as JSON. An interrupted scan without lines has no file.
CREATE TABLE IF NOT EXISTS scans (
  number INTEGER PRIMARY KEY, time_ns INTEGER NOT NULL, began_ns INTEGER, filename TEXT NOT NULL, file TEXT NOT NULL,
  interrupted INTEGER NOT NULL, center_x REAL, center_y REAL, width REAL, height REAL, angle REAL, frame TEXT,
  rows INTEGER, columns INTEGER, channels TEXT NOT NULL, holder TEXT, mode TEXT, problems TEXT NOT NULL);
CREATE UNIQUE INDEX IF NOT EXISTS scans_once ON scans (time_ns, filename, interrupted);
CREATE TABLE IF NOT EXISTS spectra (
  number INTEGER PRIMARY KEY, time_ns INTEGER NOT NULL, began_ns INTEGER, filename TEXT NOT NULL, file TEXT NOT NULL,
  kind TEXT NOT NULL, x REAL, y REAL, frame TEXT, points INTEGER NOT NULL, names TEXT NOT NULL, units TEXT NOT NULL,
  holder TEXT, mode TEXT, problems TEXT NOT NULL);
CREATE UNIQUE INDEX IF NOT EXISTS spectra_once ON spectra (time_ns, filename, kind);
-- Requests with their answers, changes of control, orders.
CREATE TABLE IF NOT EXISTS entries (
  time_ns INTEGER NOT NULL, kind TEXT NOT NULL, who TEXT NOT NULL, what TEXT NOT NULL, response INTEGER,
  reason TEXT NOT NULL, took_s REAL);
CREATE INDEX IF NOT EXISTS entries_by_time ON entries (time_ns);
-- When scans and spectra were asked for, and under which keys; the answer may have come after what was measured.
CREATE TABLE IF NOT EXISTS starts (sent_ns INTEGER NOT NULL, action TEXT NOT NULL, key TEXT NOT NULL);
-- A row for each change of a process, not for each report.
CREATE TABLE IF NOT EXISTS processes (
  time_ns INTEGER NOT NULL, name TEXT NOT NULL, role TEXT NOT NULL, condition INTEGER NOT NULL,
  since_ns INTEGER NOT NULL, starts INTEGER NOT NULL, pid INTEGER NOT NULL, last_exit TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS processes_by_name ON processes (name);
CREATE TABLE IF NOT EXISTS log (
  time_ns INTEGER NOT NULL, name TEXT NOT NULL, level TEXT NOT NULL, text TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS log_by_time ON log (time_ns);
"""
_VIRTUAL = re.compile(r"\s*CREATE\s+VIRTUAL\b", re.IGNORECASE)
_DAMAGE = (sqlite3.DatabaseError, UnicodeDecodeError)  # SQLite's messages quote damaged text, which may be no UTF-8


def open_to_write(folder: Path) -> sqlite3.Connection:
    """Open the journal in a run folder; create a missing journal.

    Raises:
        FileError: the file is damaged, or of another kind.
        sqlite3.OperationalError: the disk is full …
    """
    path = folder / JOURNAL_FILE
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=30.0)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        format_row = f"INSERT OR IGNORE INTO about VALUES ('format', '{FORMAT}');"
        # a reader finds all tables or none
        connection.executescript(f"BEGIN IMMEDIATE; {_TABLES} {format_row} COMMIT;")
        check_format(connection, path)
    except sqlite3.OperationalError:
        connection.close()
        raise
    except (*_DAMAGE, FileError) as error:
        connection.close()
        raise damaged(path, error) from error
    return connection


def open_to_read(folder: Path) -> sqlite3.Connection:
    """Open the journal in a run folder for reading, also while another process writes, or from a read-only disk.

    Raises:
        FileError: the file is missing, damaged, or of another kind.
    """
    path = folder / JOURNAL_FILE
    if not path.is_file():
        what = "there is no record in this folder"
        if not folder.is_dir():
            what = "this is a file, not the folder of a run" if folder.exists() else "there is no such folder"
        raise FileError(what, where=str(folder), hint="name the folder of a run, runs/…")
    try:
        try:
            return _checked(read_only(path.resolve()), path)
        except sqlite3.OperationalError as error:
            # SQLite reports a read-only folder by its text only
            if "unable to open" not in str(error) and "readonly" not in str(error):
                raise
            return _checked_copy(path)  # SQLite can't create its files beside the journal there
    except _DAMAGE as error:
        raise damaged(path, error) from error


def measured_file(folder: Path, file: str) -> Path:
    """Return the file of a scan or spectrum, which the journal names relative to its folder.

    Raises:
        FileError: the path leads out of the run folder; a run from another person is not trusted.
    """
    path = folder / file
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FileError(f"is not in the folder of the run, {folder}: the journal is not trusted", where=str(path))
    return path


def read_only(path: PurePath) -> str:
    """Return the URI that opens an absolute path read-only in SQLite, where a network share is part of the path."""
    # SQLite refuses a host in a URI, so the share of a network path goes into the path
    scheme, _, place = path.as_uri().partition("//")
    return f"{scheme}{'//' if place.startswith('/') else '////'}{place}?mode=ro"


def not_a_table(connection: sqlite3.Connection) -> str:
    """Return the name of a view, trigger or virtual table of a database; empty if there is none.

    A view in the place of a table would run its author's SQL, perhaps without end.
    """
    for name, kind, sql in connection.execute("SELECT name, type, sql FROM sqlite_master"):
        if kind not in ("table", "index") or _VIRTUAL.match(sql or ""):
            return str(name)
    return ""


def is_damage(error: sqlite3.DatabaseError) -> bool:
    """Return whether an error means a damaged file, and not a full disk."""
    # SQLite reports damage as a bare DatabaseError; its subclasses report the disk, locks and wrong statements
    return type(error) is sqlite3.DatabaseError


def damaged(path: Path, error: Exception) -> FileError:
    return error if isinstance(error, FileError) else FileError(f"is damaged: {error}", where=str(path))


def check_format(connection: sqlite3.Connection, path: Path) -> None:
    """Raise FileError if the file is not a journal, or of another version."""
    found = connection.execute("SELECT value FROM about WHERE name = 'format'").fetchone()
    if found is None or found[0] != FORMAT:
        name = found[0] if found else "unknown format"
        raise FileError(f"is not a journal of this version: {name}", where=str(path), hint="a newer afspm may read it")


class _Reader(sqlite3.Connection):
    """A connection that is closed when it is collected: a notebook opens a run without `with`."""

    def __del__(self) -> None:
        # Since Python 3.13 sqlite3 warns of a connection that is collected while it is open. If the file could not be
        # opened, there is nothing to close.
        with suppress(sqlite3.ProgrammingError):
            self.close()


class _OfCopy(_Reader):
    """A connection to a copy, removed when the connection is closed or collected, or (except on Windows) at exit."""

    remove: Callable[[], object] = staticmethod(lambda: None)

    def remove_at_end(self, folder: Path) -> None:
        self.remove = partial(shutil.rmtree, folder, ignore_errors=True)
        atexit.register(self.remove)

    def close(self) -> None:
        super().close()  # first: Windows removes no file that is open
        self.remove()
        atexit.unregister(self.remove)


def _checked_copy(path: Path) -> sqlite3.Connection:
    try:
        folder = Path(tempfile.mkdtemp(prefix="afspm-record-"))
    except OSError as error:
        raise FileError(f"can't be read, there is no room for a copy: {error}", where=str(path)) from error
    try:
        # the newest transactions are in the write-ahead log
        for suffix in ("", "-wal"):
            with suppress(FileNotFoundError):
                shutil.copy(f"{path}{suffix}", folder / f"{path.name}{suffix}")
        connection = _checked(read_only(folder / path.name), path, _OfCopy)
        assert isinstance(connection, _OfCopy)
    except BaseException as error:  # only to remove the copy: every error is raised again
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError):
            raise FileError(f"can't be read, no copy can be made of it: {error}", where=str(path)) from error
        raise
    connection.remove_at_end(folder)
    return connection


def _checked(uri: str, path: Path, kind: type[_Reader] = _Reader) -> sqlite3.Connection:
    connection = sqlite3.connect(
        uri, uri=True, isolation_level=None, check_same_thread=False, timeout=30.0, factory=kind
    )
    try:
        # the journal may come from another person: no writes, and no functions called by its schema
        connection.execute("PRAGMA query_only = 1")
        connection.execute("PRAGMA trusted_schema = 0")
        if strange := not_a_table(connection):
            raise FileError(f"is not a journal that afspm wrote: {strange!r} is not a table", where=str(path))
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
        if not tables:
            raise FileError("this record has not begun yet", where=str(path))
        if "about" not in tables:
            raise FileError("is not a journal of an experiment", where=str(path))
        check_format(connection, path)
    except BaseException:  # only to close: every error is raised again
        connection.close()
        raise
    return connection
