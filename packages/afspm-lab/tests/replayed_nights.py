"""`make replay-nights NIGHTS=200 SEED=0`: nights with kills, replayed without a change.

Each seed gives a night of components with kills at random calls, and a night of the scheduler with all faults of
`night.bad_night`. Prints a line for each night that differs, and the totals; exits with 1 if any does. Two hundred
seeds take about an hour of one core.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import what_if_lab as lab
from recorded_night import recorded

import afspm
from afspm.testing import Bench
from afspm_lab.what_if.scheduler_replay import replay


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def components(seed: int) -> tuple[int, int, float, float]:
    """Return lives, outputs, experiment seconds and real seconds of the replays of a night; outputs < 0: it differs."""
    with tempfile.TemporaryDirectory() as folder:
        others = {"judge": lab.Judge(), "alarmist": lab.Alarmist()}

        def kills(bench: Bench) -> None:
            for when in (9 + seed % 7, 21 + seed % 5):
                bench.at(f"{when} min", bench.kill, "judge")

        bench = lab.record(Path(folder), others, kills, seed=seed, dies_in_call=0.01 * (seed % 6))
        result = afspm.what_if(folder)
        lines = (line for log in Path(folder, "requests").iterdir() for line in log.read_text().splitlines())
        lives = sum(line.startswith('["life"') for line in lines)
        outputs = sum(row.same for row in result.table())
        real_s = sum(one.real_s for one in result.components.values())
        if result.differs:
            say(f"seed {seed}: {result.first}")
        return lives, -outputs if result.differs else outputs, bench.now_s, real_s


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nights", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this real time")
    given = parser.parse_args()
    began_s, differ = time.perf_counter(), 0
    nights = lives = outputs = steps = 0
    recorded_s = real_s = 0.0
    for seed in range(given.seed, given.seed + given.nights):
        if time.perf_counter() - began_s > given.seconds:
            break
        of_night = components(seed)
        scheduler = replay(recorded(seed).kept)
        if scheduler.first_step is not None:
            say(f"seed {seed}: scheduler, step {scheduler.first_step}: {scheduler.first}")
        differ += (of_night[1] < 0) + (scheduler.first_step is not None)
        nights += 2
        lives += of_night[0]
        outputs += abs(of_night[1]) + scheduler.same
        steps += scheduler.steps
        recorded_s += of_night[2] + scheduler.recorded_s
        real_s += of_night[3] + scheduler.real_s
    say(
        f"{nights} nights, {lives} lives of components, {steps} steps of schedulers, {outputs} equal outputs; "
        f"{differ} nights differ; replayed {recorded_s / max(real_s, 1e-9):.0f} times as fast as they passed"
    )
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
