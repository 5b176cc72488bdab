"""Many simulated nights: `python -m tests.simulation.long_run --hours 10000 --seed 1`.

A failing seed is printed with the violated invariant and the last steps; `--seed S --nights 1` replays it exactly.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from afspm.basics.clock import ExperimentClock
from tests.simulation.invariants import InvariantViolated
from tests.simulation.night import Night, plan


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 1 if an invariant was violated."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.long_run", description=__doc__)
    parser.add_argument("--hours", type=float, default=3000.0, help="experiment hours in all")
    parser.add_argument("--nights", type=int, help="instead: how many nights")
    parser.add_argument("--seed", type=int, default=1, help="of the first night; each further one has the next")
    given = parser.parse_args(arguments)
    clock = ExperimentClock.real()
    began_s, hours, steps, scans, seed = clock.monotonic_s(), 0.0, 0, 0, given.seed
    while (seed - given.seed < given.nights) if given.nights is not None else hours < given.hours:
        try:
            outcome = Night(plan(seed)).run()
        except InvariantViolated as error:
            sys.stderr.write(f"{error}\n\nreplay it: python -m tests.simulation.long_run --seed {seed} --nights 1\n")
            return 1
        hours, steps, scans, seed = hours + outcome.hours, steps + outcome.steps, scans + outcome.scans, seed + 1
    took_s = clock.monotonic_s() - began_s
    sys.stdout.write(
        f"{seed - given.seed} nights, {hours:.0f} experiment hours, {scans} scans, {steps} steps of the scheduler"
        f" in {took_s:.1f} s: every invariant held\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
