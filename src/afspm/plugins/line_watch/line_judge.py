"""Detection of tip changes from the lines of running scans. Pure.

Each line is compared with an earlier scan of the same place, at the shift found from the lines so far (`registration`).
The remaining difference is split into two numbers. What trace and retrace share is of the image; what they don't share
is noise, however strong (`NoiseFilter`). Without retrace, two successive lines are taken instead.

The image's part, relative to its usual size for two good scans of this kind, goes into a CUSUM (Page 1954): its sum
grows while lines differ more than usual, and falls back to zero otherwise. So a scar or a spike in one line raises no
alarm, but ten slightly different lines do. Without an earlier scan of the place, nothing is judged.

Each kind of scan (same size, angle, pixels and setpoint; decision 0044) has its own threshold: the highest sum of good
scans, times a factor, and at least a fixed value. A sum above the threshold raises `STOP`, a sum above 60 % of the
threshold `LOOK`, once enough lines since the change are known. Before an alarm, a wider search for the shift shows
whether the sample has jumped: then the template explains the lines again. A scan is stopped only for a change of the
whole line, or for one that lasts, as a tip makes it: an adsorbate, or a particle that was dragged, changes one or two
narrow parts of some lines, and several adsorbates few cells of rows and columns. Nor is it stopped if another contrast,
the end of the range of heights, or overshoot at the edges explains the lines (`causes`). Strong noise and streaks are
looked at (`disturbances`).

Without retrace, the waves of a hum may be in step in successive lines, as an image is. But a hum has one frequency, and
a changed tip many. So before an alarm, a narrow peak in the spectrum of the differing lines is removed from these and
later lines, and counts as noise; a changed tip differs without it, too.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics import Plain
from afspm.components import Array, from_plain, to_plain
from afspm.model import Region
from afspm.plugins.line_watch.causes import is_slight, of_height, without_ends, without_overshoot
from afspm.plugins.line_watch.disturbances import Disturbances
from afspm.plugins.line_watch.registration import (
    CLIP_SIGMAS,
    Cause,
    RowFit,
    RowRegistration,
    RowTemplate,
    Shift,
    levelled,
    likely_shifts,
    residual_spread,
)

GOOD_DECAY = 5.0  # decay, with the evidence, of the share of good scans that reach it: assumed, not fitted
FEWEST_PAIRS = 2  # least number of pairs of good scans before scans of their kind are judged
ENOUGH_PAIRS = 4  # least number of pairs for medians
# Times the least of few pairs, in the size of the image's part: a pair above it crosses a change between its scans, as
# if a feedback begins to overshoot, and is no measure of good scans. Of ten nights with unlike pairs, three had one of
# 9 to 38 times, the others of at most 2.5 times.
ODD_PAIR = 5.0
KEPT_PAIRS, KEPT_SPEEDS = 16, 3
MOST_KINDS, MOST_PLACES = 4, 8
SAME_SIZE = 0.02  # relative difference of sizes, and of angles in rad, within which they count as equal
LEAST_COMMON = 0.5  # share of width and height that an earlier scan must cover


@dataclass(frozen=True)
class JudgeSettings:
    """Numbers of the judgement, tuned together on the half "fitted" of the nights of `benchmarks/line_watch`."""

    acquire: int = 6  # lines that only find the shift, before the first is judged
    reach: tuple[int, int] = (3, 5)  # rows and columns about the predicted shift
    jump_reach: tuple[int, int] = (12, 16)  # the same for a sample that has jumped
    near: tuple[int, int] = (1, 2)  # the same about a shift that a search has found
    most_jumps: int = 3  # in one scan
    remembered: int = 24  # lines for the search after a jump
    # standard deviations beyond the usual, by the median of these lines, up to which a jump explains them. With 1, a
    # jump of the sample was taken for a changed tip in row 11 of an unseen night.
    explained: float = 1.5
    newest: int = 4  # lines since a change that a jump must explain, at least
    per_pixel: float = 0.03  # standard deviations that a pixel of a jump costs: short jumps are likelier than long ones
    drift: float = 1.0  # standard deviations above the usual difference beyond which a line lets the sum grow
    # in pixels: two scans without drift between them show too small a misfit of steep flanks
    least_per_slope: float = 0.06
    spike: float = 6.0  # standard deviations beyond which a single pixel of a good scan is removed as a spike
    scar: float = 4.0  # standard deviations beyond which a row of a good scan is no measure of later ones
    most: float = 6.0  # standard deviations that one line adds at most
    # least threshold. A floor of 20, in place of the least alike of few pairs (`ENOUGH_PAIRS`), stopped 8 of 512 good
    # scans instead of 6.
    floor: float = 15.0
    factor: float = 2.0  # of a threshold to the highest sum of good scans
    # rows since a change before an alarm: three fit wrong places of a flat step, as after a jump
    fewest_suspect: int = 6
    # rows since a change before a scan is stopped, after a second search for a jump with more lines. With six, an
    # unseen night was stopped 68 rows before its tip changed; with ten, 7 rows after.
    fewest_stop: int = 10
    look: float = 0.6  # share of the threshold above which a person should look
    # number and width, relative to the line, of parts that a changed sample may fill
    parts: tuple[tuple[int, float], ...] = ((1, 1 / 4), (2, 1 / 8))
    # share of the threshold that the rest of the lines must reach before a scan is stopped. New adatoms and dragged
    # particles reached 0.06, two tips that change at few steps and scratches 0.3.
    elsewhere: float = 0.25
    # rows of a cell, its width relative to the line, and the share of the cells that new adatoms may fill
    cell: tuple[int, float, float] = (4, 1 / 16, 0.4)
    alike: float = 0.4  # correlation of the differences with the steepness of the sample, above which a tip made them
    alike_px: int = 16  # farthest shift of a ghost for that
    unexplained: float = 0.4  # share of the threshold that another cause than the tip may leave
    # share of the sum that another cause may leave, if that is more than `unexplained`; each of 9 changed tips left a
    # third or more
    left: float = 0.25
    # share of the rows for which a sum grows before the change counts as the tip's, and not as a single adsorbate's.
    # Without this rule a double tip among few particles in 64 rows never stopped a scan.
    lasting: float = 3 / 8
    # power of a hum relative to the frequencies beside it. Of 80 scans with hum, 20 raised an alarm, 19 of these with
    # such a peak; so did 7 of 45 changed tips, and were stopped in the same rows without it.
    hum_peak: float = 6.0
    beside_hum: tuple[float, float] = (2.5, 5.5)  # periods per line from the peak: a Hann window widens it by two
    finer: int = 8  # steps of frequency in a period per line: two steps off leave a twentieth of a hum's power
    most_hums: int = 3  # frequencies in one scan
    least_spread: float = 0.05  # of the image's part
    newer: float = 0.15  # weight of the newest line in the spectrum of the noise


FITTED: Final = JudgeSettings()


class AlarmLevel(Enum):
    """Action that an alarm calls for: a person looks, or the scan is stopped."""

    LOOK = "look"
    STOP = "stop"


@dataclass(frozen=True)
class Alarm:
    """An alarm: the lines of a running scan differ from an earlier scan with a good tip.

    Attributes:
        level: see `AlarmLevel`.
        row: index of the line that raised the alarm.
        since_row: index of the first changed line, according to the CUSUM.
        evidence: CUSUM relative to the threshold of this kind of scan.
        why: explanation, for people.
    """

    level: AlarmLevel
    row: int
    since_row: int
    evidence: float
    why: str


@dataclass(frozen=True)
class Kind:
    """A kind of scan. Only scans of equal size, angle, pixels and condition are compared.

    Attributes:
        condition: other settings that must be equal, such as the setpoint.
    """

    size_m: tuple[float, float]
    angle_rad: float
    shape: tuple[int, int]
    condition: str = ""

    @classmethod
    def of(cls, region: Region, shape: tuple[int, int], condition: str) -> Kind:
        return cls(region.size_m, region.angle_rad, shape, condition)

    def fits(self, other: Kind) -> bool:
        sizes = zip(self.size_m, other.size_m, strict=True)
        turned_rad = math.remainder(self.angle_rad - other.angle_rad, math.tau)
        return (
            all(abs(a / b - 1.0) < SAME_SIZE for a, b in sizes)
            and abs(turned_rad) < SAME_SIZE
            and (self.shape, self.condition) == (other.shape, other.condition)
        )


@dataclass(frozen=True)
class PairStatistics:
    """Statistics of the differences between the lines of two good scans.

    Attributes:
        flat_m: standard deviation on flat pixels.
        per_slope: further difference in m for each m per pixel of slope, added in quadrature.
        usual, spread: centre and spread of the image's part of a line's difference.
        highest: highest value of the CUSUM.
        noise: usual square of the noise's part.
    """

    flat_m: float
    per_slope: float
    usual: float
    spread: float
    highest: float
    noise: float

    @property
    def size_m2(self) -> float:
        """Mean square of the image's part that a good line may reach."""
        return (max(0.0, self.usual) + 2.0 * self.spread) * self.flat_m**2


