"""`python -m benchmarks.line_watch.foreign FOLDER [--minutes 20]`: judges nights that another author has simulated.

The folder holds `NNN.npz` (`trace` and `retrace`, [scan, y, x] in nm; `line_time_s`; `pixel_nm`) and `NNN.truth.json`
(`event`, `event_scan`, `event_row`, `event_visible_levelled`, `tip_event`; `benign`, `benign_scan`). The judges are
`LineWatch` with and without retrace, and `TipClassifier`. All learn from the first three scans; nights whose event
begins before the fourth are left out. A scan before the event is good, whatever the benign condition.

An event counts as visible if the levelled images differ by more than the noise (rms). Of a change with fewer than
20 rows after it in its scan, `LineWatch` is not judged. The classifier has found a change if it calls the scan of the
change or the next one bad. `LineWatch` takes some seconds for a night: `--others 20` leaves out nights without an event
but for the first 20. Keeps the outcomes in build/line_watch_foreign.jsonl.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import repeat
from pathlib import Path

import numpy as np

from afspm.components import Array
from afspm.components.tip_judge import Opinion, TipJudge
from afspm.model import Region
from afspm.plugins.line_watch.line_judge import AlarmLevel, Kind, LineJudge, ScanJudge, WholeScan

KEPT = Path("build/line_watch_foreign.jsonl")
LEARNT, WITHIN, LEAST_VISIBLE = 3, 20, 1.0
JUDGES = ("classifier", "with retrace", "trace alone")


@dataclass(frozen=True)
class ForeignOutcome:
    """The verdict on one scan.

    Attributes:
        judge: see `JUDGES`.
        condition: the event, or the benign condition of a good scan.
        is_event: whether the event begins in the scan.
        row: first row of the event.
        is_counted: whether the event is visible and has enough rows after it.
        look_row, stop_row: rows of the first alarms of these levels or above, or None; 0 where the classifier says
            unclear and bad.
    """

    night: str
    surface: str
    judge: str
    scan: int
    condition: str
    is_event: bool
    row: int
    is_counted: bool
    look_row: int | None
    stop_row: int | None


class ForeignNight:
    """A night from its two files."""

    def __init__(self, path: Path) -> None:
        self.name = path.stem
        with np.load(path) as kept:
            self.pictures = [
                [np.array(kept[name][scan], dtype=np.float64) * 1e-9 for name in ("trace", "retrace")]
                for scan in range(len(kept["trace"]))
            ]
            rows, columns = self.pictures[0][0].shape
            self.scan_s = rows * float(kept["line_time_s"])
            size_m = float(kept["pixel_nm"]) * 1e-9
        self.truth = json.loads(path.with_suffix(".truth.json").read_text(encoding="utf-8"))
        self.region = Region((0.0, 0.0), (columns * size_m, rows * size_m))
        self.kind = Kind.of(self.region, (rows, columns), "")
        event = self.truth["event_scan"]
        self.event_scan = len(self.pictures) if event is None else int(event)

    def judged(self, judge: str) -> list[ForeignOutcome]:
        """Return the outcomes of a judge until the event's scan."""
        if self.event_scan < LEARNT:
            return []
        if judge == "classifier":
            return self._classified()
        return list(self._watched(judge, 2 if judge == "with retrace" else 1))

    def _watched(self, name: str, channels: int) -> Iterator[ForeignOutcome]:
        judge, doubted = LineJudge(), None
        for scan, both in enumerate(self.pictures[: self.event_scan + 1]):
            picture, start_s = both[:channels], scan * self.scan_s
            whole = WholeScan(picture, self.region, self.kind, start_s + self.scan_s)
            running = None if scan < LEARNT else judge.begin(self.region, self.kind, start_s, channels=channels)
            if running is not None:
                yield self._outcome(name, scan, *_alarms(running, picture))
            before, doubted = doubted, None
            is_good = running is None or running.alarm is None
            if not is_good:
                doubted = whole
            if is_good or (before is not None and judge.agree(before, whole)):
                judge.learn(picture, self.region, self.kind, whole.at_s, again=not is_good)
                doubted = None

    def _classified(self) -> list[ForeignOutcome]:
        judge = TipJudge(LEARNT)
        found: list[ForeignOutcome] = []
        for scan, (trace, retrace) in enumerate(self.pictures[: self.event_scan + 2]):
            opinion = judge.judge(trace, retrace, self.region).opinion
            is_bad, is_unclear = opinion is Opinion.BAD, opinion in (Opinion.BAD, Opinion.UNCLEAR)
            if scan < LEARNT:
                continue
            if scan > self.event_scan:
                if is_bad:
                    found[-1] = self._outcome("classifier", scan - 1, 0, 0)
                continue
            found.append(self._outcome("classifier", scan, 0 if is_unclear else None, 0 if is_bad else None))
        return found

    def _outcome(self, judge: str, scan: int, look: int | None, stop: int | None) -> ForeignOutcome:
        truth, is_event = self.truth, scan == self.event_scan
        row = int(truth["event_row"]) if is_event else 0
        condition = truth["event"] if is_event else "nothing"
        if not is_event and truth["benign"] != "none" and scan >= truth["benign_scan"]:
            condition = truth["benign"]
        is_visible = is_event and truth["event_visible_levelled"] >= LEAST_VISIBLE
        has_rows = judge == "classifier" or row + WITHIN < len(self.pictures[0][0])
        return ForeignOutcome(
            self.name, truth["kind"], judge, scan, condition, is_event, row, is_visible and has_rows, look, stop
        )


