"""The work that a component plans: scans, spectra, path of the tip, time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import TypeVar

from afspm.model.geometry import Region

N = TypeVar("N", int, float)

BYTES_A_PIXEL = 8
"""Bytes of a recorded value before compression: a float64."""
SPEED_UNKNOWN = "the file sets no scan-speed"


@dataclass(frozen=True)
class PlannedWork:
    """The work of one component, as known before the run.

    Attributes:
        scans, spectra: number of measurements; scans is None without an end.
        path_m: path of the tip over the surface, trace and retrace; None without an end.
        pixels: the number of pixels of all scans, in one channel; None without an end.
        duration_s: experiment time from the start of the first scan to the end of the last, with pauses, without
            spectra; None if unknown.
        at_most: whether the numbers are upper bounds.
        ends_experiment: whether the experiment ends when the work is done.
        why: the reason for an unknown or bounded number.
    """

    scans: int | None = 0
    spectra: int = 0
    path_m: float | None = 0.0
    pixels: int | None = 0
    duration_s: float | None = None
    at_most: bool = False
    ends_experiment: bool = False
    why: str = ""

    @property
    def bytes_a_channel(self) -> int | None:
        """Return the size of all scans in one channel before compression."""
        return None if self.pixels is None else BYTES_A_PIXEL * self.pixels

    @property
    def end_s(self) -> float | None:
        """Return the experiment time until the work is done; None if unknown, as for work with spectra."""
        return None if self.spectra else self.duration_s

    def __add__(self, other: PlannedWork) -> PlannedWork:
        """Return the sum of two parts of work, the second after the first."""
        return PlannedWork(
            _sum(self.scans, other.scans),
            self.spectra + other.spectra,
            _sum(self.path_m, other.path_m),
            _sum(self.pixels, other.pixels),
            _sum(self.duration_s, other.duration_s),
            self.at_most or other.at_most,
            self.ends_experiment or other.ends_experiment,
            self.why or other.why,
        )

    def as_dict(self) -> dict[str, object]:
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, object]) -> PlannedWork:
        """Return the work in an `as_dict` table; fields of later versions are ignored."""
        known = {field.name for field in fields(cls)}
        return cls(**{name: value for name, value in data.items() if name in known})  # type: ignore[arg-type]


def _sum(one: N | None, other: N | None) -> N | None:
    return None if one is None or other is None else one + other


def path_length_m(region: Region, rows: int) -> float:
    """Return the path of the tip in a scan: trace and retrace of each row."""
    return 2.0 * rows * region.size_m[0]


def planned_rounds(
    regions: Iterable[Region],
    shape: tuple[int, int],
    rounds: int | None,
    period_s: float,
    speed_m_s: float | None,
    *,
    skips_late: bool = False,
) -> PlannedWork:
    """Return the work of regions that are scanned in rounds.

    A round longer than its period delays the next round to a later multiple of the period.

    Args:
        shape: (rows, columns) of each scan.
        rounds: None without an end.
        skips_late: whether delayed rounds reduce the number of rounds, as in a plan with a fixed duration.
    """
    regions, rows = tuple(regions), shape[0]
    if rounds is None:
        return PlannedWork(scans=None, path_m=None, pixels=None, why="it goes on until the experiment is ended")
    path_m = sum(path_length_m(region, rows) for region in regions)
    duration_s, why = None, SPEED_UNKNOWN
    if speed_m_s:
        round_s, why = path_m / speed_m_s, ""
        step_s = round_s if not period_s else period_s * max(1, math.ceil(round_s / period_s * (1 - 1e-9)))
        if skips_late and step_s > period_s:
            rounds = math.floor((rounds - 1) * period_s / step_s * (1 + 1e-9)) + 1
        duration_s = (rounds - 1) * step_s + round_s
    scans = rounds * len(regions)
    return PlannedWork(scans, 0, rounds * path_m, scans * math.prod(shape), duration_s, why=why)


def planned_end_s(works: Iterable[PlannedWork | None]) -> float | None:
    """Return the experiment time until the experiment ends; None if unknown.

    The earliest work that ends the experiment decides; without such work, the longest. If the end of a deciding work is
    unknown, the result is None; a None in `works` is work without an estimate.
    """
    all_works = list(works)
    ending = [work.end_s for work in all_works if work is not None and work.ends_experiment]
    deciding = ending or [None if work is None else work.end_s for work in all_works]
    known = [end_s for end_s in deciding if end_s is not None]
    if not deciding or len(known) < len(deciding):
        return None
    return min(known) if ending else max(known)