@dataclass
class Place:
    """An earlier scan with a good tip, as a reference for its place.

    Attributes:
        at_s: end of the scan.
        templates: trace and, if recorded, retrace.
        slipped: displacement of the sample by jumps since the scan, besides its drift, in pixels (rows, columns).
    """

    region: Region
    at_s: float
    templates: tuple[RowTemplate, ...]
    slipped: Shift = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class WholeScan:
    """A complete scan.

    Attributes:
        picture: heights in m, [y, x], of trace and, if recorded, retrace.
        at_s: end of the scan.
        downwards: whether the lines arrived from last to first.
    """

    picture: Sequence[Array]
    region: Region
    kind: Kind
    at_s: float
    downwards: bool = False


@dataclass
class KindReference:
    """Reference scans and statistics of one kind of scan.

    Attributes:
        places: earlier scans, newest last.
        pairs: statistics of pairs of scans of one place, newest last.
        speeds: changes of the shift in (rows, columns) per second, newest last.
    """

    kind: Kind
    places: list[Place] = field(default_factory=list)
    pairs: list[PairStatistics] = field(default_factory=list)
    speeds: list[Shift] = field(default_factory=list)

    def place(self, region: Region) -> Place | None:
        """Return the newest earlier scan that covers at least half the width and height of a region, or None."""
        for place in reversed(self.places):
            if max(abs(away) for away in self._away(place, region)) <= 1.0 - LEAST_COMMON:
                return place
        return None

    def shift(self, place: Place, region: Region, at_s: float) -> Shift:
        """Return the predicted shift, in pixels, between an earlier scan and a scan of a region."""
        passed_s, (down, along) = at_s - place.at_s, self._undrifted(place, region)
        # the median: a sample that has jumped once does not drift
        rows_per_s, columns_per_s = np.median(self.speeds, axis=0) if self.speeds else (0.0, 0.0)
        return down + passed_s * float(rows_per_s), along + passed_s * float(columns_per_s)

    def note_shift(self, place: Place, region: Region, at_s: float, found: Shift) -> None:
        """Learn the drift from the shift found at the end of a scan."""
        passed_s, (down, along) = at_s - place.at_s, self._undrifted(place, region)
        if passed_s > 0.0:
            self.speeds.append(((found[0] - down) / passed_s, (found[1] - along) / passed_s))
            del self.speeds[:-KEPT_SPEEDS]

    def note_jump(self, place: Place, region: Region, at_s: float, found: Shift) -> None:
        """Move an earlier scan to the shift found at the end of a scan during which the sample has jumped."""
        (down, along), (rows, columns) = self.shift(place, region, at_s), place.slipped
        place.slipped = (rows + found[0] - down, columns + found[1] - along)

    def _undrifted(self, place: Place, region: Region) -> Shift:
        (along, down), (ny, nx), (rows, columns) = self._away(place, region), self.kind.shape, place.slipped
        return rows + down * (ny - 1), columns + along * (nx - 1)

    def _away(self, place: Place, region: Region) -> tuple[float, float]:
        by = region.compared(place.region)
        return -by.along, -by.across


