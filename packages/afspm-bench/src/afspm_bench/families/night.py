"""Family "night": measure for hours unattended. Judged by true places on the sample, times, and the true drift."""

from __future__ import annotations

import math

import numpy as np

from afspm.emulation import World
from afspm.model import Region, names
from afspm_bench import analysis
from afspm_bench.evidence import Evidence, times_of, true_heights
from afspm_bench.tasks import XY, BenchTask, Ruling, TaskGrant, drawn, nm, place_text

_SURFACE = {"kind": "particles", "radius_m": 25e-9, "spacing_m": 160e-9}
_FAST = {names.SCAN_SPEED: "10 um/s"}
_USABLE = 0.9


def _drift(random: np.random.Generator, low_pm: float, high_pm: float) -> list[float]:
    speed, angle = float(random.uniform(low_pm, high_pm)) * 1e-12, float(random.uniform(0, 2 * math.pi))
    return [speed * math.cos(angle), speed * math.sin(angle), 0.0]


def _is_done(evidence: Evidence) -> bool:
    return evidence.report is not None and evidence.report.status == "done"


def place(seed: int) -> BenchTask:
    random = drawn(seed, "place")

    def judge(evidence: Evidence) -> Ruling:
        rows, why = evidence.cited_scans, []
        where = [
            evidence.on_sample(row.region.center_m, t)
            for row, t in zip(rows, times_of(rows), strict=True)
            if row.region
        ]
        off_m = [float(np.hypot(*(one - where[0]))) for one in where]
        share = sum(one < 80e-9 for one in off_m) / max(len(off_m), 1)
        if len(rows) < 12 or evidence.minutes(rows[-1].time_ns) < 220.0:
            why.append(f"{len(rows)} scans are cited; 13 in 240 minutes were wanted")
        if share < _USABLE:
            why.append(
                f"{share:.0%} of the scans show the place, the worst is {max(off_m, default=0) * 1e9:.0f} nm off"
            )
        figures = {"usable": share, "worst_nm": max(off_m, default=math.nan) * 1e9}
        return Ruling(_is_done(evidence) and not why, why=tuple(why), figures=figures)

    return BenchTask(
        "night/place",
        "For four hours, scan the place that is at the origin now every 20 minutes: 800 nm by 800 nm, 64 by 64 "
        "pixels, 13 scans. "
        "The sample drifts: no more than 80 nm between the place and the centre of a scan. Cite all 13 scans.",
        {"scans": 13, "every_min": 20.0, "size_m": 800e-9, "pixels": 64, "center": (0.0, 0.0)},
        {
            "seed": seed % 2**31,
            "surface": _SURFACE,
            "initial": _FAST,
            "drift": {"velocity_m_per_s": _drift(random, 25, 50)},
        },
        TaskGrant(scans=40),
        judge,
        minutes=330.0,
        speed=1200.0,
        cited=12,
    )


def cadence(seed: int) -> BenchTask:
    every = float(drawn(seed, "cadence").choice([16, 18, 20]))

    def judge(evidence: Evidence) -> Ruling:
        rows = evidence.cited_scans
        begun = [evidence.minutes(row.began_ns or row.time_ns) for row in rows]
        gaps = np.diff(begun)
        on_time = float((np.abs(gaps - every) <= 4.0).mean()) if len(gaps) else 0.0
        why = []
        if len(rows) < 11:
            why.append(f"{len(rows)} scans are cited of 12")
        if on_time < _USABLE:
            why.append(f"{on_time:.0%} of the scans began {every:g} ± 4 minutes after the one before")
        return Ruling(_is_done(evidence) and not why, why=tuple(why), figures={"on_time": on_time})

    return BenchTask(
        "night/cadence",
        f"Take 12 scans of 500 nm by 500 nm at the origin, 64 by 64 pixels, one every {every:g} minutes (from "
        "start to start, within "
        "4 minutes). Cite them all.",
        {"scans": 12, "every_min": every, "size_m": 500e-9, "pixels": 64, "center": (0.0, 0.0)},
        {"seed": seed % 2**31, "surface": _SURFACE, "initial": _FAST},
        TaskGrant(scans=40),
        judge,
        minutes=12 * every + 40.0,
        speed=480.0,
        cited=11,
    )


_FOLLOWED = {"kind": "particles", "radius_m": 40e-9, "spacing_m": 300e-9}


