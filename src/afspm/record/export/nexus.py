"""NeXus (.h5): the files of the record, with their keys, and the notes on each scan as NXnote."""

from __future__ import annotations

import io
from collections.abc import Iterator

from afspm.clock import iso_utc
from afspm.record.run import Run
from afspm.record.tables import ScanRow, SpectrumRow


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield the file of a scan or spectrum, with the end of its name."""
    import h5py

    run.about(row)  # raises where the file is damaged
    content = io.BytesIO((run.folder / row.file).read_bytes())
    with h5py.File(content, "r+") as file:
        if row.key:
            file["entry"]["afspm"].attrs["key"] = row.key
        for number, note in enumerate(run.notes_on(row), 1):
            group = file["entry"].create_group(f"note_{number}")
            group.attrs["NX_class"] = "NXnote"
            group["author"], group["description"] = note.who, note.text
            group["type"] = "text/plain"
            if note.written_ns is not None:
                group["date"] = iso_utc(note.written_ns)
    yield ".h5", content.getvalue()
