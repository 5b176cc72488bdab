"""`python -m benchmarks.line_watch [--nights 1000] [--minutes 10] [--half unseen]`: judges `LineWatch` over nights.

With `--rooms 40` it judges scans of noisy rooms and changing samples instead, on surfaces that no setting was tried on:
see `benchmarks.line_watch.rooms`. Keeps the outcomes in build/line_watch_rooms.jsonl.

Prints false aborts, visible changes found in time, and scan time saved, relative to the time that an oracle would save
(it stops each scan at the row of the change). Keeps each night's outcome in build/line_watch.jsonl. Exits with 1 where
a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from itertools import islice, repeat
from pathlib import Path

from benchmarks.line_watch.nights import HALVES, ROWS, WITHIN, NightOutcome, judged_night
from benchmarks.line_watch.rooms import CONTRAST_KINDS, KINDS, ROOM_KINDS, SAMPLE_KINDS, JudgedScan, judged_room, table

KEPT = Path("build/line_watch.jsonl")
KEPT_ROOMS = Path("build/line_watch_rooms.jsonl")
MOST_FALSE, LEAST_SEEN, LEAST_SAVED = 1 / 50, 0.9, 0.6
MOST_CHANGED, LEAST_IN_ROOMS = 0.05, 0.85


def main(arguments: Sequence[str]) -> int:
    asked = argparse.ArgumentParser(prog="benchmarks.line_watch")
    asked.add_argument("--nights", type=int, default=1000)
    asked.add_argument("--first", type=int, default=0, help="seed of the first night")
    asked.add_argument("--minutes", type=float, default=10.0, help="begin no night after that long")
    asked.add_argument("--half", choices=HALVES, default="unseen")
    asked.add_argument("--processes", type=int, default=1)
    asked.add_argument("--rooms", type=int, default=0, help="judge as many rooms in place of nights")
    asked.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="of scans in the rooms")
    asked.add_argument("--without-retrace", action="store_true", help="judge the trace of the rooms alone")
    given = asked.parse_args(arguments)
    if given.rooms:
        rooms, channels = range(given.first, given.first + given.rooms), 1 if given.without_retrace else 2
        return judge_rooms(rooms, given.processes, channels, given.kinds)
    end_s, found = time.monotonic() + 60.0 * given.minutes, []
    KEPT.parent.mkdir(exist_ok=True)
    seeds = iter(range(given.first, given.first + given.nights))
    with ProcessPoolExecutor(given.processes) as pool, KEPT.open("w", encoding="utf-8") as kept:
        while (batch := list(islice(seeds, 4 * given.processes))) and time.monotonic() < end_s:
            for outcome in pool.map(judged_night, [given.half] * len(batch), batch):
                found.append(outcome)
                kept.write(json.dumps(asdict(outcome)) + "\n")
                kept.flush()
    return report(found)


def judge_rooms(seeds: Sequence[int], processes: int, channels: int, kinds: Sequence[str]) -> int:
    """Print the table of some rooms; return 1 where a target is missed."""
    found: list[JudgedScan] = []
    KEPT_ROOMS.parent.mkdir(exist_ok=True)
    with ProcessPoolExecutor(processes) as pool, KEPT_ROOMS.open("w", encoding="utf-8") as kept:
        for outcomes in pool.map(judged_room, repeat("kept"), seeds, repeat(channels), repeat(kinds)):
            found += outcomes
            kept.writelines(json.dumps(asdict(one)) + "\n" for one in outcomes)
    print(*table(found), sep="\n")
    stopped = [one for one in found if one.stop_row is not None]
    tips = [one for one in found if one.is_visible]
    is_met = (
        share(stopped, found, ROOM_KINDS) <= MOST_FALSE
        and share(stopped, found, (*SAMPLE_KINDS, *CONTRAST_KINDS)) <= MOST_CHANGED
        and sum(one.is_seen for one in tips) >= LEAST_IN_ROOMS * len(tips)
    )
    return 0 if is_met else 1


def share(some: Sequence[JudgedScan], of: Sequence[JudgedScan], kinds: Sequence[str]) -> float:
    """Return the share of some scans in all scans of these kinds."""
    return sum(one.kind in kinds for one in some) / max(1, sum(one.kind in kinds for one in of))


def report(found: Sequence[NightOutcome]) -> int:
    """Print the table of some nights; return 1 where a target is missed."""
    alarms = [(negative, row) for one in found for negative, row in one.false_alarms]
    aborted = [row for _, row in alarms if row is not None]
    early = [one for one in found if one.alarm_row is not None and one.alarm_row < one.changed_row]
    visible = [one for one in found if one.is_visible and one not in early]
    seen = [one for one in visible if one.alarm_row is not None and one.alarm_row <= one.changed_row + WITHIN]
    good = len(alarms) + len(found)
    share = (len(aborted) + len(early)) / good
    print(f"{len(found)} nights, {good} good scans (the last of each night until its change)")
    print(f"false aborts: {len(aborted) + len(early)} of {good}, {share:.1%}, at most {MOST_FALSE:.0%}")
    counts = Counter(negative for negative, _ in alarms)
    for negative, count in sorted(counts.items()):
        print(f"    planted {negative}: {sum(1 for n, row in alarms if n == negative and row is not None)} of {count}")
    print(f"visible changes seen within {WITHIN} rows: {len(seen)} of {len(visible)}, at least {LEAST_SEEN:.0%}")
    for key in sorted({(one.surface, one.flaw) for one in visible}):
        of = [one for one in visible if (one.surface, one.flaw) == key]
        print(f"    {' '.join(key)}: {sum(one in seen for one in of)} of {len(of)}")
    delays = sorted(one.alarm_row - one.changed_row for one in seen if one.alarm_row is not None)
    print(f"median delay: {delays[len(delays) // 2] if delays else '-'} rows")
    unseen = [one for one in found if not one.is_visible and one not in early]
    print(f"changes that are not visible: {sum(one.alarm_row is not None for one in unseen)} of {len(unseen)} seen")
    oracle_s = sum((ROWS - one.changed_row) * one.line_s for one in visible)
    saved_s = sum((ROWS - one.alarm_row) * one.line_s for one in visible if one.alarm_row is not None)
    wasted_s = sum(row * one.line_s for one in found for _, row in one.false_alarms if row is not None)
    wasted_s += sum((one.alarm_row or 0) * one.line_s for one in early)
    saved = (saved_s - wasted_s) / oracle_s if oracle_s else 0.0
    print(f"scan time saved: {saved:.0%} of the oracle's {oracle_s / 60:.0f} min, at least {LEAST_SAVED:.0%}")
    is_met = share <= MOST_FALSE and len(seen) >= LEAST_SEEN * len(visible) and saved >= LEAST_SAVED
    return 0 if is_met else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
