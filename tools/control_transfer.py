"""How control passes from component to component, drawn from the record of a night.

`python tools/control_transfer.py RUN` takes the last repair of a run into `docs/pictures/control-transfer.json`, which
`tools/drawings.py` draws.
"""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from sheet import BAD, CONTROL, GOOD, GREY, INK, PAPER, QUIET, Sheet

import afspm
from afspm.night.bad_scans import BAD as BAD_SCORE

RECORD: Final = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "control-transfer.json"
BEFORE_S, AFTER_S = 1500.0, 900.0
COMPONENTS: Final = ("series", "tip_classifier", "tip_corrector")
WIDTH: Final = 740.0


def excerpt(folder: Path) -> dict[str, Any]:
    """Return the last repair of a run; times in seconds from the flag."""
    run = afspm.open_run(folder)
    problem = run.problems[-1]
    flagged_ns, cleared_ns = problem.flagged_ns, problem.cleared_ns
    assert cleared_ns is not None

    def seconds(time_ns: int) -> float:
        return round((time_ns - flagged_ns) / 1e9, 1)

    regained_ns = next(row.time_ns for row in run.control if row.time_ns > cleared_ns and row.state.holder)
    begin_s, end_s = -BEFORE_S, seconds(regained_ns) + AFTER_S
    bad_ns = {time_ns for time_ns, score in run.verdicts() if score == BAD_SCORE}
    return {
        "run": run.folder.name,
        "simulated": run.simulated,
        "flagged": datetime.fromtimestamp(flagged_ns / 1e9, UTC).isoformat(timespec="seconds"),
        "problem": problem.name,
        "by": problem.by,
        "span_s": [begin_s, end_s],
        "cleared_s": seconds(cleared_ns),
        "control": [
            [max(begin_s, seconds(row.time_ns)), min(end_s, seconds(after.time_ns)), row.state.holder]
            for row, after in pairwise(run.control)
            if row.state.holder and begin_s < seconds(after.time_ns) and seconds(row.time_ns) < end_s
        ],
        "scans": [
            [seconds(row.began_ns), seconds(row.time_ns), any(abs(row.time_ns - bad) < 1e9 for bad in bad_ns)]
            for row in run.scans
            if row.began_ns and begin_s < seconds(row.began_ns) and seconds(row.time_ns) < end_s
        ],
        "actions": [
            [seconds(entry.time_ns), entry.what.removeprefix("x-")]
            for entry in run.journal
            if entry.what in ("x-pulse", "x-crash") and begin_s < seconds(entry.time_ns) < end_s
        ],
    }


def control_transfer() -> str:
    """The components before, during and after a repair: the holder is outlined, and the flag stands on top."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    sheet = Sheet()
    granted_s, regained_s = (
        next(start for start, _, holder in record["control"] if holder == name and start >= 0)
        for name in COMPONENTS[::2][::-1]
    )
    moments = (
        (record["span_s"][0], "before", "series", False, "series scans.", "No problem is flagged."),
        (0.0, "t0", None, True, "The classifier flags", "a bad tip: control is taken."),
        (granted_s, "t1", "tip_corrector", True, "The corrector solves it:", "it gets control, and acts."),
        (record["cleared_s"], "t2", None, False, "A test scan is good:", "the classifier clears the flag."),
        (regained_s, "t3", "series", False, "series requests control,", "gets it and goes on."),
    )
    for number, (time_s, name, holder, flagged, *captions) in enumerate(moments):
        x = 76 + number * 147.0
        sheet.note((x, 20), name, bold=True)
        sheet.note((x, 36), "" if number == 0 else _clock(record, time_s), fill=QUIET, size=11)
        if flagged:
            sheet.box((x, 60), (132, 24), "flag", f"⚑ {record['problem']}", ink=PAPER)
        else:
            sheet.box((x, 60), (132, 24), "idle", "no flag", bold=False, ink=QUIET)
        for row, component in enumerate(COMPONENTS):
            outlined = CONTROL if component == holder else ""
            sheet.box((x, 104 + row * 42), (118, 28), "component", component, outlined=outlined)
        for row, caption in enumerate(captions):
            sheet.note((x, 228 + row * 15), caption, size=11)
    _time_lines(sheet, record, [(time_s, name) for time_s, name, *_ in moments[1:]])
    return sheet.document(WIDTH, 470, "Control passes from a scan series to a tip repair, and back")


def _time_lines(sheet: Sheet, record: dict[str, Any], moments: list[tuple[float, str]]) -> None:
    left, right, top = 128.0, WIDTH - 18, 282.0
    begin_s, end_s = record["span_s"]

    def x(time_s: float) -> float:
        return left + (time_s - begin_s) / (end_s - begin_s) * (right - left)

    def bar(row: int, start_s: float, end_s: float, fill: str, tall: float = 20) -> None:
        wide = max(1.5, x(end_s) - x(start_s))
        sheet.svg.box(x(start_s), top + row * 32 - tall / 2, wide, tall, fill=fill, stroke=fill, corner=2)

    rows = ("flag", "series in control", "corrector in control", "scans")
    for row, text in enumerate(rows):
        sheet.note((left - 8, top + row * 32 + 4), text, anchor="end", size=11)
        sheet.svg.line([(left, top + row * 32), (right, top + row * 32)], stroke="#bbbbbb", end=False)
    bar(0, 0, record["cleared_s"], BAD)
    for start_s, until_s, holder in record["control"]:
        bar(COMPONENTS.index(holder) // 2 + 1, start_s, until_s, CONTROL)
    for start_s, until_s, bad in record["scans"]:
        bar(3, start_s, until_s, BAD if bad else GOOD, 16)
    for time_s, what in record["actions"]:
        sheet.note((x(time_s), top + 2 * 32 + 4), {"pulse": "▼", "crash": "✖"}[what], fill=INK, size=11)
    bottom = top + 3 * 32 + 16
    groups: list[tuple[float, str]] = []
    for time_s, name in moments:
        if groups and x(time_s) - x(groups[-1][0]) < 18:
            groups[-1] = (groups[-1][0], f"{groups[-1][1]}, {name}")
        else:
            groups.append((time_s, name))
    for time_s, name in groups:
        sheet.svg.line([(x(time_s), top - 18), (x(time_s), bottom)], stroke=GREY, end=False, dashed=True)
        sheet.note((x(time_s), top - 22), name, bold=True, size=11)
    for minute in range(-20, int(end_s / 60) + 1, 10):
        sheet.note((x(minute * 60), bottom + 14), f"{minute}", size=11)
    sheet.note(((left + right) / 2, bottom + 31), "minutes from t0", size=11, fill=QUIET)
    legend = "▼ pulse · ✖ crash into another place · red scans were judged bad"
    sheet.note((18, bottom + 54), legend, anchor="start", size=11, fill=QUIET)
    what = "SIMULATED" if record["simulated"] else record["run"]
    sheet.note((right, bottom + 54), what, anchor="end", size=11, bold=True, fill=BAD)


def _clock(record: dict[str, Any], time_s: float) -> str:
    start_s = datetime.fromisoformat(record["flagged"]).timestamp()
    return datetime.fromtimestamp(start_s + time_s, UTC).strftime("%H:%M:%S")


if __name__ == "__main__":
    RECORD.write_text(json.dumps(excerpt(Path(sys.argv[1])), indent=1) + "\n", encoding="utf-8", newline="\n")
