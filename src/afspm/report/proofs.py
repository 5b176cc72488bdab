"""What each result stands for, and the facts that it left unproved, for the report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

from afspm.model import MeasurementConditions, Parameter
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.record.run_json import LOST_WITHOUT, NEVER_SHOWN
from afspm.report import markup
from afspm.report.markup import PageTimes

MOST_ROWS = 200


class ResultProofs:
    """The published conditions of all results; none for results of other translators and of earlier versions.

    Attributes:
        notes: what the controller never shows of a measurement, with its name and the reasons, and what it can't do
            with the settings of this run, as sentences.
    """

    def __init__(self, conditions: Sequence[MeasurementConditions] = (), notes: Sequence[str] = ()) -> None:
        self.notes = notes
        self._by_time = {one.time_ns: one for one in conditions}
        self._by_file = {one.filename: one for one in conditions if one.filename}

    def of(self, row: ScanRow | SpectrumRow) -> MeasurementConditions | None:
        """Return the conditions of a result: by its time, or by its file if the result had no time of its own."""
        return self._by_time.get(row.time_ns) or self._by_file.get(row.filename)

    def facts(self, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, str]]:
        """Yield who asked for a result, the settings in force and the unproved facts, as names and HTML."""
        one = self.of(row)
        if one is not None:
            yield "asked for by", escape(one.holder or "a person, at the microscope" if one.began_ns else "")
            yield "set for it", escape(_settings(one))
            yield "not proved", escape("; ".join(one.unproved))


def read(run: Run) -> ResultProofs:
    never = "; ".join(f"{witness} ({why})" for witness, why in run.facts.get(NEVER_SHOWN, {}).items())
    software = run.metadata.get("software", "The controller")
    notes = [f"{software} never shows: {never}."] if never else []
    notes += [f"{software}: {lost}." for lost in run.facts.get(LOST_WITHOUT, ())]
    return ResultProofs([one for _, _, one in run.messages(("MeasurementConditions",))], notes)


def html(proofs: ResultProofs, rows: Sequence[ScanRow | SpectrumRow], clock: PageTimes) -> str:
    """Return the notes on the controller, and the table of the results with unproved facts; empty without any."""
    found = [(row, one.unproved) for row in rows if (one := proofs.of(row)) is not None and one.unproved]
    cells = [
        [
            f"{'scan' if isinstance(row, ScanRow) else 'spectrum'} {row.number}",
            clock.both(row.time_ns),
            escape("; ".join(unproved)),
        ]
        for row, unproved in found[:MOST_ROWS]
    ]
    left_out = len(found) - len(cells)
    more = f'<p class="note">{left_out} more are in the record.</p>' if left_out else ""
    notes = "".join(f'<p class="note">{escape(one)}</p>' for one in proofs.notes)
    return notes + markup.table(["result", "finished", "the controller could have shown, and did not"], cells) + more


def _settings(one: MeasurementConditions) -> str:
    at_end = {each.name: _text(each) for each in one.end_values}
    begin = ((each.name, _text(each)) for each in one.begin_values)
    return ", ".join(f"{name} {text}{_changed(text, at_end.get(name, text))}" for name, text in begin)


def _changed(begin: str, end: str) -> str:
    return "" if end == begin else f" (at the end {end})"


def _text(one: Parameter) -> str:
    return " ".join(filter(None, (one.value, one.unit)))
