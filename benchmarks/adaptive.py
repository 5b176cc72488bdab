"""`python -m benchmarks.adaptive`: seconds of an adaptive map and of a nested grid to the same error, on unseen maps.

Both have the same Gaussian process, which also learns the drift; only the choice of positions differs. The error is
the true rms error of the map, in standard deviations of the map. Prints a table, writes build/bench-adaptive.json, and
returns 1 if a target was missed. Nothing here starts a process: time is counted from moves, settling and curves.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

# before numpy starts its own threads
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from afspm.model import Region
from afspm.plugins.adaptive.refinement import AdaptiveMap, LatticeMap, NestedGrid
from afspm.simulation.property_map import PropertyMap, PropertyMapSettings
from benchmarks.rows import Row

RESULT = Path("build/bench-adaptive.json")
UNSEEN = 10_200
"""The first seed of the judged maps; the method was developed on maps with seeds below 100."""
MAPS = 8
"""Number of judged maps of each kind."""
REGION = Region((0.0, 0.0), (1e-6, 1e-6))
KINDS = {
    "smooth": PropertyMapSettings(kind="smooth", size_m=150e-9),
    "spotty": PropertyMapSettings(kind="spotty", size_m=110e-9, spacing_m=400e-9),
}
MOVES = {"fast": 5e-6, "slow": 10e-9}
"""Speeds in m/s: a move takes far less time than a curve, or several times as long."""
DRIFTS = {"off": (0.0, 0.0), "on": (15e-12, -10e-12)}
"""In m/s: a tenth of the region within an hour and a half."""
CURVE_S = 2.5
NOISE_EV = 0.01
GOAL = 0.1
MOST_OVER_TOLD = 1.3
MEDIANS = {"smooth": 0.95, "spotty": 0.7}
"""Targets of the median seconds to the nested grid's."""
WORST = {"off": 1.1, "on": 1.2}
"""Targets of the worst seconds to the nested grid's; until a drift is clear, a map lacks what it moves."""
MOST_BY_DRIFT = {"smooth": 1.2, "spotty": 1.4}
"""Targets of the seconds with drift to those without: a spot of 110 nm is blurred before its drift is clear."""
LEVELS = 4  # up to 65 x 65 positions
MOST = 1089
"""Measurements: as many as the 33 x 33 positions of the last lattice that a nested grid completes."""
SHORT = 120
"""Measurements of a map in which a drift would be invented: with more of them it is known better."""
AXIS_M = np.linspace(-0.5e-6, 0.5e-6, 37)
PLACES_M = np.stack([axis.ravel() for axis in np.meshgrid(AXIS_M, AXIS_M)], axis=1)


@dataclass(frozen=True)
class Case:
    """One map, and how it is measured."""

    kind: str
    moves: str
    drift: str
    seed: int


@dataclass(frozen=True)
class Course:
    """The error of a map over the seconds.

    Attributes:
        seconds, errors: at some moments; errors in standard deviations of the true map.
        expected: the error that the process itself expected at the end.
        measurements: (n, 4): x, y, value, time.
        velocity_m_s: velocity of the sample that the process found at last.
        followed: whether it followed a drift at any time.
        processor_s: processor time of suggestions and fits.
    """

    seconds: tuple[float, ...]
    errors: tuple[float, ...]
    expected: float
    measurements: np.ndarray
    velocity_m_s: tuple[float, float]
    followed: bool
    processor_s: float

    def until(self, error: float) -> float:
        """Return the seconds to an error, interpolated; infinite if it was not reached."""
        for place, reached in enumerate(self.errors):
            if reached <= error:
                if place == 0:
                    return self.seconds[0]
                before = self.errors[place - 1]
                part = math.log(before / error) / math.log(before / reached)
                return self.seconds[place - 1] + part * (self.seconds[place] - self.seconds[place - 1])
        return math.inf


