"""Geometry of scans: details must fit into a larger scan at their reported regions, if the sample shows structure.

A larger scan is compared with details of it. A wrong assumption about the axes affects both alike, so each assumption
("idea") is applied to both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.model import Region, names
from afspm.model.arrays import Array
from afspm.testing.conformance import Failed, Skipped
from afspm.testing.translators.measuring import CheckMeasurements, FrameSetting, Taken
from afspm.testing.translators.translator_suite import check

LIKE = 0.6
"""The least correlation of two pictures of the same structure."""
CLEARLY = 0.1
_EQUAL = 0.01
_SHIFTS = (-0.04, -0.02, 0.0, 0.02, 0.04)
"""In units of the larger scan: drift between two scans, and an imperfect scanner."""
_INSIDE = 0.6


@dataclass(frozen=True)
class ScanPicture:
    """One channel of a scan: values [y, x] in a region."""

    region: Region
    values: Array


Idea = Callable[[ScanPicture], ScanPicture]


def ideas(angle_rad: float) -> dict[str, Idea]:
    """Return possible errors in a translator's axes, by description; `angle_rad` is the angle of the larger scan."""

    def turned_back(picture: ScanPicture) -> ScanPicture:
        return replace(picture, region=replace(picture.region, angle_rad=2 * angle_rad - picture.region.angle_rad))

    found: dict[str, Idea] = {
        "as reported": lambda picture: picture,
        "with x mirrored": lambda picture: replace(picture, values=picture.values[:, ::-1]),
        "with y mirrored": lambda picture: replace(picture, values=picture.values[::-1]),
        "with x and y mirrored": lambda picture: replace(picture, values=picture.values[::-1, ::-1]),
        "with x and y swapped": lambda picture: replace(picture, values=picture.values.T),
        "with angles the other way round": turned_back,
    }
    for across in (-0.5, 0.0, 0.5):
        for up in (-0.5, 0.0, 0.5):
            if across or up:
                found[f"half a frame away ({across:+g}, {up:+g})"] = _moved(across, up)
    return found


def _moved(across: float, up: float) -> Idea:
    def moved(picture: ScanPicture) -> ScanPicture:
        region = picture.region
        cos, sin = np.cos(region.angle_rad), np.sin(region.angle_rad)
        right, high = across * region.size_m[0], up * region.size_m[1]
        x, y = region.center_m
        center = (float(x + cos * right - sin * high), float(y + sin * right + cos * high))
        return replace(picture, region=region.moved_to(center))

    return moved


def likenesses(larger: ScanPicture, details: Sequence[ScanPicture]) -> dict[str, float]:
    """Return the mean correlation (-1 to 1) of the details with the larger scan, for each idea."""
    return {
        name: float(np.mean([_best(idea(larger), idea(detail)) for detail in details]))
        for name, idea in ideas(larger.region.angle_rad).items()
    }


def best_of(found: dict[str, float]) -> tuple[str, float]:
    """Return the idea with the highest likeness, and the likeness; among equal ideas the first and simplest.

    With few details two ideas may be equal: a square detail fits swapped as well as shifted by half a frame.
    """
    most = max(found.values())
    return next((name, likeness) for name, likeness in found.items() if likeness >= most - _EQUAL)


def _best(larger: ScanPicture, detail: ScanPicture) -> float:
    x, y = detail.region.pixels_m(detail.values.shape)
    return max(_correlation(larger, detail.values, x + right, y + up) for right, up in _shifts(larger.region))


def _shifts(region: Region) -> Iterator[tuple[float, float]]:
    side = min(region.size_m)
    return ((right * side, up * side) for right in _SHIFTS for up in _SHIFTS)


def _correlation(larger: ScanPicture, detail: Array, x_m: Array, y_m: Array) -> float:
    wanted, inside = _at(larger, x_m, y_m)
    if inside.mean() < _INSIDE:
        return -1.0
    a, b = _level(inside, detail, wanted)
    scale = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / scale) if scale > 0.0 else 0.0


def _at(picture: ScanPicture, x_m: Array, y_m: Array) -> tuple[Array, NDArray[np.bool_]]:
    # bilinear; the mask marks positions inside the picture
    region, (rows, columns) = picture.region, picture.values.shape
    cos, sin = np.cos(region.angle_rad), np.sin(region.angle_rad)
    right, up = x_m - region.center_m[0], y_m - region.center_m[1]
    column = ((cos * right + sin * up) / region.size_m[0] + 0.5) * (columns - 1)
    row = ((cos * up - sin * right) / region.size_m[1] + 0.5) * (rows - 1)
    inside = (column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1)
    c, r = np.clip(column, 0, columns - 1 - 1e-9), np.clip(row, 0, rows - 1 - 1e-9)
    c0, r0 = c.astype(int), r.astype(int)
    c1, r1 = np.minimum(c0 + 1, columns - 1), np.minimum(r0 + 1, rows - 1)
    u, v = c - c0, r - r0
    values = picture.values
    low = values[r0, c0] * (1 - u) + values[r0, c1] * u
    high = values[r1, c0] * (1 - u) + values[r1, c1] * u
    return np.asarray(low * (1 - v) + high * v), inside


def _level(inside: NDArray[np.bool_], *pictures: Array) -> Array:
    # without its plane: no sample is level
    rows, columns = np.nonzero(inside)
    plane = np.stack([rows, columns, np.ones(len(rows))], axis=1).astype(float)
    found = np.stack([values[inside] for values in pictures], axis=1)
    return np.asarray(found - plane @ np.linalg.lstsq(plane, found, rcond=None)[0]).T


_SHAPE = (96, 96)


@check(
    "scan/picture",
    "details fit into a larger scan at their position and angle",
    needs=(names.START_SCAN,),
)
def picture(kit: CheckMeasurements) -> None:
    wide = ["wide"] if kit.can_pass("scan/not-square") else []
    turned = ["turned"] if kit.support.has(names.SCAN_ANGLE) else []
    details = [kit.scan(name) for name in ("plain", *wide, *turned)]
    larger = kit.take_scan(FrameSetting(kit.frames.whole, _SHAPE))
    found = [likenesses(*_pictures(channel, larger, details)) for channel in _common(larger, details)]
    if not found:
        raise Failed("the same channels in all scans", "no channel that all have")
    best = max(found, key=lambda likeness: max(likeness.values()))
    name, likeness = best_of(best)
    as_reported = best["as reported"]
    if likeness < LIKE:
        raise Skipped(f"no structure is seen in all scans (correlation {likeness:.2f}): noise shows no coordinates")
    if as_reported < likeness - CLEARLY:
        raise Failed(
            "details that fit into a larger scan at their position and angle",
            f"a correlation of {as_reported:.2f}, and of {likeness:.2f} {name}",
        )
    if as_reported < LIKE:
        raise Skipped(f"no structure is seen clearly in all scans (correlation {as_reported:.2f})")


def _common(larger: Taken, details: list[Taken]) -> list[str]:
    sets = [{scan.channel for scan in taken.scans if min(scan.shape) > 1} for taken in (larger, *details)]
    return sorted(set.intersection(*sets))


def _pictures(channel: str, larger: Taken, details: list[Taken]) -> tuple[ScanPicture, list[ScanPicture]]:
    def of(taken: Taken) -> ScanPicture:
        scan = next(one for one in taken.scans if one.channel == channel)
        return ScanPicture(scan.region, scan.values)

    return of(larger), [of(taken) for taken in details]
