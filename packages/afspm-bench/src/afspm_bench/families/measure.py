"""Family "measure": report a number with its error. Judged by the truth, which the error bar must cover."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from afspm.emulation import World
from afspm.model import Region, Scan, names
from afspm_bench import analysis
from afspm_bench.evidence import Evidence, times_of, true_heights
from afspm_bench.tasks import XY, BenchTask, Ruling, TaskGrant, drawn, place_text

_SIGMAS = 2.0  # the error bar has to cover the truth within this many standard deviations
_FAST = {names.SCAN_SPEED: "10 um/s"}


def _rule(
    evidence: Evidence,
    truth: dict[str, float],
    tolerance: float,
    scale: float,
    supported: bool,
    extra: tuple[str, ...] = (),
) -> Ruling:
    report, why, figures = evidence.report, list(extra), dict[str, float]()
    for name, true in truth.items():
        value, error = report.value(name) if report else (math.nan, math.nan)
        off = abs(value - true)
        figures[f"{name}_off"] = off / scale
        if not off <= tolerance * scale:
            why.append(f"{name} is off by {off / scale:.2%}, {tolerance:.0%} allowed")
        if not 0.0 < error <= 2.0 * tolerance * scale:
            why.append(f"the error bar of {name}, {error:.2g}, is zero or useless")
        elif not off <= _SIGMAS * error:
            why.append(f"the error bar of {name} does not cover the truth")
    done = report is not None and report.status == "done"
    return Ruling(done and not why, supported, tuple(why), figures=figures)


def _rule_on_scans(
    evidence: Evidence, name: str, true: float, tolerance: float, measured: Callable[[Scan], Sequence[float]]
) -> Ruling:
    # a cited scan has to show the number within twice the tolerance
    claimed = evidence.report.value(name)[0] if evidence.report else math.nan
    found = [measured(evidence.heights(row))[0] for row in evidence.cited_scans]
    supported = any(abs(one - claimed) < 2.0 * tolerance * true for one in found)
    return _rule(evidence, {name: true}, tolerance, true, supported)


def lattice(seed: int) -> BenchTask:
    random = drawn(seed, "lattice")
    constant, angle = float(random.uniform(0.23e-9, 0.32e-9)), float(random.uniform(0, 60))
    surface = {"kind": "lattice", "constant_m": constant, "angle_deg": angle, "strain_m": 5e-12}

    def judge(evidence: Evidence) -> Ruling:
        return _rule_on_scans(evidence, "constant", constant, 0.01, analysis.lattice_constant)

    return BenchTask(
        "measure/lattice",
        "Measure the lattice constant (distance of neighbours) of this hexagonal lattice, near the origin, to 1 %. "
        "It lies between "
        '0.2 and 0.35 nm. Report answer {"constant": {"value": …, "error": …}}.',
        {"at": (0.0, 0.0), "range_m": [0.2e-9, 0.35e-9]},
        {"seed": seed % 2**31, "surface": surface, "initial": {names.SCAN_SPEED: "100 nm/s"}},
        TaskGrant(scans=10, reach_m=1e-6),
        judge,
        speed=120.0,
    )


def step(seed: int) -> BenchTask:
    random = drawn(seed, "step")
    height = float(random.uniform(0.24e-9, 0.6e-9))
    surface = {"kind": "steps", "step_m": height, "terrace_m": 120e-9, "angle_deg": float(random.uniform(-40, 40))}

    def judge(evidence: Evidence) -> Ruling:
        return _rule_on_scans(evidence, "height", height, 0.02, analysis.step_height)

    return BenchTask(
        "measure/step",
        "All steps of this surface have the same height, between 0.2 and 0.7 nm. Measure it to 2 %. Report answer "
        '{"height": {"value": …, "error": …}}.',
        {"size_m": 600e-9, "range_m": [0.2e-9, 0.7e-9]},
        {"seed": seed % 2**31, "surface": surface, "initial": _FAST},
        TaskGrant(scans=10),
        judge,
        speed=120.0,
    )


def gap(seed: int) -> BenchTask:
    random = drawn(seed, "gap")
    width, surface = (
        round(float(random.uniform(0.7, 1.3)), 3),
        {"kind": "particles", "radius_m": 30e-9, "spacing_m": 260e-9},
    )
    sample = World.from_settings({"surface": surface}, seed % 2**31, 0.0)
    points = _points(sample, random)
    metal = {i + 1 for i, (_, is_metal) in enumerate(points) if is_metal}

    def judge(evidence: Evidence) -> Ruling:
        report = evidence.report
        claimed = report.answer.get("metal", []) if report else []
        right = isinstance(claimed, list) and {str(one) for one in claimed} == {str(one) for one in metal}
        curves = [evidence.curve(row) for row in evidence.cited_spectra]
        gapped = [one for one in curves if analysis.conductance_in_gap(one) < 0.3]
        supported = len(curves) - len(gapped) > 0 and bool(gapped)
        if gapped and report:
            supported &= abs(analysis.band_gap(gapped)[0] - report.value("gap")[0]) < 0.2
        extra = () if right else (f"the metal ones are {sorted(metal)}",)
        return _rule(evidence, {"gap": width}, 0.1, width, supported, extra)

    listed = "; ".join(f"{i}: {place_text(xy)}" for i, (xy, _) in enumerate(points, 1))
    return BenchTask(
        "measure/gap",
        f"Which of these places are metal, and how wide is the band gap of the others, to 10 %? {listed}. Report "
        "answer "
        '{"metal": [numbers], "gap": {"value": …, "error": …}}, the gap in V.',
        {"points": [xy for xy, _ in points], "kind": "IV"},
        {"seed": seed % 2**31, "surface": surface, "iv": {"gap_ev": width}, "initial": _FAST},
        TaskGrant(scans=10, spectra=20),
        judge,
        speed=120.0,
        cited=4,
    )


def _points(world: World, random: np.random.Generator) -> list[tuple[XY, bool]]:
    # two places on particles and three on the ground, away from all borders, in a random order
    region = Region((0.0, 0.0), (1.6e-6, 1.6e-6))
    heights = true_heights(world, region, 401)
    tops = analysis.peaks(heights, region, least_m=40e-9, apart_m=60e-9)
    found: list[tuple[XY, bool]] = [((round(p.xy_m[0], 9), round(p.xy_m[1], 9)), True) for p in tops[:2]]
    while len(found) < 5:
        x, y = (round(float(one), 9) for one in random.uniform(-700e-9, 700e-9, 2))
        around = true_heights(world, Region((x, y), (100e-9, 100e-9)), 21)
        if around.max() < 6e-9:
            found.append(((x, y), False))
    return [found[i] for i in random.permutation(5)]


def drift(seed: int) -> BenchTask:
    random = drawn(seed, "drift")
    speed, angle = float(random.uniform(25e-12, 60e-12)), float(random.uniform(0, 2 * math.pi))
    velocity = (speed * math.cos(angle), speed * math.sin(angle))

    def judge(evidence: Evidence) -> Ruling:
        rows, report = evidence.cited_scans, evidence.report
        supported = False
        if len(rows) > 1 and report:
            first, last = rows[0], rows[-1]
            t0, t1 = times_of([first, last])
            # the frames may have been moved between the scans
            moved = np.subtract(last.region.center_m, first.region.center_m) if last.region and first.region else np.nan
            if first.shape == last.shape:
                shift = np.add(analysis.shift_m(evidence.heights(first), evidence.heights(last)), moved)
                claimed = np.array([report.value("vx")[0], report.value("vy")[0]])
                supported = bool(np.hypot(*(shift / (t1 - t0) - claimed)) < 0.3 * speed)
        return _rule(evidence, {"vx": velocity[0], "vy": velocity[1]}, 0.1, speed, supported)

    microscope: dict[str, object] = {
        "seed": seed % 2**31, "surface": {"kind": "particles"}, "initial": _FAST,
        "drift": {"velocity_m_per_s": [*velocity, 0.0]},
    }  # fmt: skip
    return BenchTask(
        "measure/drift",
        "The sample drifts at a constant velocity below 100 pm/s. Measure it to 10 % of its magnitude. Report answer "
        '{"vx": {"value": …, "error": …}, "vy": …} in m/s: positive if features move towards positive x and y.',
        {"size_m": 1e-6},
        microscope,
        TaskGrant(scans=12),
        judge,
        minutes=90.0,
        cited=2,
    )


TASKS = {"lattice": lattice, "step": step, "gap": gap, "drift": drift}