def course(planner: type[LatticeMap], case: Case, goal: float = GOAL, most: int = MOST) -> Course:
    """Measure a map until the goal, or as often as allowed."""
    found = PropertyMap(KINDS[case.kind], case.seed)
    truth = found.at(*PLACES_M.T)
    spread = float(truth.std())
    planned = planner(REGION, "gap", levels=LEVELS)
    random = np.random.default_rng(case.seed)
    drift = np.asarray(DRIFTS[case.drift])
    at, now_s, first_s = np.array([-0.5e-6, -0.5e-6]), 0.0, 0.0
    seconds, errors, count, look, processor_s, followed = [], [], 0, 40, 0.0, False
    while count < most:
        began_s = time.process_time()
        if not (suggested := planned.suggest(1)):
            break
        processor_s += time.process_time() - began_s
        followed |= any(planned.parameters.velocity_m_s)
        to = np.array([suggested[0]["x"], suggested[0]["y"]])
        took_s = math.dist(at, to) / MOVES[case.moves] + CURVE_S
        now_s, at, count = now_s + took_s, to, count + 1
        first_s = first_s or now_s
        value = float(found.at(*(to - drift * (now_s - first_s)))) + NOISE_EV * random.standard_normal()
        planned.ingest([{**suggested[0], "gap": value, "time_s": now_s, "seconds": took_s}])
        if count >= look or count == most:
            look = math.ceil(1.1 * count)
            began_s = time.process_time()
            planned.fit()
            processor_s += time.process_time() - began_s
            seconds.append(now_s)
            errors.append(float(np.sqrt(np.mean((planned.map(PLACES_M) - truth) ** 2))) / spread)
            if errors[-1] <= goal:
                break
    velocity_m_s = planned.parameters.velocity_m_s
    return Course(
        tuple(seconds), tuple(errors), planned.expected_error() / spread, planned.measurements, velocity_m_s,
        followed or any(velocity_m_s), processor_s,
    )  # fmt: skip


@dataclass(frozen=True)
class Result:
    """One case: the seconds of both to the goal, and the expected part of the true error at the end."""

    case: Case
    adaptive: Course
    nested: Course

    @property
    def ratio(self) -> float:
        """Seconds of the adaptive map over the nested grid's; NaN if neither reached the goal.

        A nested grid that did not reach the goal counts with all its seconds: the true ratio is lower.
        """
        adaptive_s, nested_s = self.adaptive.until(GOAL), self.nested.until(GOAL)
        if math.isinf(nested_s):
            return adaptive_s / self.nested.seconds[-1] if math.isfinite(adaptive_s) else math.nan
        return adaptive_s / nested_s

    @property
    def both(self) -> tuple[Course, Course]:
        return self.adaptive, self.nested

    def line(self) -> str:
        both = f"{self.adaptive.until(GOAL):6.0f} s  {self.nested.until(GOAL):6.0f} s  {self.ratio:5.2f}"
        knows = f"{self.adaptive.expected:.3f} / {self.adaptive.errors[-1]:.3f}"
        case = self.case
        return f"{case.kind:7} {case.moves:5} drift {case.drift:4} {case.seed:6}  {both}  {knows}"


def judged(results: Sequence[Result]) -> Iterator[Row]:
    """Return the rows with a target."""
    for kind, moves, drift in itertools.product(KINDS, MOVES, DRIFTS):
        those = [r for r in results if (r.case.kind, r.case.moves, r.case.drift) == (kind, moves, drift)]
        ratios = [r.ratio for r in those if not math.isnan(r.ratio)]
        name = f"{kind} maps, {moves} moves, drift {drift}"
        never = sum(math.isnan(r.ratio) for r in those)
        if never:
            print(f"{name}: not counted are {never} maps that neither brought to the goal")
        if ratios:
            yield Row(f"{name}: worst seconds to the nested grid's", "1", max(ratios), None, WORST[drift])
            yield Row(f"{name}: median of these", "1", statistics.median(ratios), None, MEDIANS[kind])
    for drift in DRIFTS:
        over = [r.adaptive.errors[-1] / r.adaptive.expected > MOST_OVER_TOLD for r in results if r.case.drift == drift]
        if over:
            name = f"drift {drift}: share of maps with more than {MOST_OVER_TOLD} times the expected error"
            yield Row(name, "1", sum(over) / len(over), None, 0.1)
    false = [r.adaptive.followed for r in results if r.case.drift == "off"]
    if false:
        yield Row("drift off: share of adaptive maps that followed a drift", "1", sum(false) / len(false), None, 0.0)
    velocity_m_s = DRIFTS["on"]
    beside = [
        math.dist(one.velocity_m_s, velocity_m_s) / math.hypot(*velocity_m_s)
        for r in results
        if (r.case.drift, r.case.moves) == ("on", "slow")  # with fast moves a map moves by a few nm in all
        for one in r.both
    ]
    if beside:
        name = "slow moves, drift on: median error of the drift, relative to its length"
        yield Row(name, "1", statistics.median(beside), None, 0.3)
    seconds = {r.case: min(r.adaptive.until(GOAL), r.adaptive.seconds[-1]) for r in results}
    for kind, moves in itertools.product(KINDS, MOVES):
        pairs = [
            (took_s, seconds[still])
            for case, took_s in seconds.items()
            if (case.kind, case.moves, case.drift) == (kind, moves, "on")
            and (still := replace(case, drift="off")) in seconds
        ]
        if pairs:
            name = f"{kind} maps, {moves} moves: seconds with drift over those without, median"
            yield Row(name, "1", statistics.median(on / off for on, off in pairs), None, MOST_BY_DRIFT[kind])


