"""The lock held by the supervisor of a run, which shows whether the run continues or was cut off."""

from __future__ import annotations

import contextlib
import platform
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path, PurePath

from afspm.basics.errors import FileError
from afspm.basics.file_lock import lock
from afspm.basics.formatting import counted
from afspm.record.run_json import COMPUTER, ENDED, REPLAY_OF, STATE_DIR, run_json_or_empty
from afspm.storage.packet_log import LogReader, committed

LOCK_FILE = "running"
_MOST_COUNTED_BYTES = 32 << 20  # takes a fraction of a second: the supervisor does not wait for a recorder for long


@contextlib.contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Raise FileError for an OSError of the block, which writes into a run's folder before anything is started."""
    try:
        yield
    except OSError as error:
        raise FileError(
            f"the folder of the run can't be written: {error.strerror or error}",
            where=str(folder),
            hint="nothing was started; make room on its disk, or make it writable, and start again",
        ) from error


@contextlib.contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Hold the lock of a run in the block; the system releases the lock of a killed process.

    Raises:
        FileError: another process holds the lock: the run is still going on, or writes its report; or its file can't be
            written.
    """
    with writing_to(folder):
        opened = (folder / STATE_DIR / LOCK_FILE).open("a+b")
    with opened as file:
        try:
            lock(file)
        except OSError as error:
            what, hint = "this run is still going on", "`afspm status` shows it"
            if run_json_or_empty(folder).get(ENDED):
                what, hint = "this run has ended, and its report is still being written", "try again in a minute"
            raise FileError(what, where=str(folder), hint=hint) from error
        yield


def cut_off_message(folder: Path) -> str:
    """Return a message about a run that was cut off; empty if the run goes on, or has ended.

    Also empty on another computer, where the lock of the run can't be checked.
    """
    facts = run_json_or_empty(folder)
    if not facts or facts.get(ENDED) or other_computer(folder) or not _is_left(folder):
        return ""
    if REPLAY_OF in facts:
        return "this replay was cut off"
    return f"it was cut off; {resume_command(folder)} goes on with it"


def unrecorded_message(folder: Path, log: Path) -> str:
    """Return a message about results in a run's packet log that are not recorded; empty without such results."""
    if (position := committed(log)) is None:
        return ""
    reader = LogReader(log, position)
    try:
        envelopes = [entry.packet.envelope for entry, _ in reader.read(_MOST_COUNTED_BYTES)]
    except OSError as error:
        return f"the packet log of the run can't be read, results in it may not be recorded: {error}"
    if not (count := sum(envelope.startswith(("Scan2d", "Spec1d")) for envelope in envelopes)):
        return ""
    waiting = f"{'at least ' if reader.is_cut else ''}{counted(count, 'channel')} of scans and spectra"
    return f"the record lacks {waiting} that the packet log still has; {resume_command(folder)} records them"


def other_computer(folder: Path) -> str:
    """Return the name of the computer on which a run was last started; empty for this computer, or if unknown."""
    name = str(run_json_or_empty(folder).get(COMPUTER) or "")
    return "" if name == platform.node() else name


def goes_on(folder: Path) -> bool:
    """Return whether a run has neither ended nor been cut off, as far as this computer can know."""
    return not run_json_or_empty(folder).get(ENDED) and not cut_off_message(folder)


def is_locked(folder: Path) -> bool:
    """Return whether a run is going on on this computer."""
    return (folder / STATE_DIR / LOCK_FILE).exists() and not _is_left(folder)


def describe_state(folder: Path) -> str:
    """Return the state of a run as text: its end, running, or cut off."""
    if ended := run_json_or_empty(folder).get(ENDED):
        return str(ended)
    if name := other_computer(folder):
        return f"it goes on, or was cut off; {name}, on which it was started, knows"
    known = (folder / STATE_DIR / LOCK_FILE).exists()
    return cut_off_message(folder) or ("it goes on" if known else "it goes on, or was cut off")


def resume_command(folder: PurePath) -> str:
    return f"`afspm run --resume {quoted(folder)}`"


def quoted(path: PurePath) -> str:
    """Quote a path for the shell."""
    if sys.platform != "win32":
        return shlex.quote(str(path))
    from subprocess import list2cmdline

    return list2cmdline([str(path)])


def _is_left(folder: Path) -> bool:
    try:
        with (folder / STATE_DIR / LOCK_FILE).open("rb") as file:
            # shared: concurrent queries must not look like a running supervisor to each other
            lock(file, shared=True)
    except OSError:
        return False
    return True
