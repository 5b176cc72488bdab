"""Nights with a coarse motor, with kills and faults: `python -m tests.simulation.mover_nights 200`.

A component goes from site to site as it should, and another one sends requests at random: moves, approaches, scans. The
scheduler, the translator and the components are real, and die at random. A person drives the motor back to the sample
by hand, in MANUAL or while the controller is not reached. In the truth of the simulation, a move strikes a tip that is
at the sample, or too near for a lateral step.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import random
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from afspm import Component, Region
from afspm.basics.errors import ControlLost, NoResponse, Refused
from afspm.model import ControlMode, Problem, names
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.safety.limits import ForbiddenState
from afspm.scheduler.safety.movers import PROVED_AFTER_S, Mover, MoverSettings
from afspm.testing import Bench

Mutant = Literal["", "retraction"]
"""A part of the interlock that is left out, so that a night must see it."""
LASTS_S = 600.0
AWAY, RIGHT, UP = "x-coarse-away", "x-coarse-right", "x-coarse-up"
_STEPS = 20
_MOVES = (AWAY, RIGHT, UP)
_ACTS = (*_MOVES, *_MOVES, names.APPROACH, names.APPROACH, names.ENGAGE, names.RETRACT, names.RETRACT)
_CONTINUES = tuple(range(45, int(LASTS_S), 40))  # a person lets the run continue
_LEFT_M = 0.5e-6  # left by a person who drives the motor back: less than a lateral step runs out
_REFUSALS = (Refused, ControlLost, NoResponse)


class Sites(Component):
    """A component that scans site after site, as a user writes it."""

    def run(self) -> None:
        site = int(self.memory.get("site", 0))
        while True:
            with suppress(*_REFUSALS), self.scope.control(timeout_s=600.0):
                if self.memory.get("at", 0) != site:
                    self.scope.withdraw(*[AWAY] * 5, timeout_s=600.0)
                    self.scope.wait_until(lambda: False, timeout_s=15.0)  # time for a person's hand
                    self.scope.action(RIGHT, timeout_s=600.0)
                    self.scope.approach(timeout_s=600.0)
                    self.memory["at"] = site
                self.scope.scan(Region((0, 0), (100e-9, 100e-9)), shape=(8, 8), key=f"site-{site}", timeout_s=600.0)
                site += 1
                self.memory["site"] = site
            self.scope.wait_until(lambda: False, timeout_s=5.0)


class Careless(Component):
    """A component that sends any request at any time."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def run(self) -> None:
        lives = self.memory["lives"] = int(self.memory.get("lives", 0)) + 1
        draw = random.Random(f"{self.seed} {lives}")
        while True:
            with suppress(*_REFUSALS), self.scope.control(timeout_s=60.0):
                for _ in range(draw.randrange(1, 12)):
                    with suppress(Refused):
                        if draw.random() < 0.2:
                            self.scope.scan(shape=(8, 8), timeout_s=30.0)
                        else:
                            self.scope.action(draw.choice(_ACTS), timeout_s=30.0)
            self.scope.wait_until(lambda: False, timeout_s=draw.uniform(0.0, 30.0))


@dataclass(frozen=True)
class MoverNight:
    """What became of a night.

    Attributes:
        struck: moves that struck the tip.
        crashes: crashes of the tip.
        in_air: scans that began without a tip at the sample, or within a second of its landing.
        moves: moves that were carried out.
        scans: scans that were taken.
    """

    struck: int
    crashes: int
    in_air: int
    moves: int
    scans: int


def limits_without(mutant: Mutant) -> ExperimentLimits:
    """Return the limits of a night."""
    total = 1e6
    movers = {
        AWAY: Mover("away", total, _STEPS),
        **{one: Mover("lateral", total, _STEPS) for one in (RIGHT, UP)},
    }
    rules = [f"changes({one}) and {names.ENGAGED}" for one in _MOVES]
    forbid = {rule: ForbiddenState(rule) for rule in rules}
    retraction = 0 if mutant == "retraction" else 60
    return ExperimentLimits(
        forbid=forbid, movers=MoverSettings(movers, retraction, names.APPROACH, undeclared=("x-coarse-down",))
    )


def faults(seed: int) -> list[dict[str, Any]]:
    """Return the faults of the controller in a night."""
    draw = random.Random(f"faults {seed}")
    kinds = ("no-reply", "error", "restart", "false-landing", "withdrawn", "stopped", "scan-refused")
    return [
        {"kind": draw.choice(kinds), "at_s": draw.uniform(1.0, LASTS_S), "duration_s": draw.uniform(0.2, 0.9)}
        for _ in range(draw.randrange(12))
    ]


