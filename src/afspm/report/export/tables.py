"""Tables (.csv): measurements, events, and the curves of each spectrum."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from typing import Any

from afspm import wire
from afspm.basics import utc_time
from afspm.basics.clock import iso_utc
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow, Table

_BOM = "\ufeff"


class CsvExporter:
    """An exporter of tables. See `afspm.report.export`.

    Args:
        for_excel: write semicolons, decimal commas, times that Excel reads as times, and the mark of UTF-8 without
            which Excel takes another encoding: an Excel set to a decimal comma opens the file by a double click.
    """

    def __init__(self, *, for_excel: bool) -> None:
        self._for_excel = for_excel

    def write(self, run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
        """Yield (suffix, content) of the curves of a spectrum; nothing for a scan."""
        if isinstance(row, SpectrumRow):
            spectrum = run.spectrum(row)
            header = [f"{name} [{unit}]" for name, unit in zip(spectrum.names, spectrum.units, strict=True)]
            yield ".csv", self._csv(header, spectrum.values.tolist())

    def tables(self, run: Run, scans: list[ScanRow], spectra: list[SpectrumRow]) -> Iterator[tuple[str, bytes]]:
        """Yield (name, content) of a table of each kind."""
        by_name: dict[str, Table[Any]] = {
            "scans": Table(scans, ScanRow),
            "spectra": Table(spectra, SpectrumRow),
            "notes": run.notes,
            "journal": run.journal,
            "refusals": run.refusals,
            "control": run.control,
            "problems": run.problems,
            "processes": run.processes,
            "drift": run.drift,
            "log": run.log,
        }
        for name, table in by_name.items():
            columns = table.columns()
            rows = zip(*(self._cells(column, values) for column, values in columns.items()), strict=True)
            yield f"{name}.csv", self._csv([column.removesuffix("_ns") for column in columns], rows)
        yield from self._own_messages(run)

    def _own_messages(self, run: Run) -> Iterator[tuple[str, bytes]]:
        by_name: dict[str, list[tuple[str, str, dict[str, object]]]] = {}
        for packet, name, message in run.own_messages():
            plain = wire.as_plain(message)
            fields = plain if isinstance(plain, dict) else {"value": plain}
            who = packet.envelope.removeprefix(name).removeprefix("_")
            by_name.setdefault(name, []).append((self._time(packet.time_ns or 0), who, fields))
        for name, messages in by_name.items():
            columns = list(dict.fromkeys(column for _, _, fields in messages for column in fields))
            rows = ([time, who, *(fields.get(column, "") for column in columns)] for time, who, fields in messages)
            yield f"message-{name}.csv", self._csv(["time", "component", *columns], rows)

    def _cells(self, column: str, values: list[Any]) -> list[object]:
        if column.endswith("_ns"):
            return ["" if value is None else self._time(value) for value in values]
        return ["" if value is None else value for value in values]

    def _time(self, time_ns: int) -> str:
        # Excel takes no T, no Z and at most ms, and expects the decimal comma in times, too
        return f"{utc_time(time_ns):%Y-%m-%d %H:%M:%S,%f}"[:-3] if self._for_excel else iso_utc(time_ns)

    def _csv(self, header: list[str], rows: Iterable[Iterable[object]]) -> bytes:
        text = io.StringIO(newline="")
        if not self._for_excel:
            writer = csv.writer(text)
        else:
            text.write(_BOM)
            writer = csv.writer(text, delimiter=";")
            rows = ((str(cell).replace(".", ",") if isinstance(cell, float) else cell for cell in row) for row in rows)
        writer.writerow(header)
        writer.writerows(rows)
        return text.getvalue().encode()


CSV = CsvExporter(for_excel=False)
EXCEL = CsvExporter(for_excel=True)
