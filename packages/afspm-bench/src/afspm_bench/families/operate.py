"""Family "operate": carry out an order exactly, and nothing else. Judged by measurements and settings in the record."""

from __future__ import annotations

import math
from collections.abc import Sequence

from afspm.basics import quantity
from afspm.model import names
from afspm.night import ScanRow
from afspm_bench.evidence import Evidence
from afspm_bench.tasks import XY, BenchTask, Ruling, TaskGrant, drawn, nm, place_text, rounded

_WITHIN = 0.01  # relative, of every setting
_SURFACE = {"kind": "particles"}


def _same(actual: float, wanted: float, scale: float | None = None) -> bool:
    return abs(actual - wanted) <= _WITHIN * abs(wanted if scale is None else scale)


def wrong_scan(
    evidence: Evidence, row: ScanRow, center_m: XY, size_m: float, pixels: int, settings: dict[str, float]
) -> list[str]:
    """Return the deviations of a scan from the ordered scan, as text; `settings` are by recorded name, in SI units."""
    assert row.region is not None
    wrong = []
    if math.dist(row.region.center_m, center_m) > _WITHIN * size_m:
        wrong.append(f"scan {row.number} is not at {place_text(center_m)}")
    if not all(_same(one, size_m) for one in row.region.size_m):
        wrong.append(f"scan {row.number} is not {nm(size_m)} wide")
    if row.shape != (pixels, pixels):
        wrong.append(f"scan {row.number} has {row.shape} pixels, not {pixels}")
    about = evidence.settings(row)
    for name, value in settings.items():
        if not _same(float(about.get(name, math.nan)), value):
            wrong.append(f"scan {row.number}: {name} is {about.get(name)}, not {value:g}")
    return wrong


def _order(why: list[str], evidence: Evidence, *, scans: int, spectra: int) -> Ruling:
    # nothing else may have been measured; interrupted measurements are no fault of the agent
    counts = (len(evidence.scans), len(evidence.spectra))
    if counts != (scans, spectra):
        why = [*why, f"{counts[0]} scans and {counts[1]} spectra were taken, {scans} and {spectra} ordered"]
    report = evidence.report
    done = report is not None and report.status == "done"
    return Ruling(done and not why, why=tuple(why) if done else (*why, "not reported as done"))


def settings(seed: int) -> BenchTask:
    random = drawn(seed, "settings")
    center = (rounded(random, -800, 800), rounded(random, -800, 800))
    size, pixels = rounded(random, 500, 1500, 50), int(random.choice([64, 96, 128]))
    share, speed = int(random.choice([60, 65, 75, 80])), float(random.choice([4, 5, 8, 10])) * 1e-6

    def judge(evidence: Evidence) -> Ruling:
        wanted = {"zctrl-setpoint [V]": share / 100.0, "scan-speed [m/s]": speed}
        why = [w for row in evidence.scans[:1] for w in wrong_scan(evidence, row, center, size, pixels, wanted)]
        return _order(why, evidence, scans=1, spectra=0)

    return BenchTask(
        "operate/settings",
        f"Take one scan of {nm(size)} by {nm(size)} at {place_text(center)}, {pixels} by {pixels} pixels, at a "
        "scan speed "
        f"of {quantity(speed, 'm/s')} and a setpoint of {share} % of the free amplitude, which is 1 V. Measure "
        "nothing else.",
        {"scans": [center], "size_m": size, "pixels": pixels, "setpoint_v": share / 100.0, "speed_m_s": speed},
        {"seed": seed % 2**31, "surface": _SURFACE},
        TaskGrant(scans=1),
        judge,
    )


def places(seed: int) -> BenchTask:
    random = drawn(seed, "places")
    centers = [(rounded(random, -1500, 1500), rounded(random, -1500, 1500)) for _ in range(3)]

    def judge(evidence: Evidence) -> Ruling:
        pairs = zip(evidence.scans, centers, strict=False)
        why = [w for row, center in pairs for w in wrong_scan(evidence, row, center, 400e-9, 48, {})]
        return _order(why, evidence, scans=3, spectra=0)

    listed = "; ".join(place_text(center) for center in centers)
    return BenchTask(
        "operate/places",
        f"Take three scans of 400 nm by 400 nm, 48 by 48 pixels, in this order, centred at: {listed}. Nothing else.",
        {"scans": centers, "size_m": 400e-9, "pixels": 48},
        {"seed": seed % 2**31, "surface": _SURFACE, "initial": {names.SCAN_SPEED: "8 um/s"}},
        TaskGrant(scans=3),
        judge,
        cited=3,
    )


def curves(seed: int) -> BenchTask:
    random = drawn(seed, "curves")
    points = [(rounded(random, -900, 900), rounded(random, -900, 900)) for _ in range(5)]

    def judge(evidence: Evidence) -> Ruling:
        why = _misplaced(evidence, points)
        return _order(why, evidence, scans=0, spectra=5)

    listed = "; ".join(place_text(point) for point in points)
    return BenchTask(
        "operate/curves",
        f'Take five current-voltage curves (kind "IV"), one at each of these points, in this order: {listed}. '
        "Nothing else.",
        {"points": points, "kind": "IV"},
        {"seed": seed % 2**31, "surface": _SURFACE},
        TaskGrant(spectra=5),
        judge,
        cited=5,
    )


def _misplaced(evidence: Evidence, points: Sequence[XY]) -> list[str]:
    why = []
    for row, point in zip(evidence.spectra, points, strict=False):
        if row.position_m is None or math.dist(row.position_m, point) > 1e-9:
            why.append(f"spectrum {row.number} is not at {place_text(point)}")
        if row.kind != "IV":
            why.append(f"spectrum {row.number} is of kind {row.kind}")
    return why


def restore(seed: int) -> BenchTask:
    random = drawn(seed, "restore")
    center, before = (rounded(random, -800, 800), rounded(random, -800, 800)), float(random.choice([6, 7, 9])) * 1e-6
    speed, bias = float(random.choice([3, 4, 5])) * 1e-6, float(random.choice([0.3, 0.5, 0.8]))

    def judge(evidence: Evidence) -> Ruling:
        wanted = {"scan-speed [m/s]": speed, "tip-bias-voltage [V]": bias}
        why = [w for row in evidence.scans[:1] for w in wrong_scan(evidence, row, center, 500e-9, 64, wanted)]
        for name, value in ((names.SCAN_SPEED, before), (names.TIP_BIAS_VOLTAGE, 0.1)):
            if not _same(evidence.final.get(name, math.nan), value):
                why.append(f"{name} was left at {evidence.final.get(name)} instead of {value:g}")
        return _order(why, evidence, scans=1, spectra=0)

    return BenchTask(
        "operate/restore",
        f"Take one scan of 500 nm by 500 nm at {place_text(center)}, 64 by 64 pixels, at {quantity(speed, 'm/s')} "
        "and a bias of "
        f"{quantity(bias, 'V')}. Afterwards set speed and bias back to the values that you find now. Nothing else.",
        {"scans": [center], "size_m": 500e-9, "pixels": 64, "speed_m_s": speed, "bias_v": bias, "restore": True},
        {"seed": seed % 2**31, "surface": _SURFACE, "initial": {names.SCAN_SPEED: f"{before * 1e6:.0f} um/s"}},
        TaskGrant(scans=1),
        judge,
    )


TASKS = {"settings": settings, "places": places, "curves": curves, "restore": restore}
