"""The table of planned and measured work at the head of the report."""

from __future__ import annotations

from html import escape

from afspm.basics.formatting import duration_text, quantity
from afspm.model.planned_work import PlannedWork
from afspm.report.markup import table
from afspm.report.story import RunStory


def html(story: RunStory) -> str:
    """Return a table of planned and measured work, two rows for each component with a plan; empty without plans."""
    rows = []
    for one in story.comparisons:
        planned = "planned at most" if one.planned.at_most else "planned"
        rows.append([escape(one.name), planned, *_cells(one.planned)])
        rows.append(["", "measured", *_cells(one.measured)])
    if not rows:
        return ""
    # the plan leaves computing out, which a fast clock multiplies by its speed
    computing = "" if story.real_s is None else ", and with the real time of computing times the speed of the clock"
    note = (
        "Both durations are in experiment time. The measured one goes from the first scan or spectrum to the end of "
        f"the last, with pauses and repairs{computing}."
    )
    made = table(["component", "", "scans", "spectra", "path", "duration"], rows)
    return f'{made}<p class="note">{note}</p>'


def _cells(work: PlannedWork) -> list[str]:
    return [
        "without end" if work.scans is None else str(work.scans),
        str(work.spectra),
        quantity(work.path_m, "m", 3),
        "not known" if work.duration_s is None else duration_text(work.duration_s),
    ]
