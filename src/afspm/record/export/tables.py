"""Tables (.csv): what was measured and what happened, and the curves of each spectrum."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from afspm.clock import iso_utc
from afspm.record.export.file_names import stem
from afspm.record.measured_files import write_synced
from afspm.record.run import Run
from afspm.record.tables import ScanRow, SpectrumRow, Table


def write(run: Run, row: ScanRow | SpectrumRow, folder: Path) -> Iterator[Path]:
    """A file for each spectrum."""
    if isinstance(row, SpectrumRow):
        spectrum = run.spectrum(row)
        header = [f"{name} [{unit}]" for name, unit in zip(spectrum.names, spectrum.units, strict=True)]
        yield _written(folder / f"{stem(row.file)}.csv", header, spectrum.values.tolist())


def write_tables(run: Run, scans: list[ScanRow], spectra: list[SpectrumRow], folder: Path) -> Iterator[Path]:
    """A table of each kind."""
    tables: dict[str, Table[Any]] = {
        "scans": Table(scans, ScanRow),
        "spectra": Table(spectra, SpectrumRow),
        "journal": run.journal,
        "refusals": run.refusals,
        "control": run.control,
        "problems": run.problems,
        "processes": run.processes,
        "drift": run.drift,
        "log": run.log,
    }
    for name, table in tables.items():
        columns = table.columns()
        rows = zip(*(_told(column, values) for column, values in columns.items()), strict=True)
        yield _written(folder / f"{name}.csv", [_named(column) for column in columns], rows)


def _named(column: str) -> str:
    return column.removesuffix("_ns") if column.endswith("_ns") else column


def _told(column: str, values: list[Any]) -> list[Any]:
    """Times as ISO 8601 in UTC, what is not known as nothing."""
    if column.endswith("_ns"):
        return ["" if value is None else iso_utc(value) for value in values]
    return ["" if value is None else value for value in values]


def _written(path: Path, header: list[str], rows: Iterable[Iterable[Any]]) -> Path:
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows(rows)
    write_synced(path, text.getvalue().encode())
    return path