def invented(seeds: Sequence[int]) -> int:
    """Print how many maps of still samples follow a drift at any time; return 1 if one does."""
    wrong = 0
    for kind in KINDS:
        cases = [Case(kind, "slow", "off", seed) for seed in seeds]
        found = [case.seed for case in cases if course(AdaptiveMap, case, 0.0, SHORT).followed]
        print(f"{kind} maps, still, {SHORT} curves: {len(found)} of {len(cases)} followed a drift", *found, flush=True)
        wrong += len(found)
    return int(wrong > 0)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.adaptive", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two maps in place of sixteen")
    parser.add_argument("--seed", type=int, default=UNSEEN, help="of the first map")
    parser.add_argument("--maps", type=int, help=f"of each kind, by default {MAPS}")
    parser.add_argument("--within", type=float, help="begin no further case after that many seconds of processor time")
    parser.add_argument("--figure", type=Path, help="draw one spotty map, measured both ways, into this file")
    parser.add_argument("--still", type=int, metavar="N", help=f"map N still samples of each kind with {SHORT} curves")
    asked = parser.parse_args(arguments)
    if asked.still:
        return invented(range(asked.seed, asked.seed + asked.still))
    if asked.figure:
        from benchmarks.adaptive_figure import draw

        draw(asked.figure, asked.seed)
        return 0
    count = asked.maps or (1 if asked.quick else MAPS)
    results = []
    # map by map, so that a run that ends early has judged all conditions alike
    for seed, kind, moves, drift in itertools.product(range(asked.seed, asked.seed + count), KINDS, MOVES, DRIFTS):
        if asked.within and time.process_time() > asked.within:
            print(f"{asked.within:.0f} s of processor time have passed")
            break
        case = Case(kind, moves, drift, seed)
        results.append(Result(case, course(AdaptiveMap, case), course(NestedGrid, case)))
        print(results[-1].line(), flush=True)
    rows = list(judged(results))
    for row in rows:
        print(f"{row.name:78} {row.ours:6.2f}  <= {row.target:g}{'' if row.met else '  MISSED'}")
    for kind, moves in itertools.product(KINDS, MOVES):
        ratios = [r.ratio for r in results if (r.case.kind, r.case.moves) == (kind, moves) and not math.isnan(r.ratio)]
        if ratios:
            between = f"median {statistics.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}"
            print(f"{kind} maps, {moves} moves: seconds relative to the nested grid's: {between}")
    for drift in DRIFTS:
        over = [r.adaptive.errors[-1] / r.adaptive.expected for r in results if r.case.drift == drift]
        if over:
            print(f"drift {drift}: true error {min(over):.2f} to {max(over):.2f} times the expected error")
    for name, courses in zip(("adaptive maps", "grids"), zip(*(r.both for r in results), strict=True), strict=True):
        for drift in DRIFTS:
            of_drift = [one for r, one in zip(results, courses, strict=True) if r.case.drift == drift]
            print(f"drift {drift}: {sum(one.followed for one in of_drift)} of {len(of_drift)} {name} followed a drift")
        curves, took_s = sum(len(one.measurements) for one in courses), sum(one.processor_s for one in courses)
        print(f"{name}: {took_s:.0f} s of processor time for {curves} curves, {1e3 * took_s / curves:.1f} ms a curve")
    print(f"{len(results)} cases of {count} maps of each kind; load {os.getloadavg()[0]:.1f}")
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps([row.to_json() for row in rows], indent=1) + "\n", encoding="utf-8")
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
