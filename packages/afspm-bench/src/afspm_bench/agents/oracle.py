"""`Oracle`: an agent that measures, but answers from the truth. A result below 100 % shows a fault of the bench."""

from __future__ import annotations

import json

import numpy as np

from afspm.basics import PlainMapping
from afspm.components import Opinion, TipJudge
from afspm.model import Region
from afspm_bench import analysis
from afspm_bench.agents.script import XY, Script
from afspm_bench.evidence import true_heights
from afspm_bench.families import find
from afspm_bench.session import TrialSession


class Oracle(Script):
    """Agent that answers from the truth, and cites measurements of its own."""

    def solve(self, session: TrialSession) -> None:
        self.world = session.true_world()
        super().solve(session)

    def settings(self, name: str) -> PlainMapping:
        """Return the settings of one part of the true world, such as "surface"."""
        assert self.session.truth_folder is not None
        first = (self.session.truth_folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0]
        found: PlainMapping = json.loads(first)["settings"][name]
        return found

    def drift_m(self, at_s: float | None = None) -> tuple[float, float]:
        x, y = self.world.drift_m(self.session.clock.now_s() if at_s is None else at_s)[:2]
        return float(x), float(y)

    # --- find ---

    def true_field(self) -> list[analysis.Peak]:
        self.scan((0.0, 0.0), self.given["size_m"], 256)
        with self.session.thinking():
            return find.true_peaks(true_heights(self.world, find.FIELD, 501))

    def find_highest(self) -> None:
        listed = [
            {"x": p.xy_m[0], "y": p.xy_m[1], "height": p.height_m} for p in self.true_field()[: self.given["count"]]
        ]
        self.report("done", {"particles": listed})

    def find_flat(self) -> None:
        self.scan((0.0, 0.0), self.given["size_m"], 128)
        xy, _ = analysis.flattest(true_heights(self.world, find.FIELD, 501), find.FIELD, self.given["square_m"] + 20e-9)
        self.report("done", {"x": xy[0], "y": xy[1]})

    def find_isolated(self) -> None:
        best = find.alone(self.true_field())[0]
        self.report("done", {"x": best.xy_m[0], "y": best.xy_m[1]})

    def find_again(self) -> None:
        known = [tuple(one) for one in self.given["known"]]
        shift, _ = analysis.constellation_shift(known, self.true_field(), 5e-9)
        self.report("done", {"x": known[0][0] + shift[0], "y": known[0][1] + shift[1]})

    # --- measure ---

    def measure_lattice(self) -> None:
        self.scan((0.0, 0.0), 8e-9, 256)
        constant = self.settings("surface")["constant_m"]
        self.report("done", {"constant": self.number(constant, 0.005 * constant)})

    def measure_step(self) -> None:
        self.scan((0.0, 0.0), self.given["size_m"], 192)
        height = self.settings("surface")["step_m"]
        self.report("done", {"height": self.number(height, 0.01 * height)})

    def measure_gap(self) -> None:
        metal = []
        for number, (x, y) in enumerate(self.given["points"], 1):
            self.spectrum((x, y))
            if self.world.sample.relief(np.array([[x]]), np.array([[y]]), 0.0, 0.0).material[0, 0] > 0.5:
                metal.append(number)
        width = self.settings("iv")["gap_ev"]
        self.report("done", {"metal": metal, "gap": self.number(width, 0.05 * width)})

    def measure_drift(self) -> None:
        self.scan((0.0, 0.0), self.given["size_m"], 128)
        self.sleep_until(40.0)
        self.scan((0.0, 0.0), self.given["size_m"], 128)
        vx, vy, _ = self.settings("drift")["velocity_m_per_s"]
        error = 0.05 * float(np.hypot(vx, vy))
        self.report("done", {"vx": self.number(vx, error), "vy": self.number(vy, error)})

    # --- night ---

    def night_place(self) -> None:
        given, first = self.given, self.drift_m()
        for number in range(given["scans"]):
            self.sleep_until(number * given["every_min"])
            now = self.drift_m()
            self.scan((now[0] - first[0], now[1] - first[1]), given["size_m"], given["pixels"])
        self.report("done")

    def night_follow(self) -> None:
        target = self.true_top(self.given["about"])
        for number in range(self.given["curves"]):
            self.sleep_until(number * self.given["every_min"])
            now = self.drift_m()
            self.spectrum((target[0] + now[0], target[1] + now[1]), self.given["kind"])
        self.report("done")

    def true_top(self, about: XY) -> XY:
        region = Region((about[0], about[1]), (200e-9, 200e-9))
        return analysis.peaks(true_heights(self.world, region, 101), region, least_m=50e-9, apart_m=24e-9)[0].xy_m

    def night_calm(self) -> None:
        given = self.given
        for _ in range(2):  # the report must rest on scans, even if the truth is known
            self.scan(given["center"], given["size_m"], given["pixels"])
        while self.rate_m_s() > 0.95 * given["below_m_s"]:
            self.sleep_until(self.session.elapsed_minutes + 5.0)
        self.scan(given["center"], given["size_m"], given["pixels"])
        self.report("done")

    def rate_m_s(self) -> float:
        now_s = self.session.clock.now_s()
        return float(np.hypot(*np.subtract(self.drift_m(now_s), self.drift_m(now_s - 10.0)))) / 10.0

    # --- trouble ---

    def judged(self, judge: TipJudge) -> Opinion:
        self.scan(self.given["center"], self.given["size_m"], self.given["pixels"])
        assert self.session.truth_folder is not None
        lines = (self.session.truth_folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()
        last = [one for line in lines if (one := json.loads(line))["event"] == "scan"][-1]
        return Opinion.BAD if any(tip["flaws"] for tip in last["scan"]["tips"]) else Opinion.GOOD
