"""The table of planned and measured work at the head of the report."""

from __future__ import annotations

from html import escape

from afspm.basics.formatting import duration_text, quantity
from afspm.model.planned_work import PlannedWork
from afspm.record.report.markup import table
from afspm.record.report.story import RunStory


def html(story: RunStory) -> str:
    """Return a table of planned and measured work, two rows for each component with a plan; empty without plans."""
    rows = []
    for one in story.comparisons:
        planned = "planned at most" if one.planned.at_most else "planned"
        rows.append([escape(one.name), planned, *_cells(one.planned)])
        rows.append(["", "measured", *_cells(one.measured)])
    return table(["component", "", "scans", "spectra", "path", "duration"], rows)


def _cells(work: PlannedWork) -> list[str]:
    return [
        "without end" if work.scans is None else str(work.scans),
        str(work.spectra),
        quantity(work.path_m, "m", 3),
        "not known" if work.duration_s is None else duration_text(work.duration_s),
    ]