@dataclass
class Cusum:
    """Cumulative sum (CUSUM) of the excess over the usual difference; never negative.

    Attributes:
        value: the sum.
        since: index of the line at which the sum last left zero; None for a sum of zero.
    """

    value: float = 0.0
    since: int | None = None

    def add(self, row: int, sigmas: float) -> None:
        self.value = max(0.0, self.value + min(sigmas, FITTED.most) - FITTED.drift)
        if self.value == 0.0:
            self.since = None
        elif self.since is None:
            self.since = row


def confidence(evidence: float) -> float:
    """Return a rough confidence that the tip has changed, assuming exponentially distributed evidence of good scans."""
    return 1.0 - math.exp(-GOOD_DECAY * max(0.0, evidence))


class LineStatistic:
    """Converter of a line's differences into standard deviations above the usual difference.

    Args:
        pairs: statistics of good pairs of scans, at least one.
    """

    def __init__(self, pairs: Sequence[PairStatistics]) -> None:
        if len(pairs) < ENOUGH_PAIRS:
            most_m2 = ODD_PAIR * min(pair.size_m2 for pair in pairs)
            pairs = [pair for pair in pairs if pair.size_m2 <= most_m2]
        # for few pairs the largest values: their median may lie well below the values of the next pair
        middle = np.median if len(pairs) >= ENOUGH_PAIRS else np.max
        self.flat_m, self.per_slope, self._usual, self._spread = (
            float(middle([getattr(pair, name) for pair in pairs]))
            for name in ("flat_m", "per_slope", "usual", "spread")
        )
        self.noise = float(np.median([pair.noise for pair in pairs]))
        self.pairs = len(pairs)
        highest = sorted(pair.highest for pair in pairs)
        # the highest of many may be of a scan whose tip had changed without an alarm
        self.threshold = max(FITTED.floor, FITTED.factor * highest[-2 if len(highest) >= FEWEST_PAIRS + 2 else -1])

    def sigma_m(self, steepness: Array) -> Array:
        return np.asarray(np.hypot(self.flat_m, self.per_slope * steepness))

    def sigmas(self, products: Array) -> float:
        """Return the image's part in standard deviations above the usual, from the products of `NoiseFilter`."""
        counted = products[np.isfinite(products)]
        if not counted.size:
            return 0.0
        # the mean of fewer pixels is noisier
        spread = self._spread * math.sqrt(products.size / counted.size)
        return (float(np.mean(counted)) - self._usual) / spread


class NoiseFilter:
    """Separator of a line's difference into the part of the image and the part of noise.

    Both recordings of a line share a change of the image; their noise is independent. So the difference of the two
    contains noise alone. Frequencies with more noise than usual get less weight: a hum fills few of them, and its two
    recordings may agree by chance.

    Attributes:
        square: mean square of the noise's part, over the newest lines, relative to `PairStatistics.flat_m` squared,
            without a removed hum.
    """

    def __init__(self, flat_m: float, per_slope: float) -> None:
        self._flat_m, self._per_slope = flat_m, per_slope
        self._power: Array | None = None
        self._count = 1
        self.square = 1.0

    def add(self, fits: Sequence[RowFit]) -> Array:
        """Learn the noise of a line, and return its products; see `products`."""
        first, second = self.relative(fits)
        there = np.isfinite(first + second)
        noise = np.where(there, first - second, 0.0) / math.sqrt(2.0)
        power = np.abs(np.fft.rfft(noise)) ** 2 / max(1, int(there.sum()))
        power = np.convolve(np.pad(power, 1, mode="edge"), np.full(3, 1 / 3), mode="valid")
        before = np.ones_like(power) if self._power is None else self._power
        self._count += 1
        self._power = before + max(FITTED.newer, 1.0 / self._count) * (power - before)
        self.square = float(self._power.mean())
        return self.products(fits)

    def products(self, fits: Sequence[RowFit]) -> Array:
        """Return the products of both recordings' differences at each pixel, noisy frequencies reduced."""
        first, second = self.relative(fits)
        there = np.isfinite(first + second)
        if self._power is not None:
            reduced = 1.0 / np.sqrt(np.maximum(1.0, self._power))
            first, second = (
                np.fft.irfft(reduced * np.fft.rfft(np.where(there, one, 0.0)), n=one.size) for one in (first, second)
            )
        return np.where(there, first * second, np.nan)

    def relative(self, fits: Sequence[RowFit]) -> tuple[Array, Array]:
        """Return the differences of both recordings relative to their usual sizes, clipped."""
        first, second = (
            np.clip(fit.residual / np.hypot(self._flat_m, self._per_slope * fit.steepness), -CLIP_SIGMAS, CLIP_SIGMAS)
            for fit in fits
        )
        return first, second


