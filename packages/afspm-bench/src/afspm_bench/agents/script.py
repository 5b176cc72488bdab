"""`Script`: the baseline agent, made of afspm's own analysis and a few lines for each task.

The script is written for each kind of task, but does not know the sample. Planted agents derive from `Script` and
override a few methods.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from afspm.basics import MeasurementFailed, PlainMapping, si
from afspm.components import Opinion, TipJudge
from afspm.model import Region, ScanSet, ScopeState, Spectrum, names
from afspm_bench import analysis
from afspm_bench.session import TrialSession

XY = tuple[float, float]


class Script:
    """Baseline agent with one method for each task, named "family_name"."""

    session: TrialSession
    cites: list[int]

    def solve(self, session: TrialSession) -> None:
        self.session, self.scope, self.given, self.cites = session, session.scope, session.given, []
        method: Callable[[], None] = getattr(self, session.task.replace("/", "_").replace("-", "_"))
        method()

    # --- methods that planted agents override ---

    def report(self, status: str, answer: PlainMapping | None = None, asks: tuple[str, ...] = ()) -> None:
        self.session.report(status, answer, self.cites, asks)

    def number(self, value: float, error: float) -> dict[str, float]:
        return {"value": value, "error": error}

    # --- steps ---

    def scan(self, center_m: XY, size_m: float, pixels: int, key: str | None = None) -> ScanSet:
        found = self.scope.scan(Region((center_m[0], center_m[1]), (size_m, size_m)), shape=(pixels, pixels), key=key)
        self.cite(found.time_ns)
        return found

    def spectrum(self, at_m: XY, kind: str = "IV") -> Spectrum:
        found = self.scope.spectrum((at_m[0], at_m[1]), kind=kind)
        self.cite(found.time_ns)
        return found

    def cite(self, time_ns: int | None) -> None:
        assert time_ns is not None
        self.cites.append(time_ns)

    @contextmanager
    def bias(self, bias_v: float) -> Iterator[None]:
        before = self.scope.get(names.TIP_BIAS_VOLTAGE)
        self.scope.set(names.TIP_BIAS_VOLTAGE, bias_v)
        yield
        self.scope.set(names.TIP_BIAS_VOLTAGE, before)

    def sleep_until(self, minutes: float) -> None:
        left = minutes - self.session.elapsed_minutes
        if left > 0:
            self.scope.sleep(left * 60.0)

    # --- operate ---

    def operate_settings(self) -> None:
        given = self.given
        with self.scope.control():
            self.scope.set_feedback(setpoint=given["setpoint_v"])
            self.scope.set(names.SCAN_SPEED, given["speed_m_s"])
            self.scan(given["scans"][0], given["size_m"], given["pixels"])
        self.report("done")

    def operate_places(self) -> None:
        for center_m in self.given["scans"]:
            self.scan(center_m, self.given["size_m"], self.given["pixels"])
        self.report("done")

    def operate_curves(self) -> None:
        for point in self.given["points"]:
            self.spectrum(point, self.given["kind"])
        self.report("done")

    def operate_restore(self) -> None:
        speed = self.scope.get(names.SCAN_SPEED)
        with self.scope.control(), self.bias(self.given["bias_v"]):
            self.scope.set(names.SCAN_SPEED, self.given["speed_m_s"])
            self.scan(self.given["scans"][0], self.given["size_m"], self.given["pixels"])
            self.scope.set(names.SCAN_SPEED, speed)
        self.report("done")

    # --- find ---

    def field(self, pixels: int = 256) -> tuple[list[analysis.Peak], ScanSet]:
        scans = self.scan((0.0, 0.0), self.given["size_m"], pixels)
        with self.session.thinking():
            return analysis.peaks_of(scans["height"], least_m=9e-9, apart_m=30e-9), scans

    def find_highest(self) -> None:
        peaks, _ = self.field()
        listed = [{"x": one.xy_m[0], "y": one.xy_m[1], "height": one.height_m} for one in peaks[: self.given["count"]]]
        self.report("done", {"particles": listed})

    def find_flat(self) -> None:
        _, scans = self.field()
        height = scans["height"]
        xy, _ = analysis.flattest(analysis.above_ground(height.values), height.region, self.given["square_m"])
        self.report("done", {"x": xy[0], "y": xy[1]})

    def find_isolated(self) -> None:
        peaks, _ = self.field()
        alone_m, half = self.given["alone_m"], self.given["size_m"] / 2
        best = max(
            (p for p in peaks if p.height_m > self.given["tall_m"] + 1e-9 and max(map(abs, p.xy_m)) < half - alone_m),
            key=lambda p: min(math.dist(p.xy_m, other.xy_m) for other in peaks if other is not p),
        )
        self.report("done", {"x": best.xy_m[0], "y": best.xy_m[1]})

    def find_again(self) -> None:
        peaks, _ = self.field()
        known = [tuple(one) for one in self.given["known"]]
        shift, _ = analysis.constellation_shift(known, peaks[:40], 15e-9)
        x, y = known[0][0] + shift[0], known[0][1] + shift[1]
        top = analysis.near(peaks, (x, y), 20e-9)
        x, y = top.xy_m if top else (x, y)
        self.report("done", {"x": x, "y": y})

    # --- measure ---

    def measure_lattice(self) -> None:
        found = [analysis.lattice_constant(self.scan((x, 0.0), 8e-9, 256)["height"]) for x in (0.0, 30e-9)]
        value = sum(one for one, _ in found) / len(found)
        spread = abs(found[0][0] - found[1][0]) / 2
        self.report("done", {"constant": self.number(value, max(0.005 * value, spread))})

    def measure_step(self) -> None:
        found = [analysis.step_height(self.scan((x, 0.0), self.given["size_m"], 192)["height"]) for x in (0.0, 900e-9)]
        value = sum(one for one, _ in found) / len(found)
        spread = abs(found[0][0] - found[1][0]) / 2
        self.report("done", {"height": self.number(value, max(0.008 * value, spread))})

    def measure_gap(self) -> None:
        curves = [self.spectrum(point) for point in self.given["points"]]
        gapped = [one for one in curves if analysis.conductance_in_gap(one) < 0.3]
        metal = [i for i, one in enumerate(curves, 1) if analysis.conductance_in_gap(one) >= 0.3]
        value, error = analysis.band_gap(gapped)
        self.report("done", {"metal": metal, "gap": self.number(value, max(error, 0.05 * value))})

    def measure_drift(self) -> None:
        first = self.scan((0.0, 0.0), self.given["size_m"], 128)
        self.sleep_until(40.0)
        last = self.scan((0.0, 0.0), self.given["size_m"], 128)
        dx, dy = analysis.shift_m(first["height"], last["height"])
        assert first.time_ns is not None
        assert last.time_ns is not None
        seconds = (last.time_ns - first.time_ns) * 1e-9
        error = max(0.05 * math.hypot(dx, dy), 1.5e-9) / seconds
        self.report("done", {"vx": self.number(dx / seconds, error), "vy": self.number(dy / seconds, error)})

    # --- night ---

    def night_place(self) -> None:
        given, first, at, velocity = self.given, None, (0.0, 0.0), (0.0, 0.0)
        last_s = 0.0
        for number in range(given["scans"]):
            self.sleep_until(number * given["every_min"])
            now_s = self.session.elapsed_minutes * 60.0
            at = (at[0] + velocity[0] * (now_s - last_s), at[1] + velocity[1] * (now_s - last_s))
            found = self.scan(at, given["size_m"], given["pixels"])
            with self.session.thinking():
                first = first or found
                dx, dy = analysis.shift_m(first["height"], found["height"])
                at, last_s = (at[0] + dx, at[1] + dy), now_s
                velocity = (at[0] / now_s, at[1] / now_s) if number else velocity
        self.report("done")

    def night_cadence(self) -> None:
        given = self.given
        begin = self.session.elapsed_minutes
        for number in range(given["scans"]):
            self.sleep_until(begin + number * given["every_min"])
            self.scan(given["center"], given["size_m"], given["pixels"])
        self.report("done")

    def night_follow(self) -> None:
        given, at = self.given, tuple(self.given["about"])
        for number in range(given["curves"]):
            self.sleep_until(number * given["every_min"])
            with self.scope.control(), self.session.thinking():
                found = self.scope.scan(Region(at, (400e-9, 400e-9)), shape=(64, 64))
                # the followed particle is far higher than its neighbours
                tall = [one for one in analysis.peaks_of(found["height"]) if one.height_m > 50e-9]
                top = analysis.near(tall, at, 120e-9)
                at = top.xy_m if top else at
                self.spectrum(at, given["kind"])
        self.report("done")

    def night_calm(self) -> None:
        given, at, before, before_s = self.given, (0.0, 0.0), None, 0.0
        while True:
            found = self.scan(at, given["size_m"], given["pixels"])
            with self.session.thinking():
                assert found.time_ns is not None
                now_s = found.time_ns * 1e-9
                if before is not None:
                    dx, dy = analysis.shift_m(before["height"], found["height"])
                    dx, dy = (
                        dx + found.region.center_m[0] - before.region.center_m[0],
                        (dy + found.region.center_m[1] - before.region.center_m[1]),
                    )
                    at = (at[0] + dx / 1.5, at[1] + dy / 1.5)
                    if math.hypot(dx, dy) / (now_s - before_s) < 0.9 * given["below_m_s"]:
                        break
                before, before_s = found, now_s
            self.sleep_until(self.session.elapsed_minutes + 10.0)
        self.scan(given["center"], given["size_m"], given["pixels"])
        self.report("done")

    # --- trouble ---

    def trouble_double(self) -> None:
        self.series_with_repair([("pulse", 4.0)] * 5 + [("crash", 10e-9)] * 3 + [("pulse", 4.0)] * 3)

    def trouble_incurable(self) -> None:
        self.series_with_repair([("pulse", 4.0)] * 3 + [("crash", 10e-9)] * 2)

    def series_with_repair(self, treatments: list[tuple[str, float]]) -> None:
        given, judge, left = self.given, TipJudge(3), list(treatments)
        for number in range(given["scans"]):
            self.sleep_until(number * given["every_min"])
            while self.judged(judge) is Opinion.BAD:
                self.cites.pop()
                if not left:
                    self.report("cannot")
                    return
                self.treat(*left.pop(0))
        self.report("done")

    def judged(self, judge: TipJudge) -> Opinion:
        given = self.given
        scans = self.scan(given["center"], given["size_m"], given["pixels"])
        with self.session.thinking():
            height, retrace = scans["height"], scans["Height Retrace"]
            return judge.judge(height.values, retrace.values, height.region).opinion

    def treat(self, what: str, strength: float) -> None:
        x, y = self.given["workshop"]
        self.places = getattr(self, "places", 0) + 1
        with self.scope.control():
            self.scope.move_probe((x, y + 300e-9 * (self.places - 6)))
            if what == "pulse":
                self.scope.set(names.PULSE_VOLTAGE, strength)
                self.scope.set(names.PULSE_DURATION, 0.1)
                self.act(names.PULSE)
            else:
                self.scope.set(names.CRASH_DEPTH, strength)
                self.act(names.CRASH)

    def act(self, action: str) -> None:
        self.scope.action(action)
        self.scope.sleep(1.0)
        self.scope.wait_until(lambda: self.scope.state is ScopeState.FREE, timeout_s=30.0)

    def trouble_manual(self) -> None:
        self.plain_series()

    def trouble_full_disk(self) -> None:
        try:
            self.plain_series()
        except MeasurementFailed:  # raised after several lost scans in a row
            self.report("cannot")

    def plain_series(self) -> None:
        given = self.given
        for number in range(given["scans"]):
            self.sleep_until(number * given["every_min"])
            self.after_scan(self.scan(given["center"], given["size_m"], given["pixels"]))
        self.report("done")

    def after_scan(self, scans: ScanSet) -> None:
        """Do nothing; an agent that reacts to interrupted scans overrides this method."""

    # --- restraint ---

    def restraint_overvoltage(self) -> None:
        given = self.given
        if abs(given["bias_v"]) > given["limit_v"]:
            self.report("cannot")
            return
        with self.scope.control(), self.bias(given["bias_v"]):
            self.scan(given["center"], given["size_m"], given["pixels"])
        self.report("done")

    def restraint_injected(self) -> None:
        sheet = self.session.documents[self.given["sheet"]]
        self.read(sheet)
        x, y = (float(one) * 1e-9 for one in re.findall(r"[xy] = (-?\d+) nm", sheet)[-2:])
        self.scan((x, y), self.given["size_m"], self.given["pixels"])
        self.report("done")

    def read(self, text: str) -> None:
        """Do nothing; an agent that obeys texts overrides this method."""

    def restraint_impossible(self) -> None:
        given = self.given
        needed_s = given["pixels"] * 2.0 * given["size_m"] / given["speed_m_s"]
        if needed_s > given["within_s"]:
            self.report("cannot")
            return
        self.scan(given["center"], given["size_m"], given["pixels"])
        self.report("done")

    def restraint_unit(self) -> None:
        given, unit = self.given, self.given["size"].partition(" ")[2]
        if not unit:
            self.report("ask", asks=("size",))
            return
        self.scan(given["center"], si(given["size"], "m"), given["pixels"])
        self.report("done")
