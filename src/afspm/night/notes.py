"""Notes written into the record after the end of a run.

During a run the scheduler publishes a note, so it is in the packet log before its author gets the answer. Journal
entries are gathered for a tenth of a second, which a kill may lose, and a separate file of notes would be unknown to
replay, late joiners and other computers. Files of scans are never rewritten, so they contain no notes.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from afspm import wire
from afspm.basics.errors import FileError
from afspm.model import Note, Packet
from afspm.night.run import open_run
from afspm.record import lock_run
from afspm.record.journal import SCHEDULER
from afspm.record.run_json import STATE_DIR
from afspm.record.store import RecordStore
from afspm.wire.messages import NOTE

_STEP_NS = 1_000


def append_note(
    folder: Path, who: str, text: str, written_ns: int, scan_ns: int | None = None, time_ns: int | None = None
) -> Note:
    """Append a note to the record of an ended run, in the form in which the scheduler publishes notes.

    Args:
        folder: the folder of the run.
        who: the author.
        written_ns: real time of writing, in ns since the epoch.
        scan_ns: time of the scan that the note is about.
        time_ns: the moment that the note is about; None: the end of the scan, or else the last packet of the run.

    Raises:
        InvalidValue: the text is empty or too long.
        FileError: the run goes on, or the record can't be written.
    """
    with open_run(folder) as run:
        folder, end_ns = run.folder, run.newest_ns
    about_ns = next(one for one in (time_ns, scan_ns, end_ns) if one is not None)
    note = Note(about_ns, who, text, scan_ns, written_ns)
    packet = Packet(NOTE.name, wire.encode(note)[1], end_ns + _STEP_NS)
    try:
        (folder / STATE_DIR).mkdir(exist_ok=True)  # a copy of a run may lack it
        with lock_run(folder), closing(RecordStore(folder)) as store:
            store.take([(packet, SCHEDULER)])
            store.settle()
    except (OSError, sqlite3.OperationalError) as error:
        raise FileError(f"the note can't be written: {error}", where=str(folder)) from error
    return note
