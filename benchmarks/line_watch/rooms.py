"""Scans of noisy rooms and changing samples, to which nothing of `LineWatch` is fitted.

Surfaces, tip and noise are those of `benchmarks.drift.foreign_pairs`, besides grains and fibres of this module. A room
has three good scans to learn from. Each kind of later scan (`KINDS`) is then judged as the fourth scan, so that the
threshold comes from two pairs of scans. Settings of the watch may be tried on the half "tried"; the half "kept" has
other surfaces, and gives the figures of the docs.

Lengths are in pixels of the scan, heights in standard deviations of the surface until `HEIGHT_M` scales them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import ndimage, signal, spatial

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.line_watch.line_judge import AlarmLevel, Kind, LineJudge
from afspm.plugins.line_watch.registration import levelled
from benchmarks.drift import foreign_pairs

Random = np.random.Generator
Half = Literal["tried", "kept"]

PIXELS, LEARNT, WITHIN = 128, 3, 20
MARGIN_PX, FINE = 40.0, foreign_pairs.FINE
LINE_S, PERIOD_S = 1.0, 160.0
HEIGHT_M = 3e-9
REGION = Region((0.0, 0.0), (1.5e-6, 1.5e-6))
ROOM_KINDS = (
    "nothing", "noise x 1.2", "noise x 1.5", "hum", "bump of the table", "drift", "creep", "missing rows", "zero rows",
)  # fmt: skip
SAMPLE_KINDS = ("an adatom appears", "a particle is dragged")
CONTRAST_KINDS = ("overshoot", "saturation", "bent contrast", "z scale")
TIP_KINDS = ("blunt tip", "double tip", "debris on the tip")
NOISE_KINDS = ("streaks", "noise burst")
EVAPORATED_KINDS = ("several adatoms appear",)
KINDS = (*ROOM_KINDS, *SAMPLE_KINDS, *CONTRAST_KINDS, *TIP_KINDS, *NOISE_KINDS, *EVAPORATED_KINDS)


def grains(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return plateaus of random heights between grooves."""
    half, size = float(x.max()), sample.uniform(12.0, 30.0)
    seeds = place.uniform(-half - size, half + size, (int((2.0 * (half + size) / size) ** 2), 2))
    away, grain = (np.asarray(one) for one in spatial.KDTree(seeds).query(np.stack([x, y], axis=-1), k=2))
    groove = np.exp(-(away[..., 1] - away[..., 0]) / sample.uniform(1.0, 3.0))
    return np.asarray(place.normal(0.0, 1.0, len(seeds))[grain[..., 0]] - sample.uniform(0.5, 2.0) * groove)