def follow(seed: int) -> BenchTask:
    random = drawn(seed, "follow")
    sample, target = _followed_sample(seed)

    def judge(evidence: Evidence) -> Ruling:
        rows = evidence.cited_spectra
        off_m = [
            float(np.hypot(*(evidence.on_sample(row.position_m, t) - target)))
            for row, t in zip(rows, times_of(rows), strict=True)
            if row.position_m
        ]
        share = sum(one < 20e-9 for one in off_m) / max(len(off_m), 1)
        why = []
        if len(rows) < 8 or evidence.minutes(rows[-1].time_ns) < 50.0:
            why.append(f"{len(rows)} curves are cited; 8 in an hour were wanted")
        if share < _USABLE:
            why.append(f"{share:.0%} of the curves are on the particle")
        return Ruling(_is_done(evidence) and not why, why=tuple(why), figures={"usable": share})

    about = (round(target[0], 8), round(target[1], 8))
    return BenchTask(
        "night/follow",
        'Take 8 current-voltage curves ("IV") in an hour, one every 8 minutes, all on the top of the particle '
        "that is now within "
        f"20 nm of {place_text(about)}. The sample drifts; you may scan in between. Cite the curves.",
        {"curves": 8, "every_min": 8.0, "about": about, "kind": "IV"},
        {"seed": sample, "surface": _FOLLOWED, "initial": _FAST, "drift": {"velocity_m_per_s": _drift(random, 25, 50)}},
        TaskGrant(scans=40, spectra=12, pressed_m=4e-9),  # large particles, in small scans
        judge,
        minutes=90.0,
        speed=240.0,
        cited=8,
    )


def _followed_sample(seed: int) -> tuple[int, XY]:
    # a large particle near the middle, without another particle within 160 nm
    region = Region((0.0, 0.0), (1.2e-6, 1.2e-6))
    for number in range(200):
        sample = (seed + 7919 * number) % 2**31
        heights = true_heights(World.from_settings({"surface": _FOLLOWED}, sample, 0.0), region, 301)
        peaks = analysis.peaks(heights, region, least_m=15e-9, apart_m=24e-9)
        for one in peaks:
            alone = all(other is one or math.dist(other.xy_m, one.xy_m) > 160e-9 for other in peaks)
            if one.height_m > 60e-9 and math.hypot(*one.xy_m) < 400e-9 and alone:
                return sample, one.xy_m
    raise AssertionError(f"no sample of 200 from seed {seed} on has such a particle")


_CALM_M_S, _TAU_S = 15e-12, 1800.0


def calm(seed: int) -> BenchTask:
    random = drawn(seed, "calm")
    total, angle = float(random.uniform(200e-9, 350e-9)), float(random.uniform(0, 2 * math.pi))
    calm_after = _TAU_S / 60.0 * math.log(total / _TAU_S / _CALM_M_S)

    def judge(evidence: Evidence) -> Ruling:
        rows, why = evidence.cited_scans, []
        if not rows:
            return Ruling(solved=False, why=("no scan is cited",))
        t = (rows[-1].began_ns or rows[-1].time_ns) * 1e-9
        rate = float(np.hypot(*(evidence.drift_m(t + 60.0) - evidence.drift_m(t)))) / 60.0
        begun = evidence.minutes(int(t * 1e9))
        if rate > _CALM_M_S:
            why.append(f"the last cited scan was taken at {rate * 1e12:.0f} pm/s")
        if begun > calm_after + 60.0:
            why.append(f"it was taken {begun - calm_after:.0f} minutes after the sample was calm")
        return Ruling(_is_done(evidence) and not why, why=tuple(why), figures={"rate_pm_s": rate * 1e12})

    drift: dict[str, object] = {
        "relaxing": [{"total_m": [total * math.cos(angle), total * math.sin(angle), 0.0], "time_s": _TAU_S}]
    }
    return BenchTask(
        "night/calm",
        "The sample was just approached, and creeps ever slower. Wait until its drift is below "
        f"{_CALM_M_S * 1e12:.0f} pm/s, then take one "
        f"scan of {nm(500e-9)} at the origin, 128 by 128 pixels, no later than an hour after that. Measure the "
        "drift by scans. "
        "Cite these scans and, last, the one at rest.",
        {"below_m_s": _CALM_M_S, "size_m": 500e-9, "pixels": 128, "center": (0.0, 0.0)},
        {"seed": seed % 2**31, "surface": _SURFACE, "initial": _FAST, "drift": drift},
        TaskGrant(scans=40),
        judge,
        minutes=220.0,
        speed=600.0,
        cited=3,
    )


TASKS = {"place": place, "cadence": cadence, "follow": follow, "calm": calm}