def panel(seed: int) -> list[dict[str, Any]]:
    """Return the acts of a person at the panel, who brings the tip back some time after each."""
    draw = random.Random(f"panel {seed}")
    acts = [(draw.uniform(1.0, LASTS_S), draw.choice((names.RETRACT, names.ENGAGE))) for _ in range(draw.randrange(3))]
    back = [
        (at_s + wait_s, names.APPROACH) for at_s in range(20, int(LASTS_S), 40) for wait_s in (draw.uniform(0, 20),)
    ]
    return [{"at_s": at_s, "action": action} for at_s, action in (*acts, *(back if acts else ()))]


def hands(seed: int) -> list[tuple[float, float, bool]]:
    """Return when a person drives the motor back: the begin and duration of MANUAL (True) or of a lost contact."""
    draw = random.Random(f"hands {seed}")
    count = draw.randrange(len(_CONTINUES))
    return [
        (at_s + draw.uniform(2.0, 25.0), draw.uniform(5.0, 9.0), draw.random() < 0.5) for at_s in _CONTINUES[:count]
    ]


def drives_back(bench: Bench) -> None:
    """Let a person bring a withdrawn tip near the sample by the coarse motor, which no controller shows."""
    controller = bench._microscope._simulator._controller
    assert controller is not None
    if not controller.instrument.engaged:
        controller.instrument.coarse_m = min(controller.instrument.coarse_m, _LEFT_M)
        controller._keep()


def night(seed: int, folder: Path, mutant: Mutant = "", lasts_s: float = LASTS_S) -> MoverNight:
    """Return what became of the night of a seed, or of its beginning."""
    draw = random.Random(seed)
    microscope = {
        "seed": seed,
        "feedback": {"mode": "current", "setpoint": 100e-12},
        "scanner": "stm-4k" if draw.random() < 0.5 else None,
        "coarse_steps": _STEPS,
        "faults": [*faults(seed), *(_lost(at_s, for_s) for at_s, for_s, is_manual in hands(seed) if not is_manual)],
        "panel": panel(seed),
    }
    bench = Bench(
        Careless(seed),
        others={"sites": Sites()},
        microscope=microscope,
        limits=limits_without(mutant),
        folder=folder,
        seed=seed,
        dies_in_call=draw.choice((0.0, 0.002)),
    )
    for _ in range(draw.randrange(8)):
        bench.at(draw.uniform(1.0, LASTS_S), bench.kill, draw.choice(("", "sites", "scheduler", "translator")))
    for at_s, for_s, is_manual in hands(seed):  # tip T1
        if is_manual:
            bench.at(at_s, bench.set_mode, ControlMode.MANUAL)
            bench.at(at_s + for_s, bench.set_mode, ControlMode.AUTOMATED)
        bench.at(at_s + 4.0, drives_back, bench)
    for at_s in _CONTINUES:
        bench.at(at_s, bench.set_mode, ControlMode.AUTOMATED)
        bench.at(at_s + 1, bench.clear, Problem.DEVICE_MALFUNCTION)
    try:
        bench.run(until=lasts_s)
    finally:
        bench.close()
    return judged(folder)


def _lost(at_s: float, for_s: float) -> dict[str, Any]:
    return {"kind": "restart", "at_s": at_s, "duration_s": for_s}


def judged(folder: Path) -> MoverNight:
    """Judge a night by the ground truth of the simulation."""
    (file,) = folder.rglob("truth.jsonl")
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    seen = Counter(line["event"] for line in lines)
    last: dict[str, Any] = next((line for line in reversed(lines) if line["event"] == "ledger"), {})
    struck, crashes = last.get("stage_moves", 0), last.get("crashes", 0)
    return MoverNight(struck, crashes, _in_air(lines), seen["coarse"], seen["scan"])


def _in_air(lines: list[dict[str, Any]]) -> int:
    found, moved_s, away_s, landed = 0, -math.inf, -math.inf, {"time_s": -math.inf, "seems": False}
    for line in sorted(lines, key=lambda line: float(line["time_s"])):
        match line["event"]:
            case "coarse":
                moved_s = line["time_s"]
            case "landed":
                landed = line
            case "conditions" if not line["engaged"]:
                away_s = line["time_s"]
            case "conditions" if landed["time_s"] < away_s:  # a person has engaged without the motor, within reach
                landed = {"time_s": line["time_s"], "seems": False}
            case "scan starts" if moved_s > -math.inf:
                is_proved = moved_s < landed["time_s"] <= line["time_s"] - PROVED_AFTER_S and not landed["seems"]
                found += not is_proved
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("nights", type=int)
    parser.add_argument("--without", default="", choices=["retraction"], help="leave a part out")
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    found = {}
    for seed in range(given.first, given.first + given.nights):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            found[seed] = night(seed, Path(folder), given.without)
    wrong = {seed: one for seed, one in found.items() if one.struck or one.crashes or one.in_air}
    moves, scans = (sum(getattr(one, name) for one in found.values()) for name in ("moves", "scans"))
    sys.stdout.write(f"{len(found)} nights, {moves} moves, {scans} scans; wrong: {wrong}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
