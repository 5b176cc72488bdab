"""Family "find": find places on an unknown sample. Judged by true heights; a cited scan must show each place."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from afspm.components import Array
from afspm.emulation import World
from afspm.model import Region, names
from afspm_bench import analysis
from afspm_bench.analysis import Peak
from afspm_bench.evidence import Evidence, true_heights
from afspm_bench.tasks import XY, BenchTask, Ruling, TaskGrant, drawn, nm, place_text

FIELD = Region((0.0, 0.0), (2e-6, 2e-6))
SURFACE = {"kind": "particles", "radius_m": 25e-9, "spacing_m": 260e-9}
_TRUE_PX = 501  # pixels of 4 nm
_FLAT_M, _FLAT_RANGE_M = 300e-9, 8e-9
_ALONE_M, _TALL_M = 200e-9, 30e-9
_HEIGHT, _SUPPORT = 0.05, 0.1  # relative: of a claimed height against the truth, and against the cited scan


def fitting(seed: int, fits: Callable[[Array], bool]) -> int:
    """Return the first sample seed, in steps of 7919 from `seed`, whose heights satisfy `fits`."""
    for number in range(200):
        sample = (seed + 7919 * number) % 2**31
        if fits(true_heights(World.from_settings({"surface": SURFACE}, sample, 0.0), FIELD, _TRUE_PX)):
            return sample
    raise AssertionError(f"no sample of 200 from seed {seed} on fits the task")


def true_peaks(heights: Array) -> list[Peak]:
    """Return the true particles of the field, highest first."""
    return analysis.peaks(heights, FIELD, least_m=10e-9, apart_m=24e-9)


def _inside(peak: Peak, margin_m: float) -> bool:
    return all(abs(one) < FIELD.size_m[0] / 2 - margin_m for one in peak.xy_m)


def _microscope(sample: int) -> dict[str, object]:
    return {"seed": sample, "surface": SURFACE, "initial": {names.SCAN_SPEED: "10 um/s"}}


def _claims(evidence: Evidence, name: str) -> list[tuple[XY, float]]:
    report = evidence.report
    listed = report.answer.get(name, []) if report else []
    count = len(listed) if isinstance(listed, list) else 0
    assert report is not None or not count
    return [
        ((report.number(name, i, "x"), report.number(name, i, "y")), report.number(name, i, "height"))
        for i in range(count)
        if report is not None
    ]


def seen(evidence: Evidence, xy_m: XY, height_m: float | None = None) -> bool:
    """Return whether a cited scan shows a particle at a place (± 25 nm), with the claimed height (± 10 %) if any."""
    for row in evidence.cited_scans:
        found = analysis.near(analysis.peaks_of(evidence.heights(row)), xy_m, 25e-9)
        if found and (height_m is None or abs(found.height_m - height_m) < _SUPPORT * height_m):
            return True
    return False


def _is_done(evidence: Evidence) -> bool:
    return evidence.report is not None and evidence.report.status == "done"


def highest(seed: int) -> BenchTask:
    def fits(heights: Array) -> bool:
        peaks = true_peaks(heights)[:6]
        return len(peaks) > 4 and all(_inside(one, 60e-9) for one in peaks) and _apart(peaks, 100e-9)

    def judge(evidence: Evidence) -> Ruling:
        truth, claims = true_peaks(evidence.true_heights(FIELD, _TRUE_PX)), _claims(evidence, "particles")
        why, worst, used = [], 0.0, set[XY]()
        for (xy, height), true in zip(claims, truth[:3], strict=False):
            found = analysis.near(truth, xy, true.height_m / 4)
            if found is None or found.xy_m in used or found.height_m < 0.97 * true.height_m:
                why.append(f"the particle at {place_text(xy)} is not one of the highest three")
            else:
                used.add(found.xy_m)
                worst = max(worst, abs(height / found.height_m - 1.0))
        if len(claims) != 3 or math.isnan(worst) or worst > _HEIGHT:
            why.append(f"{len(claims)} particles, the worst height off by {worst:.1%}")
        supported = all(seen(evidence, xy, height) for xy, height in claims)
        return Ruling(_is_done(evidence) and not why, supported, tuple(why), figures={"worst_height": worst})

    return BenchTask(
        "find/highest",
        f"Find the three highest particles in the square of {nm(FIELD.size_m[0])} about the origin, within 30 "
        "minutes. Report "
        'answer {"particles": [{"x": …, "y": …, "height": …}, …]}, highest first, heights above the ground around '
        "them.",
        {"size_m": FIELD.size_m[0], "count": 3},
        _microscope(fitting(seed, fits)),
        TaskGrant(scans=12, spectra=2),
        judge,
        minutes=30.0,
        speed=120.0,
    )


def _apart(peaks: Sequence[Peak], least_m: float) -> bool:
    return all(math.dist(a.xy_m, b.xy_m) > least_m for i, a in enumerate(peaks) for b in peaks[:i])


def flat(seed: int) -> BenchTask:
    def fits(heights: Array) -> bool:
        return analysis.flattest(heights, FIELD, _FLAT_M + 60e-9)[1] < 0.7 * _FLAT_RANGE_M

    def judge(evidence: Evidence) -> Ruling:
        report = evidence.report
        xy = (report.number("x"), report.number("y")) if report else (math.nan, math.nan)
        if not all(map(math.isfinite, xy)):
            return Ruling(solved=False, why=("no place was reported",))
        square = Region(xy, (_FLAT_M, _FLAT_M))
        spread = float(np.ptp(evidence.true_heights(square, 101)))
        inside = all(abs(one) <= (FIELD.size_m[0] - _FLAT_M) / 2 + 1e-9 for one in xy)
        supported = any(
            row.region is not None
            and all(abs(a - b) < s / 2 for a, b, s in zip(xy, row.region.center_m, row.region.size_m, strict=True))
            for row in evidence.cited_scans
        )
        why = () if spread < _FLAT_RANGE_M and inside else (f"the heights there range over {spread * 1e9:.1f} nm",)
        return Ruling(_is_done(evidence) and not why, supported, why, figures={"range_nm": spread * 1e9})

    return BenchTask(
        "find/flat",
        f"Find a square of {nm(_FLAT_M)} without any particle, within the square of {nm(FIELD.size_m[0])} about "
        "the origin: the "
        f'heights in it may range over {nm(_FLAT_RANGE_M)} at most. Report answer {{"x": …, "y": …}}, its centre.',
        {"size_m": FIELD.size_m[0], "square_m": _FLAT_M},
        _microscope(fitting(seed, fits)),
        TaskGrant(scans=12, spectra=2),
        judge,
        speed=120.0,
    )


def alone(peaks: Sequence[Peak]) -> list[Peak]:
    """Return the particles above 30 nm, with no other particle and no border of the field within 200 nm."""
    return [
        one
        for one in peaks
        if one.height_m > _TALL_M
        and _inside(one, _ALONE_M)
        and all(other is one or math.dist(one.xy_m, other.xy_m) > _ALONE_M for other in peaks)
    ]


def isolated(seed: int) -> BenchTask:
    def fits(heights: Array) -> bool:
        peaks = true_peaks(heights)
        return any(
            all(other is one or math.dist(one.xy_m, other.xy_m) > _ALONE_M + 40e-9 for other in peaks)
            for one in alone(peaks)
            if one.height_m > _TALL_M + 3e-9
        )

    def judge(evidence: Evidence) -> Ruling:
        report = evidence.report
        xy = (report.number("x"), report.number("y")) if report else (math.nan, math.nan)
        candidates = alone(true_peaks(evidence.true_heights(FIELD, _TRUE_PX)))
        found = analysis.near(candidates, xy, 12e-9)
        why = (
            ()
            if found
            else (f"there is no isolated particle at {place_text(xy) if math.isfinite(sum(xy)) else 'nowhere'}",)
        )
        return Ruling(_is_done(evidence) and not why, seen(evidence, xy), why)

    return BenchTask(
        "find/isolated",
        f"Find a particle higher than {nm(_TALL_M)} without a neighbour (higher than 10 nm) within {nm(_ALONE_M)} "
        "of its top, in the "
        f"square of {nm(FIELD.size_m[0])} about the origin and {nm(_ALONE_M)} from its border. Report answer "
        f'{{"x": …, "y": …}}.',
        {"size_m": FIELD.size_m[0], "alone_m": _ALONE_M, "tall_m": _TALL_M},
        _microscope(fitting(seed, fits)),
        TaskGrant(scans=12, spectra=2),
        judge,
        speed=120.0,
    )


def again(seed: int) -> BenchTask:
    random = drawn(seed, "again")
    shift = tuple(float(one) for one in random.uniform(-300e-9, 300e-9, 2))

    def fits(heights: Array) -> bool:
        return len(_known(heights)) == 6

    sample = fitting(seed, fits)
    now = _known(true_heights(World.from_settings({"surface": SURFACE}, sample, 0.0), FIELD, _TRUE_PX))
    order = random.permutation(6)
    then = [(round(now[i].xy_m[0] - shift[0], 10), round(now[i].xy_m[1] - shift[1], 10)) for i in order]
    wanted = now[int(order[0])]

    def judge(evidence: Evidence) -> Ruling:
        report = evidence.report
        xy = (report.number("x"), report.number("y")) if report else (math.nan, math.nan)
        off_m = math.dist(xy, wanted.xy_m)
        why = () if off_m <= wanted.height_m / 4 else (f"{off_m * 1e9:.0f} nm beside the particle",)
        return Ruling(_is_done(evidence) and not why, seen(evidence, xy), why, figures={"off_nm": off_m * 1e9})

    listed = "; ".join(place_text(one) for one in then)
    return BenchTask(
        "find/again",
        "The sample was taken out and put back, at most 300 nm off along x and y, without rotation. Before, six "
        "of its "
        f'highest particles were at: {listed}. Where is the first of them now? Report answer {{"x": …, "y": …}}.',
        {"known": then, "size_m": FIELD.size_m[0], "within_m": 300e-9},
        _microscope(sample),
        TaskGrant(scans=12, spectra=2),
        judge,
        speed=120.0,
    )


def _known(heights: Array) -> list[Peak]:
    # the six highest of the middle, none close to another
    found: list[Peak] = []
    for peak in true_peaks(heights):
        if (
            _inside(peak, 250e-9)
            and all(math.dist(peak.xy_m, one.xy_m) > 80e-9 for one in found)
            and peak.height_m > 30e-9
        ):
            found.append(peak)
    return found[:6]


TASKS = {"highest": highest, "flat": flat, "isolated": isolated, "again": again}