def fibres(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return bent fibres that lie on a rough ground, and on each other."""
    height = sample.uniform(0.1, 0.4) * foreign_pairs.field(place, x.shape, sample.uniform(4.0, 20.0), 3.0)
    radius, half = sample.uniform(1.5, 4.0), float(x.max())
    for _ in range(int(half * sample.uniform(0.15, 0.4))):
        turn, off, bend = place.uniform(0.0, np.pi), place.uniform(-half, half), place.normal(0.0, 0.004)
        along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        beside = np.abs(across - off - bend * along**2) / radius
        height += 1.5 * np.sqrt(np.maximum(0.0, 1.0 - beside**2))
    return np.asarray(height)


SURFACES: dict[Half, dict[str, Callable[[Random, Random, Array, Array], Array]]] = {
    "tried": {name: foreign_pairs.SURFACES[name] for name in ("stamper", "particles")},
    "kept": {name: foreign_pairs.SURFACES[name] for name in ("rough", "lattice", "steps")}
    | {"grains": grains, "fibres": fibres},
}


@dataclass(frozen=True)
class JudgedScan:
    """The outcome of one scan.

    Attributes:
        at_row: first row that differs from a good scan; 0 where all do.
        is_visible: whether the change is above the noise in a quarter of the 20 rows after it; for changed tips.
        look_row, stop_row: rows of the first alarms of these levels or above, or None.
        noisier: highest noise reported, relative to the usual.
    """

    half: Half
    surface: str
    seed: int
    kind: str
    at_row: int
    is_visible: bool
    look_row: int | None
    stop_row: int | None
    noisier: float

    @property
    def is_seen(self) -> bool:
        return self.stop_row is not None and self.at_row <= self.stop_row <= self.at_row + WITHIN

    @property
    def is_looked_at(self) -> bool:
        return self.look_row is not None and self.at_row <= self.look_row <= self.at_row + WITHIN


@dataclass(frozen=True)
class _RoomTip:
    slope: float  # of a pyramid, per pixel
    second_px: tuple[float, float] | None = None
    second_below: float = 0.0


class Room:
    """A room of a half, by its seed, with scans of one place."""

    def __init__(self, half: Half, seed: int) -> None:
        self.half, self.seed = half, seed
        self.random = np.random.default_rng([58, ("tried", "kept").index(half), seed])
        names = tuple(SURFACES[half])
        self.surface = names[seed % len(names)]
        drawn = np.random.default_rng(self.random.integers(1 << 32))
        reach = PIXELS / 2 + MARGIN_PX
        axis = np.linspace(-reach, reach, 2 * math.ceil(reach * FINE) + 1)
        made = SURFACES[half][self.surface](drawn, drawn, *np.meshgrid(axis, axis))
        self._axis, self._ground = axis, (made - made.mean()) / made.std()
        self._tip = _RoomTip(self.random.uniform(0.3, 0.9))
        self._noise = math.exp(self.random.uniform(math.log(0.02), math.log(0.12)))
        self._lag_px = self.random.normal(0.0, 0.5)
        self._heavy = self.random.random() < 0.5
        turn, speed = self.random.uniform(0.0, math.tau), math.exp(self.random.uniform(math.log(0.05), math.log(0.8)))
        self._drift_px = speed * np.array([math.cos(turn), math.sin(turn)])  # a period
        self._images: dict[_RoomTip, Array] = {}

    def judged(self, kinds: Sequence[str], *, channels: int) -> list[JudgedScan]:
        """Judge one scan of each kind, line by line."""
        learnt = self._taught(channels, self._drift_px)
        return [self._judged(kind, learnt, channels) for kind in kinds]

    def _taught(self, channels: int, drift_px: Array) -> LineJudge:
        judge = LineJudge()
        for number in range(LEARNT):
            picture = self._scan(number, drift_px)
            judge.learn(self._heights(picture[:channels]), REGION, _KIND, number * PERIOD_S + PIXELS * LINE_S)
        return judge

    def _judged(self, kind: str, learnt: LineJudge, channels: int) -> JudgedScan:
        row, drift_px = int(self.random.integers(12, 90)), self._drift_px
        if kind == "drift":
            drift_px = drift_px / math.hypot(*drift_px) * self.random.uniform(1.0, 6.0)
            learnt = self._taught(channels, drift_px)
        picture, is_visible = self._fourth(kind, row, drift_px)
        judge = copy.deepcopy(learnt).begin(REGION, _KIND, LEARNT * PERIOD_S, channels=channels)
        assert judge is not None
        look, stop, noisier = None, None, 1.0
        for number, line in enumerate(zip(*self._heights(picture[:channels]), strict=True)):
            alarm = judge.add(number, line)
            noisier = max(noisier, judge.noise)
            if alarm is not None and look is None:
                look = number
            if alarm is not None and alarm.level is AlarmLevel.STOP:
                stop = number
                break
        return JudgedScan(self.half, self.surface, self.seed, kind, row, is_visible, look, stop, noisier)

    def _fourth(self, kind: str, row: int, drift_px: Array) -> tuple[list[Array], bool]:
        random, noise = self.random, self._noise
        creep_px, length = np.zeros(2), 1.0
        if kind == "creep":
            turn = random.uniform(0.0, math.tau)
            creep_px = random.uniform(2.0, 6.0) * np.array([math.cos(turn), math.sin(turn)])
            length = random.uniform(4.0, 20.0)
        clean = self._clean(LEARNT, drift_px, self._image(self._tip), creep_px, length)
        if kind in (*SAMPLE_KINDS, *TIP_KINDS, *EVAPORATED_KINDS):
            image_before, image_after = self._changed(kind, row)
            after = self._clean(LEARNT, drift_px, image_after, creep_px, length)
            if kind not in TIP_KINDS:  # a dragged particle is at its first place until the tip meets it
                whole = self._clean(LEARNT, drift_px, image_before, creep_px, length)
                clean = [np.where(np.arange(PIXELS)[:, None] < row, a, b) for a, b in zip(whole, after, strict=True)]
            else:
                clean, was = (
                    [np.where(np.arange(PIXELS)[:, None] < row, a, b) for a, b in zip(clean, after, strict=True)],
                    clean,
                )
                off = np.sqrt(np.mean((levelled(clean[0]) - levelled(was[0])) ** 2, axis=1))[row + 1 : row + 1 + WITHIN]
                is_visible = bool(np.mean(off >= noise) >= 0.25)
        else:
            is_visible = False
        if kind in CONTRAST_KINDS and kind != "saturation":
            clean = self._contrast(kind, clean)
        if kind.startswith("noise x"):
            noise *= float(kind.removeprefix("noise x "))
        picture = self._recorded(clean, noise)
        if kind == "saturation":
            end = float(np.quantile(picture[0], random.uniform(0.85, 0.97)))
            picture = [np.minimum(values, end) for values in picture]
        if kind in NOISE_KINDS:
            self._disturb(kind, picture, row)
        if kind == "hum":
            self._hum(picture)
        if kind == "bump of the table":
            self._bump(picture, row)
        rows = random.permutation(PIXELS)[: random.integers(2, 9)]
        for values in picture:
            if kind == "missing rows":
                values[rows] = np.nan
            if kind == "zero rows":
                values[rows] = 0.0
        return picture, kind in TIP_KINDS and is_visible

    def _changed(self, kind: str, row: int) -> tuple[Array, Array]:
        # images before and after the change
        random, tip = self.random, self._tip
        before = self._image(tip)
        if kind == "blunt tip":
            return before, self._image(replace(tip, slope=tip.slope * random.uniform(0.3, 0.6)))
        if kind == "double tip":
            turn, away = random.uniform(0.0, math.tau), random.uniform(3.0, 12.0)
            second = (away * math.cos(turn), away * math.sin(turn))
            return before, self._image(replace(tip, second_px=second, second_below=random.uniform(0.0, 0.6)))
        if kind == "debris on the tip":  # soft, and to one side: it smears what lies along one direction
            long = random.uniform(3.0, 8.0)
            return before, np.asarray(ndimage.uniform_filter1d(before, int(long * FINE), axis=1))
        at = np.array([random.uniform(-50.0, 50.0), row - PIXELS / 2 + random.uniform(2.0, 12.0)])
        radius, height = random.uniform(2.0, 6.0), random.uniform(0.8, 2.5)
        if kind in EVAPORATED_KINDS:
            more = [random.uniform((-60.0, row - 60.0), (60.0, 60.0)) for _ in range(random.integers(2, 6))]
            return before, self._bulge([at, *more], radius, height)
        with_one = self._bulge([at], radius, height)
        if kind == "an adatom appears":
            return before, with_one
        turn, by = random.uniform(0.0, math.pi), random.uniform(4.0, 15.0)
        return with_one, self._bulge([at + by * np.array([math.cos(turn), math.sin(turn)])], radius, height)

    def _bulge(self, places: Sequence[Array], radius: float, height: float) -> Array:
        x, y = np.meshgrid(self._axis, self._axis)
        caps = [1.0 - ((x - at[0]) ** 2 + (y - at[1]) ** 2) / radius**2 for at in places]
        return _imaged(self._ground + height * np.maximum(0.0, caps).max(axis=0), self._tip)

    def _image(self, tip: _RoomTip) -> Array:
        if tip not in self._images:
            self._images[tip] = _imaged(self._ground, tip)
        return self._images[tip]

    def _scan(self, number: int, drift_px: Array) -> list[Array]:
        clean = self._clean(number, drift_px, self._image(self._tip), np.zeros(2), 1.0)
        return self._recorded(clean, self._noise)

    def _clean(self, number: int, drift_px: Array, image: Array, creep_px: Array, length: float) -> list[Array]:
        rows, columns = np.meshgrid(np.arange(PIXELS), np.arange(PIXELS), indexing="ij")
        periods = number + rows * LINE_S / PERIOD_S
        crept = np.exp(-rows / length)
        x = columns - PIXELS / 2 + drift_px[0] * periods + creep_px[0] * crept
        y = rows - PIXELS / 2 + drift_px[1] * periods + creep_px[1] * crept
        middle = (len(self._axis) - 1) / 2
        return [
            np.asarray(ndimage.map_coordinates(image, [middle + y * FINE, middle + (x + lag) * FINE], order=1))
            for lag in (0.0, self._lag_px)
        ]

    def _recorded(self, clean: list[Array], noise: float) -> list[Array]:
        random, found = self.random, []
        for values in clean:
            white = (
                random.standard_t(5, values.shape) / math.sqrt(5 / 3)
                if self._heavy
                else random.normal(size=values.shape)
            )
            steps = np.cumsum(random.normal(0.0, 0.3 * noise, (PIXELS, 1)), axis=0)
            found.append(values + noise * white + steps + random.normal(0.0, 0.5) * np.linspace(-1.0, 1.0, PIXELS))
        return found

    def _hum(self, picture: list[Array]) -> None:
        # the retrace is recorded after the trace, from its far end
        period, amplitude = self.random.uniform(5.0, 60.0), self.random.uniform(0.5, 2.0) * math.sqrt(2.0) * self._noise
        time = np.arange(PIXELS)[:, None] * 2.0 * PIXELS + np.arange(PIXELS) + self.random.uniform(0.0, period)
        picture[0] += amplitude * np.sin(math.tau * time / period)
        picture[1] += amplitude * np.sin(math.tau * (time[:, ::-1] + PIXELS) / period)

    def _contrast(self, kind: str, clean: list[Array]) -> list[Array]:
        random = self.random
        if kind == "bent contrast":
            size, bend = float(np.ptp(clean[0])), random.choice([-1.0, 1.0]) * random.uniform(0.1, 0.25)
            # a parabola with an eighth of this, 1 to 3 %, in the middle of the range
            return [values + bend / size * (values - values.min()) * (values - values.max()) / 2.0 for values in clean]
        if kind == "z scale":
            factor = 1.0 + random.choice([-1.0, 1.0]) * random.uniform(0.02, 0.06)
            return [factor * values for values in clean]
        # a feedback of second order with too much gain, behind edges of either direction
        turn, damping = random.uniform(0.4, 1.2), random.uniform(0.2, 0.6)
        pole = np.exp(turn * complex(-damping, math.sqrt(1.0 - damping**2)))
        below = [1.0, -2.0 * pole.real, abs(pole) ** 2]
        back = clean[1][:, ::-1]
        return [_fed_back(clean[0], below), _fed_back(back, below)[:, ::-1]]

    def _disturb(self, kind: str, picture: list[Array], row: int) -> None:
        random = self.random
        if kind == "noise burst":
            rows, factor = int(random.integers(16, 60)), random.uniform(3.0, 8.0)
            for values in picture:
                part = values[row : row + rows]
                part += math.sqrt(factor**2 - 1.0) * self._noise * random.normal(size=part.shape)
            return
        for values in picture:
            for line in values[row:]:
                for _ in range(random.poisson(0.9)):  # 60 % of the lines
                    first, long = random.integers(-10, PIXELS - 5), random.integers(8, 60)
                    line[max(0, first) : first + long] += random.choice([-1.0, 1.0]) * random.uniform(0.6, 2.0)

    def _bump(self, picture: list[Array], row: int) -> None:
        period, lasting = self.random.uniform(10.0, 80.0), self.random.uniform(0.5, 3.0) * 2.0 * PIXELS
        start = row * 2.0 * PIXELS + self.random.uniform(0.0, PIXELS)
        amplitude = self.random.uniform(5.0, 20.0) * self._noise
        time = np.arange(PIXELS)[:, None] * 2.0 * PIXELS + np.arange(PIXELS) - start
        for values, since in zip(picture, (time, time[:, ::-1] + PIXELS), strict=True):
            ringing = np.exp(-np.maximum(since, 0.0) / lasting) * np.sin(math.tau * since / period)
            values += np.where(since >= 0.0, amplitude * ringing, 0.0)

    @staticmethod
    def _heights(picture: list[Array]) -> list[Array]:
        return [HEIGHT_M * values for values in picture]


_KIND = Kind.of(REGION, (PIXELS, PIXELS), "")


def _fed_back(values: Array, below: list[float]) -> Array:
    start = signal.lfilter_zi([sum(below)], below) * values[:, :1]
    return np.asarray(signal.lfilter([sum(below)], below, values, axis=1, zi=start)[0])


def _imaged(ground: Array, tip: _RoomTip) -> Array:
    image = ground.copy()
    if tip.second_px is not None:
        second = ndimage.shift(ground, [by * FINE for by in reversed(tip.second_px)], order=1, mode="nearest")
        image = np.maximum(image, second - tip.second_below)
    lower = tip.slope / FINE
    for _ in range(24):  # a pyramid of six pixels, by one point at a time
        for shift in (np.s_[1:, :], np.s_[:, 1:]):
            back = tuple(slice(None, -1) if axis.start else axis for axis in shift)
            image[shift] = np.maximum(image[shift], image[back] - lower)
            image[back] = np.maximum(image[back], image[shift] - lower)
    return np.asarray(ndimage.gaussian_filter(image, 0.45 * FINE))


def table(found: Sequence[JudgedScan]) -> list[str]:
    """Return a line for each kind of scan: good scans stopped and looked at, visible tip changes seen in time."""
    lines = []
    for kind in KINDS:
        of = [one for one in found if one.kind == kind and (one.is_visible or kind not in TIP_KINDS)]
        if not of:
            continue
        looked = sum(one.look_row is not None for one in of)
        stopped = sum(one.stop_row is not None for one in of)
        seen = f", {sum(one.is_seen for one in of)} within {WITHIN} rows" if kind in TIP_KINDS else ""
        if kind in NOISE_KINDS:
            seen = f", {sum(one.is_looked_at for one in of)} looked at within {WITHIN} rows"
        noisier = float(np.median([one.noisier for one in of]))
        lines.append(f"{kind:22} {stopped:4} of {len(of)} stopped{seen}; {looked} looked at; noise x {noisier:.2f}")
    good = [one for one in found if one.kind in ROOM_KINDS]
    changed = [one for one in found if one.kind in (*SAMPLE_KINDS, *CONTRAST_KINDS)]
    tips = [one for one in found if one.is_visible]
    delays = sorted(one.stop_row - one.at_row for one in tips if one.is_seen and one.stop_row is not None)
    for what, of, count in (
        ("good scans stopped", good, sum(one.stop_row is not None for one in good)),
        ("changed samples and contrasts stopped", changed, sum(one.stop_row is not None for one in changed)),
        (f"visible tip changes stopped within {WITHIN} rows", tips, len(delays)),
        (f"visible tip changes looked at within {WITHIN} rows", tips, sum(one.is_looked_at for one in tips)),
    ):
        lines.append(f"{what}: {count} of {len(of)}, {count / max(1, len(of)):.1%}")
    lines.append(f"median delay: {delays[len(delays) // 2] if delays else '-'} rows")
    return lines


def judged_room(half: Half, seed: int, channels: int, kinds: Sequence[str]) -> list[JudgedScan]:
    """Return the outcomes of one room."""
    return Room(half, seed).judged(kinds, channels=channels)