def _alarms(running: ScanJudge, picture: Sequence[Array]) -> tuple[int | None, int | None]:
    look = None
    for row, line in enumerate(zip(*picture, strict=True)):
        alarm = running.add(row, line)
        if alarm is not None:
            look = row if look is None else look
            if alarm.level is AlarmLevel.STOP:
                return look, row
    return look, None


def judged_night(path: Path, judge: str, end_s: float) -> list[ForeignOutcome]:
    """Return the outcomes of a judge of one night; none after a time on the system's clock."""
    return ForeignNight(path).judged(judge) if time.time() < end_s else []


def chosen(folder: Path, judge: str, others: int) -> list[Path]:
    """Return the nights for a judge: all with an event after the scans to learn from, and some of the others."""
    paths = sorted(folder.glob("*.npz"))
    scans = [json.loads(path.with_suffix(".truth.json").read_text(encoding="utf-8"))["event_scan"] for path in paths]
    quiet = [path for path, scan in zip(paths, scans, strict=True) if scan is None]
    kept = quiet if judge == "classifier" else quiet[:others]
    return [p for p, scan in zip(paths, scans, strict=True) if (p in kept if scan is None else scan >= LEARNT)]


def table(found: Sequence[ForeignOutcome]) -> Iterator[str]:
    """Return lines of a table: each judge's good scans by condition, and its events."""
    for judge in sorted({one.judge for one in found}, key=JUDGES.index):
        of_judge = [one for one in found if one.judge == judge]
        good = [one for one in of_judge if not one.is_event]
        events = [one for one in of_judge if one.is_event]
        # a scan of an event is good until the event
        early = [one for one in events if judge != "classifier" and one.stop_row is not None and one.stop_row < one.row]
        stopped = [one for one in good if one.stop_row is not None]
        share = _share(len(stopped) + len(early), len(good) + (judge != "classifier") * len(events))
        yield f"{judge}, {len({one.night for one in of_judge})} nights: good scans {_stopped(judge)}: {share}"
        for condition in sorted({one.condition for one in good}):
            of = [one for one in good if one.condition == condition]
            looked = sum(one.look_row is not None for one in of)
            yield f"    {condition:12} {sum(one in stopped for one in of):3} of {len(of)}; {looked} {_looked(judge)}"
        counted = [one for one in events if one.is_counted and one not in early]
        for condition in sorted({one.condition for one in counted}):
            of = [one for one in counted if one.condition == condition]
            share, looked = _share(_in_time(of, "stop_row"), len(of)), _in_time(of, "look_row")
            yield f"  {condition:14} {share} {_stopped(judge)}; {looked} {_looked(judge)}"


def _stopped(judge: str) -> str:
    return "called bad" if judge == "classifier" else "stopped"


def _looked(judge: str) -> str:
    return "unclear or bad" if judge == "classifier" else "looked at"


def _in_time(of: Sequence[ForeignOutcome], level: str) -> int:
    rows = [(one, getattr(one, level)) for one in of]
    return sum(
        row is not None and (one.judge == "classifier" or one.row <= row <= one.row + WITHIN) for one, row in rows
    )


def _share(some: int, of: int) -> str:
    return f"{some} of {of} ({some / max(1, of):.1%})"


def main(arguments: Sequence[str]) -> int:
    asked = argparse.ArgumentParser(prog="benchmarks.line_watch.foreign")
    asked.add_argument("folder", type=Path)
    asked.add_argument("--others", type=int, default=1000, help="nights without an event for LineWatch")
    asked.add_argument("--minutes", type=float, default=600.0, help="begin no night after that long")
    asked.add_argument("--judges", nargs="+", choices=JUDGES, default=JUDGES)
    asked.add_argument("--processes", type=int, default=1)
    given = asked.parse_args(arguments)
    began_s = time.time()
    tasks = [(path, judge) for judge in given.judges for path in chosen(given.folder, judge, given.others)]
    found: list[ForeignOutcome] = []
    KEPT.parent.mkdir(exist_ok=True)
    with ProcessPoolExecutor(given.processes) as pool, KEPT.open("w", encoding="utf-8") as kept:
        for outcomes in pool.map(judged_night, *zip(*tasks, strict=True), repeat(began_s + 60.0 * given.minutes)):
            found += outcomes
            kept.writelines(json.dumps(asdict(one)) + "\n" for one in outcomes)
            kept.flush()
    print(*table(found), sep="\n")
    load = ", ".join(f"{one:.1f}" for one in os.getloadavg())
    print(f"{given.folder}, in {time.time() - began_s:.0f} s of {given.processes} processes; load {load}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