@dataclass
class _Comparer:
    place: Place
    registration: RowRegistration
    jumps: int = 0  # of the sample, in this scan
    before: RowFit | None = None  # the line before, without retrace
    hums: tuple[float, ...] = ()  # frequencies per pixel, removed from lines without retrace
    cause: Cause | None = None

    def follow(self, row: int, line: Sequence[Array]) -> None:
        self.registration.follow(row, line[0])

    def fits(self, row: int, line: Sequence[Array]) -> list[RowFit]:
        # two recordings of the image: trace and retrace, or a line and the one before; else none
        templates = self.place.templates
        found = [self.registration.fit(row, one, of, self.cause) for of, one in zip(templates, line, strict=True)]
        if len(line) == 1:
            if self.hums and found[0] is not None:
                # fitted again: a hum moves the shift of its line
                found = [self.registration.fit(row, line[0] - _waves(found[0].residual, self.hums), cause=self.cause)]
            found.append(self.before)
            self.before = found[0]
        fits = [fit for fit in found if fit is not None]
        return fits if len(fits) == 2 else []


class ScanJudge:
    """Judge of the lines of one scan, in order of arrival; see `LineJudge.begin`.

    Attributes:
        alarm: last alarm; None without an alarm so far.
        fitted: remaining differences from the template, by row.
    """

    def __init__(self, comparer: _Comparer, statistic: LineStatistic, what: str) -> None:
        self.alarm: Alarm | None = None
        self.fitted: dict[int, list[RowFit]] = {}
        self._filter = NoiseFilter(statistic.flat_m, statistic.per_slope)
        self._disturbances = Disturbances(statistic.flat_m, statistic.per_slope, statistic.noise)
        self._comparer, self._statistic, self._what = comparer, statistic, what
        self._cusum = Cusum()
        self._sums: list[float] = []  # since the CUSUM last left zero
        self._home = comparer.registration.shift
        self._followed = 0
        self._hum = 0.0  # mean square of the removed hums, relative to flat_m squared
        self._recent: list[tuple[int, list[Array]]] = []
        self._without_ends: dict[int, list[Array]] = {}

    @property
    def threshold(self) -> float:
        """CUSUM at which a scan is stopped."""
        return self._statistic.threshold

    @property
    def evidence(self) -> float:
        """CUSUM relative to the threshold."""
        return self._cusum.value / self.threshold

    @property
    def noise(self) -> float:
        """Standard deviation of the newest lines' noise, relative to good scans; 1 before there are enough lines."""
        enough = self._followed >= FITTED.acquire + FITTED.remembered
        # a changed tip may have a narrow peak, too, but raises an alarm without it
        hum = self._hum if self.alarm is None else 0.0
        return math.sqrt((self._filter.square + hum) / self._statistic.noise) if enough else 1.0

    def add(self, row: int, line: Sequence[Array]) -> Alarm | None:
        """Judge a line; return an alarm if its level is higher than before, else None.

        Args:
            row: index of the line in the scan.
            line: heights in m of trace and, if recorded, retrace.
        """
        level = [levelled(values)[0] for values in line]
        if not all(np.isfinite(values).all() for values in level):
            return None  # a missing line is no evidence about the tip
        self._comparer.follow(row, level)
        self._recent = [*self._recent, (row, level)][-FITTED.remembered :]
        self._without_ends[row] = [without_ends(values, flat) for values, flat in zip(line, level, strict=True)]
        self._followed += 1
        fits = self._comparer.fits(row, level)
        if not fits:
            return None
        products = self._filter.add(fits)
        if self._followed <= FITTED.acquire:
            return None  # the scanner still creeps from its last move: the first lines only find the shift, and noise
        self.fitted[row] = fits
        disturbed = self._disturbances.add(row, fits)
        self._sum_up(row, self._statistic.sigmas(products))
        found = self._higher_level()
        while found is not None and self._hums():
            found = self._higher_level()
        if found is not None and self._has_jumped():
            self._cusum, self._sums, found = Cusum(), [], None
        if found is not None:
            return self._raised(found, row)
        if disturbed is None or self.alarm is not None:
            return None
        since, why = disturbed
        self.alarm = Alarm(AlarmLevel.LOOK, row, since, FITTED.look, why)
        return self.alarm

    def _raised(self, level: AlarmLevel, row: int) -> Alarm | None:
        since = row if self._cusum.since is None else self._cusum.since
        basis = f"{self.evidence:.1f} times the threshold from {self._statistic.pairs} good pairs of scans"
        evidence, cause = self.evidence, self._cause()
        if cause and level is AlarmLevel.STOP:
            self._cusum, self._sums = Cusum(), []  # only a further change may stop the scan
            if self.alarm is not None:
                return None
            level = AlarmLevel.LOOK
        why = f"{self._what} since row {since} ({basis}){cause and '; ' + cause}"
        self.alarm = Alarm(level, row, since, evidence, why)
        return self.alarm

    def _sum_up(self, row: int, sigmas: float) -> None:
        self._cusum.add(row, sigmas)
        self._sums = [*self._sums, self._cusum.value] if self._cusum.value else []

    def _higher_level(self) -> AlarmLevel | None:
        found = self._level()
        return None if self.alarm is not None and self.alarm.level in (found, AlarmLevel.STOP) else found

    def _level(self) -> AlarmLevel | None:
        suspects = sum(self._is_suspect(row) for row, _ in self._recent)
        if (
            self.evidence >= 1.0
            and suspects >= FITTED.fewest_stop
            and (self._is_everywhere() or self._lasts())
            and (not self._is_in_spots() or self._is_alike())
        ):
            return AlarmLevel.STOP
        return AlarmLevel.LOOK if self.evidence >= FITTED.look and suspects >= FITTED.fewest_suspect else None

    def _is_everywhere(self) -> bool:
        # whether the lines differ also outside of the few parts in which they differ most
        suspects = [(row, line) for row, line in self._recent if self._is_suspect(row)]
        products = [self._filter.products(fits) for row, _ in suspects if (fits := self.fitted.get(row))]
        total = np.sum([np.nan_to_num(one) for one in products], axis=0)
        return all(self._differ(suspects, _elsewhere(total, *parts)) for parts in FITTED.parts)

    def _is_in_spots(self) -> bool:
        # whether the lines differ in few cells of rows and columns alone, as several new adatoms do
        lines = [(row, line) for row, line in self._recent if self._is_suspect(row) and self.fitted.get(row)]
        products = np.array([np.nan_to_num(self._filter.products(self.fitted[row])) for row, _ in lines])
        return not self._differ(lines, _outside_of_spots(products, *FITTED.cell))

    def _is_alike(self) -> bool:
        # whether the lines since the change differ where the sample is steep: a sample with few features has few edges
        # that a tip widens, and few ghosts of them, which fill no more cells than adatoms
        rows = list(self.fitted)
        since = rows.index(self._cusum.since) if self._cusum.since in rows else 0
        lines = [fits for row in rows[since:] if (fits := self.fitted[row])]
        differ = np.nan_to_num([np.mean([fit.residual for fit in fits], axis=0) for fits in lines])
        steep = np.array([fits[0].steepness for fits in lines])
        return _highest_correlation(np.abs(differ), steep, FITTED.alike_px) >= FITTED.alike

    def _lasts(self) -> bool:
        rows = round(FITTED.lasting * len(self._comparer.place.templates[0].heights))
        return len(self._sums) >= rows and self._sums[-1] > self._sums[-1 - rows // 4]

    def _cause(self) -> str:
        # what explains the lines without a changed tip, or ""
        suspects = [(row, line) for row, line in self._recent if self._is_suspect(row) and self.fitted.get(row)]
        if not suspects:
            return ""
        before = [self.fitted[row] for row, _ in suspects]
        again = replace(self._comparer, before=None)
        if self._is_explained([again.fits(row, self._without_ends[row]) for row, _ in suspects]):
            return "they lie at the end of the range of heights"
        again = replace(self._comparer, before=None, cause=of_height)
        after = [again.fits(row, line) for row, line in suspects]
        if self._is_explained(after):
            # on lamellae, slopes beside a pixel add up to its height, so that a large change looks like overshoot
            return "they follow the height, as with another contrast" if is_slight(before, after) else ""
        has_retrace = len(self._comparer.place.templates) > 1
        if self._is_explained(without_overshoot(before, has_retrace=has_retrace)):
            return "they follow each edge, as with a feedback that overshoots"
        return ""

    def _is_explained(self, lines: Sequence[Sequence[RowFit]]) -> bool:
        # whether little of the sum is left, in enough lines that can still be compared
        cusum, highest, compared = Cusum(), 0.0, [fits for fits in lines if fits]
        for number, fits in enumerate(compared):
            cusum.add(number, self._sigmas(fits))
            highest = max(highest, cusum.value)
        little = max(FITTED.unexplained * self.threshold, FITTED.left * self._cusum.value)
        return 2 * len(compared) > len(lines) and highest < little

    def _differ(self, lines: Sequence[tuple[int, Sequence[Array]]], where: NDArray[np.bool_]) -> bool:
        # fitted again: an adsorbate moves the shift of its line, which then differs everywhere (3 of 20 scans with a
        # new adatom were stopped)
        again = replace(self._comparer, before=None)
        cusum, highest = Cusum(), 0.0
        for (row, line), there in zip(lines, np.broadcast_to(where, (len(lines), where.shape[-1])), strict=True):
            if fits := again.fits(row, [np.where(there, values, np.nan) for values in line]):
                cusum.add(row, self._sigmas(fits))
                highest = max(highest, cusum.value)
        return highest >= FITTED.elsewhere * self.threshold

    def _sigmas(self, fits: Sequence[RowFit]) -> float:
        return self._statistic.sigmas(self._filter.products(fits))

    def _hums(self) -> bool:
        # whether a hum was found and removed, and the sum taken again
        comparer = self._comparer
        if len(comparer.place.templates) > 1 or len(comparer.hums) == FITTED.most_hums:
            return False
        suspects = [row for row, _ in self._recent if self._is_suspect(row) and self.fitted.get(row)]
        if not suspects:
            return False
        peak, frequency = _narrowest(np.array([self._filter.relative(self.fitted[row])[0] for row in suspects]))
        if peak < FITTED.hum_peak:
            return False
        waves = [_waves(self.fitted[row][0].residual, [frequency]) for row in suspects]
        self._hum += float(np.mean(np.square(waves))) / self._statistic.flat_m**2
        comparer.hums = (*comparer.hums, frequency)
        comparer.before = None
        for row, line in self._recent:
            fits = comparer.fits(row, line)
            if row in self.fitted:
                self.fitted[row] = fits
        self._cusum, self._sums = Cusum(), []
        for row in suspects:
            if self.fitted[row]:
                self._sum_up(row, self._sigmas(self.fitted[row]))
        return True

    def _has_jumped(self) -> bool:
        if self._comparer.jumps >= FITTED.most_jumps:
            return False
        # since the change, for a sample that has jumped; all lines, for a lattice that was matched one period away
        suspects = [(row, line) for row, line in self._recent if self._is_suspect(row)]
        # the older half may lie before the jump
        newest = suspects[-max(FITTED.newest, (len(suspects) + 1) // 2) :]
        template, statistic = self._comparer.place.templates[0], self._statistic
        # a contaminated tip spoils some lines at any shift, and leaves the others as they were
        odd = {row for row, _ in newest if (fits := self.fitted.get(row)) and self._sigmas(fits) > FITTED.explained}
        found: list[tuple[float, RowRegistration]] = []
        for lines in (newest, self._recent):
            traces = [(row, line[0]) for row, line in lines]
            about = self._comparer.registration.shift
            likely = likely_shifts(template, traces, about, FITTED.jump_reach, statistic.flat_m)
            # an earlier jump may have been none, and an earlier scan may itself have jumped back on its way
            for shift in (*likely, self._home):
                registration = RowRegistration(template, shift, FITTED.near, steady=1.0)
                again = replace(self._comparer, registration=registration, before=None)
                for row, line in lines:
                    again.follow(row, line)
                sigmas = {row: self._sigmas(fits) for row, line in newest if (fits := again.fits(row, line))}
                off = max(_median(sigmas.values()), _median([of for row, of in sigmas.items() if row in odd]))
                if 2 * len(sigmas) > len(newest) and off < FITTED.explained:
                    far = math.dist(again.registration.shift, self._home)
                    found.append((max(0.0, off) + FITTED.per_pixel * far, again.registration))
        if not found:
            return False
        self._comparer.jumps += 1
        shift = min(found, key=lambda one: one[0])[1].shift
        self._comparer.registration = RowRegistration(template, shift, FITTED.reach)
        for row, line in newest:
            self._comparer.follow(row, line)
            self.fitted[row] = self._comparer.fits(row, line)
        return True

    def _is_suspect(self, row: int) -> bool:
        numbers = [number for number, _ in self._recent]
        since = self._cusum.since
        return since is None or since not in numbers or numbers.index(row) >= numbers.index(since)


def _elsewhere(total: Array, parts: int, width: float) -> NDArray[np.bool_]:
    # the pixels outside of the parts with the largest sums
    elsewhere = np.ones(total.size, dtype=bool)
    wide = max(1, round(width * total.size))
    for _ in range(parts):
        inside = np.convolve(np.where(elsewhere, total, 0.0), np.ones(wide), mode="valid")
        first = int(inside.argmax())
        elsewhere[first : first + wide] = False
    return elsewhere


def _outside_of_spots(products: Array, rows: int, width: float, most: float) -> NDArray[np.bool_]:
    # the pixels of each line outside of the cells with the largest sums
    (count, pixels), columns = products.shape, max(1, round(width * products.shape[1]))
    padded = np.pad(products, ((0, -count % rows), (0, -pixels % columns)))
    cells = padded.reshape(padded.shape[0] // rows, rows, -1, columns).sum(axis=(1, 3))
    outside = cells <= np.quantile(cells, 1.0 - most)
    return np.asarray(outside.repeat(rows, axis=0).repeat(columns, axis=1)[:count, :pixels])


def _highest_correlation(first: Array, second: Array, reach_px: int) -> float:
    # of two pictures, over all shifts within the reach
    first, second = first - np.median(first), second - np.median(second)
    padded = (2 * first.shape[0], 2 * first.shape[1])  # else one end would be shifted onto the other
    product = np.fft.irfft2(np.fft.rfft2(first, padded) * np.conj(np.fft.rfft2(second, padded)), padded)
    for axis, size in enumerate(first.shape):
        reach = min(reach_px, size - 1)
        product = np.take(product, range(-reach, reach + 1), axis=axis, mode="wrap")
    return float(product.max() / max(np.linalg.norm(first) * np.linalg.norm(second), 1e-30))


def _narrowest(lines: Array) -> tuple[float, float]:
    # the highest peak in the spectrum, relative to the higher of both sides, and its frequency per pixel
    count = lines.shape[1]
    power = np.mean(np.abs(np.fft.rfft(np.nan_to_num(lines) * np.hanning(count), n=FITTED.finer * count)) ** 2, axis=0)
    near, far = (round(FITTED.finer * periods) for periods in FITTED.beside_hum)
    sums = np.append(0.0, np.cumsum(np.pad(power, far, mode="reflect")))
    means = (sums[far - near + 1 :] - sums[: -(far - near + 1)]) / (far - near + 1)
    beside = np.maximum(means[: power.size], means[far + near :][: power.size])
    at = int(np.argmax(power / beside))
    return float(power[at] / beside[at]), at / (FITTED.finer * count)


def _waves(residual: Array, hums: Sequence[float]) -> Array:
    # the least squares' waves of these frequencies in a residual
    turns = math.tau * np.outer(np.arange(residual.size), hums)
    basis, there = np.concatenate([np.cos(turns), np.sin(turns)], axis=1), np.isfinite(residual)
    return np.asarray(basis @ np.linalg.lstsq(basis[there], residual[there], rcond=None)[0])


def _median(values: Collection[float]) -> float:
    return float(np.median(list(values))) if values else 0.0


@dataclass
class _OddRows:
    # rows of a good scan with a scar, and single pixels with a spike: no measure of later scans
    doubtful: set[int] = field(default_factory=set)
    spikes: list[tuple[int, int, Array]] = field(default_factory=list)

    def note(self, row: int, fits: Sequence[RowFit], statistic: LineStatistic, sigmas: float) -> None:
        if sigmas > FITTED.scar:
            self.doubtful.add(row)
        for channel, fit in enumerate(fits):
            off = np.nan_to_num(np.abs(fit.residual) / statistic.sigma_m(fit.steepness))
            beside = np.maximum(np.append(off[1:], 0.0), np.append(0.0, off[:-1]))
            alone = (off > FITTED.spike) & (beside < 0.5 * off)
            if alone.any():
                self.spikes.append((channel, row, np.where(alone, fit.residual, 0.0)))

    def cleaned(self, values: Array, channel: int) -> Array:
        clean = values.copy()
        for of, row, spike in self.spikes:
            if of == channel:
                clean[row] -= spike
        return clean


class LineJudge:
    """Judge of running scans, which learns from scans with a good tip."""

    def __init__(self) -> None:
        self._kinds: list[KindReference] = []

    def pairs(self, kind: Kind) -> int:
        """Return the number of known pairs of good scans of a kind."""
        known = self._known(kind)
        return 0 if known is None else len(known.pairs)

    def begin(self, region: Region, kind: Kind, at_s: float, *, channels: int) -> ScanJudge | None:
        """Return the judge of a scan that begins at `at_s`, or None if the scan can't be judged (see `lacking`).

        Args:
            channels: 2 with retrace, 1 without.
        """
        known = self._known(kind)
        if known is None:
            return None
        place = known.place(region)
        if place is not None and len(place.templates) == channels and len(known.pairs) >= FEWEST_PAIRS:
            registration = RowRegistration(place.templates[0], known.shift(place, region, at_s), FITTED.reach)
            what = "lines differ from the earlier scan of this place"
            return ScanJudge(_Comparer(place, registration), LineStatistic(known.pairs), what)
        return None

    def lacking(self, region: Region, kind: Kind, *, channels: int) -> str:
        """Return the reason why `begin` returns None for a scan, for people; empty if the scan can be judged."""
        known = self._known(kind)
        if known is None or (place := known.place(region)) is None:
            return "no earlier scan of this size, angle, pixels and feedback shows the place"
        if len(place.templates) != channels:
            return f"the earlier scan of the place has {len(place.templates)} channels of heights, not {channels}"
        if len(known.pairs) < FEWEST_PAIRS:
            return f"{len(known.pairs) + 1} of {FEWEST_PAIRS + 1} good scans of its kind are known"
        return ""

    def learn(
        self,
        picture: Sequence[Array],
        region: Region,
        kind: Kind,
        at_s: float,
        *,
        downwards: bool = False,
        again: bool = False,
    ) -> None:
        """Learn from a complete scan with a good tip.

        A scan during which the sample has jumped is not used as a reference for its place.

        Args:
            picture: heights in m, [y, x], of trace and, if recorded, retrace.
            at_s: end of the scan.
            downwards: whether the lines arrived from last to first.
            again: whether the scan only becomes a reference for its place, as one from which the process has learnt
                before its restart.
        """
        known = self._known(kind) or self._new(kind)
        self._kinds.remove(known)
        self._kinds.append(known)
        place = known.place(region)
        odd = _OddRows() if again else self._compare(known, place, picture, region, at_s, downwards=downwards)
        if odd is None:
            return
        templates = tuple(RowTemplate.of(odd.cleaned(values, n), odd.doubtful) for n, values in enumerate(picture))
        known.places = [one for one in known.places if one is not place]
        known.places.append(Place(region, at_s, templates))
        del known.places[:-MOST_PLACES]

    def _compare(
        self,
        known: KindReference,
        place: Place | None,
        picture: Sequence[Array],
        region: Region,
        at_s: float,
        *,
        downwards: bool,
    ) -> _OddRows | None:
        # None: the sample has jumped during the scan, whose two halves don't fit together: no reference for later ones
        odd = _OddRows()
        lines = [(row, [levelled(values[row])[0] for values in picture]) for row in range(len(picture[0]))]
        lines = [(row, line) for row, line in lines if all(np.isfinite(values).all() for values in line)]
        if downwards:
            lines.reverse()
        if len(lines) <= FITTED.acquire:
            return odd
        if place is not None and len(place.templates) == len(picture):
            comparer = _Comparer(
                place, RowRegistration(place.templates[0], known.shift(place, region, at_s), FITTED.reach)
            )
            _append(known.pairs, _statistics(comparer, lines, known.pairs, odd))
            if comparer.jumps:
                known.note_jump(place, region, at_s, comparer.registration.shift)
                return None
            known.note_shift(place, region, at_s, comparer.registration.shift)
        return odd

    def agree(self, earlier: WholeScan, later: WholeScan) -> bool:
        """Return whether a scan raises no alarm against an earlier one, and both show the same place."""
        known = self._known(later.kind)
        if known is None or len(known.pairs) < FEWEST_PAIRS or len(earlier.picture) != len(later.picture):
            return False
        place = Place(earlier.region, earlier.at_s, tuple(map(RowTemplate.of, earlier.picture)))
        alone = replace(known, places=[place])
        if not earlier.kind.fits(later.kind) or alone.place(later.region) is None:
            return False
        registration = RowRegistration(place.templates[0], alone.shift(place, later.region, later.at_s), FITTED.reach)
        running = ScanJudge(_Comparer(place, registration), LineStatistic(known.pairs), "")
        rows = range(len(later.picture[0]))
        return all(
            running.add(row, [values[row] for values in later.picture]) is None
            for row in (reversed(rows) if later.downwards else rows)
        )

    def state(self) -> Plain:
        """Return the statistics of each kind of scan as JSON data, to save. Earlier scans are left out."""
        return {"kinds": [to_plain(replace(one, places=[], speeds=[]), lists=True) for one in self._kinds]}

    def restore(self, state: Plain) -> None:
        self._kinds = [from_plain(KindReference, kept) for kept in state["kinds"]]

    def forget_places(self) -> None:
        """Forget all earlier scans, since the tip has changed. The statistics of each kind are kept."""
        for kind in self._kinds:
            kind.places.clear()

    def _known(self, kind: Kind) -> KindReference | None:
        return next((one for one in reversed(self._kinds) if one.kind.fits(kind)), None)

    def _new(self, kind: Kind) -> KindReference:
        if len(self._kinds) >= MOST_KINDS:
            # the rest of a stopped scan is a kind that never returns: it must not cost a known one its place
            unknown = (one for one in self._kinds if len(one.pairs) < FEWEST_PAIRS)
            self._kinds.remove(next(unknown, self._kinds[0]))
        self._kinds.append(KindReference(kind))
        return self._kinds[-1]


def _append(pairs: list[PairStatistics], found: PairStatistics | None) -> None:
    if found is not None:
        pairs.append(found)
        del pairs[:-KEPT_PAIRS]


def _statistics(
    comparer: _Comparer,
    lines: Sequence[tuple[int, list[Array]]],
    before: Sequence[PairStatistics],
    odd: _OddRows,
) -> PairStatistics | None:
    if before:
        # as a running scan: a sample that jumps is registered again
        running = ScanJudge(comparer, LineStatistic(before), "")
        for row, line in lines:
            running.add(row, line)
        fitted = [(row, fits) for row, fits in running.fitted.items() if fits]
    else:
        fitted = []
        for number, (row, line) in enumerate(lines):
            comparer.follow(row, line)
            if number >= FITTED.acquire and (fits := comparer.fits(row, line)):
                fitted.append((row, fits))
    if len(fitted) < len(lines) // 2:
        return None
    flat_m, per_slope = _expected([fit for _, fits in fitted for fit in fits])
    own, noise = [], []
    filtering = NoiseFilter(flat_m, per_slope)
    for _, fits in fitted:
        own.append(float(np.nanmean(filtering.add(fits))))
        noise.append(filtering.square)
    usual = float(np.median(own))
    spread = max(float(np.quantile(own, 0.84)) - usual, FITTED.least_spread)
    pair = PairStatistics(flat_m, per_slope, usual, spread, 0.0, float(np.median(noise)))
    # judged by the other pairs, as a running scan is
    highest = _highest(LineStatistic(before or [pair]), fitted, comparer, odd)
    if before and highest > FITTED.floor:
        # a pair that differs all along raises the usual difference: only its excess over that counts as a sum
        highest = min(highest, max(FITTED.floor, _highest(LineStatistic([*before, pair]), fitted, comparer)))
    return replace(pair, highest=highest)


def _highest(
    statistic: LineStatistic,
    fitted: Sequence[tuple[int, list[RowFit]]],
    comparer: _Comparer,
    odd: _OddRows | None = None,
) -> float:
    cusum, highest, filtering = Cusum(), 0.0, NoiseFilter(statistic.flat_m, statistic.per_slope)
    for row, fits in fitted:
        sigmas = statistic.sigmas(filtering.add(fits))
        if odd is not None:
            odd.note(row, fits[: len(comparer.place.templates)], statistic, sigmas)
        cusum.add(row, sigmas)
        highest = max(highest, cusum.value)
    return highest


def _expected(fits: Sequence[RowFit]) -> tuple[float, float]:
    residual = np.concatenate([fit.residual for fit in fits])
    steepness = np.concatenate([fit.steepness for fit in fits])
    there = np.isfinite(residual)
    residual, steepness = residual[there], steepness[there]
    flat = steepness <= np.quantile(steepness, 0.4)
    steep = steepness >= np.quantile(steepness, 0.9)
    flat_m = residual_spread(residual[flat])
    beyond = max(0.0, residual_spread(residual[steep]) ** 2 - flat_m**2)
    return flat_m, max(FITTED.least_per_slope, math.sqrt(beyond) / max(float(np.median(steepness[steep])), 1e-15))
