"""A second generator of pairs, which shares no code and no assumption with the families.

It judges and is never fitted to, so an estimator can't gain from the habits of the first generator. Surfaces have other
statistics, the tip is a pyramid, noise has memory (relaxations and hum), scars are one to three rows thick and taper
off, values have the steps of a converter. Lengths are in pixels of the reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, ndimage, signal

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan, Prior

Random = np.random.Generator
Flattening = Literal["none", "median", "line", "parabola", "steps"]

PIXEL_M = 12e-9
HEIGHT_M = 3e-9
LINE_S = 1.5
FINE = 4  # points of the sample for each pixel
PIXELS = 128
MARGIN_PX = 6.0
RELAXATIONS_PX = (4.0, 25.0, 150.0)


@dataclass(frozen=True)
class Circumstances:
    """The circumstances of a pair. Heights are in units of the standard deviation of the reference without noise.

    Attributes:
        white: independent noise of each pixel.
        heavy: whether that noise has the heavy tails of Student's t with five degrees of freedom.
        relaxing: noise of each of `RELAXATIONS_PX`, which decays to 1/e within that length.
        hum: amplitude and period, px, of a sine along the lines.
        offset: independent offset of each row, with heavy tails.
        scars: share of rows at which a scar begins.
        spikes: share of the pixels.
        lost: share of the rows.
        bow: of the scanner, in both directions.
        step: of the converter; 0 for none.
        flattening: of the rows by the microscope.
        gain, bend: contrast of the second scan: largest logarithm, and nonlinearity.
        drift_px: standard deviation of the drift during each scan.
        turn_rad, stretch: of the sample between the scans, standard deviations; unknown to the estimator.
        creep_px, creep_length_px: of the lines' starts.
        wander_px, wander_rows: of lines, in each direction: standard deviation, and the mean period if they are waves.
        slow_creep_px, slow_creep_rows: of the slow axis after the start of a frame.
        tip: fall of the tip's flanks for each pixel.
        overlap: least and greatest share of the area.
        frame_turn_rad: rotation of the second frame; known.
        zoom_px: width of the second scan, for a zoom; 0 for a scan like the first.
        prior_px: standard deviation of the prior; None: no prior.
        elsewhere: the second scan shows another place.
    """

    white: float
    heavy: bool
    relaxing: tuple[float, ...]
    hum: tuple[float, float]
    offset: float
    scars: float
    spikes: float
    lost: float
    bow: float
    step: float
    flattening: Flattening
    gain: float
    bend: float
    drift_px: float
    turn_rad: float
    stretch: float
    creep_px: float
    creep_length_px: float
    tip: float
    overlap: tuple[float, float]
    frame_turn_rad: float = 0.0
    zoom_px: float = 0.0
    prior_px: float | None = None
    elsewhere: bool = False
    wander_px: float = 0.0
    wander_rows: float = 40.0
    slow_creep_px: float = 0.0
    slow_creep_rows: float = 10.0


ZOOMS = (13, 16, 20, 24)
WANDER_PX = (0.0, 0.05, 0.2)
WANDERING = ("wander", "hard-wander", *(f"wander{px}" for px in WANDER_PX), "turned-wander")
"""Cells of pairs whose lines wander: drawn, as in "hard", of a given size, and with turned frames."""
CELLS = ("real", "hard", "hard+prior", *(f"zoom{px}" for px in ZOOMS), "turned", "null", "null+prior", *WANDERING)


def circumstances(cell: str, random: Random) -> Circumstances:
    """Draw the circumstances of a pair of a cell, one of `CELLS`."""

    def log(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    def sometimes(share: float, low: float, high: float) -> float:
        return log(low, high) * (random.random() < share)

    name, _, prior = cell.partition("+")
    hard = name.startswith("hard")
    worse = 2.0 if hard else 1.0
    shares = random.dirichlet(np.ones(len(RELAXATIONS_PX)))
    relaxing = worse * log(0.05, 0.2) * np.sqrt(shares)
    flattenings: tuple[Flattening, ...] = ("none", "median", "line", "line", "parabola", "steps")
    made = Circumstances(
        white=worse * log(0.025, 0.08),
        heavy=bool(random.random() < 0.3),
        relaxing=tuple(relaxing.tolist()),
        hum=(worse * sometimes(0.3, 0.01, 0.05), log(5.0, 40.0)),
        offset=worse * log(0.05, 0.4),
        scars=worse * random.uniform(0.0, 0.04),
        spikes=sometimes(0.3, 2e-4, 2e-3),
        lost=sometimes(0.15, 0.005, 0.02),
        bow=sometimes(0.4, 0.1, 1.0),
        step=sometimes(0.5, 0.005, 0.05),
        flattening=flattenings[random.integers(len(flattenings))],
        gain=0.5 if hard else 0.1,
        bend=0.2 if hard else 0.0,
        drift_px=worse * log(0.3, 1.2),
        turn_rad=math.radians(0.6) if hard else 0.0,
        stretch=0.005 * (random.random() < 0.3),
        creep_px=sometimes(0.3, 0.1, 1.0),
        creep_length_px=random.uniform(2.0, 12.0),
        tip=log(0.3, 3.0),
        overlap=(0.4, 0.7) if hard else (0.7, 1.0),
        prior_px=1.5 if prior else None,
    )
    if name in WANDERING:
        given_px = {f"wander{px}": px for px in WANDER_PX}.get(name)
        made = replace(
            made,
            wander_px=sometimes(0.7, 0.02, 0.3) if given_px is None else given_px,
            wander_rows=log(8.0, 80.0),
            slow_creep_px=sometimes(0.3, 0.1, 1.0) if given_px is None else 0.0,
            slow_creep_rows=random.uniform(5.0, 15.0),
        )
    if name.startswith("zoom"):
        zoom_px = float(name.removeprefix("zoom"))
        return replace(made, zoom_px=zoom_px, prior_px=1.5, drift_px=made.drift_px * zoom_px / PIXELS)
    if name.startswith("turned"):
        return replace(made, frame_turn_rad=math.radians(30.0 * random.choice((-1.0, 1.0))))
    return replace(made, elsewhere=name == "null")


def stamper(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return rounded bars of random lengths on tracks, with flanks of a hyperbolic tangent."""
    turn, pitch = sample.uniform(-0.8, 0.8), sample.uniform(50.0, 130.0)
    wide, flank, unit = pitch * sample.uniform(0.2, 0.4), sample.uniform(0.8, 4.0), sample.uniform(10.0, 25.0)
    along = x * np.cos(turn) + y * np.sin(turn)
    across = y * np.cos(turn) - x * np.sin(turn) + place.uniform(0.0, pitch)
    number = np.floor(across / pitch)
    off_axis = across - (number + 0.5) * pitch
    ends = 0.0 * along
    for track in np.unique(number):
        here = number == track
        reach = float(np.abs(along).max()) + 12.0 * unit
        lengths = unit * place.integers(3, 12, int(2.0 * reach / (3.0 * unit)) + 2) * place.normal(1.0, 0.01)
        edges = np.cumsum(lengths) - reach - place.uniform(0.0, 6.0 * unit)
        edges += place.normal(0.0, 0.02 * unit, edges.size)
        k = np.clip(np.searchsorted(edges, along[here]), 1, edges.size - 1)
        nearest = np.minimum(along[here] - edges[k - 1], edges[k] - along[here])
        ends[here] = np.where(k % 2 == 0, nearest, -nearest)
    sides = wide / 2 - np.abs(off_axis)
    bar = (1.0 + np.tanh(ends / flank)) * (1.0 + np.tanh(sides / flank)) / 4
    texture = field(place, x.shape, sample.uniform(2.0, 12.0), 3.0)
    return np.asarray(bar + sample.uniform(0.003, 0.04) * texture)


def rough(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return a skewed field, longer in one direction."""
    longest, power = sample.uniform(8.0, 60.0), sample.uniform(2.8, 4.0)
    made = field(place, x.shape, longest, power, sample.uniform(0.7, 1.4))
    return np.asarray(np.exp(sample.uniform(-0.5, 0.5) * made) + 0.3 * made)


def particles(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return clustered paraboloids with axes of their own, on a rough ground."""
    height = sample.uniform(0.1, 0.8) * field(place, x.shape, sample.uniform(6.0, 25.0), 3.5)
    half, typical = float(x.max()), sample.uniform(2.0, 6.0)
    parents = place.uniform(-half, half, (place.poisson((2 * half) ** 2 / 2500.0) + 2, 2))
    for parent in parents:
        for child in parent + place.normal(0.0, 15.0, (place.poisson(3.0) + 1, 2)):
            radii, turn = typical * place.gamma(6.0, 1 / 6.0, 2) + 1.0, place.uniform(0.0, np.pi)
            reach = radii.max()
            near = np.s_[
                np.searchsorted(y[:, 0], child[1] - reach) : np.searchsorted(y[:, 0], child[1] + reach),
                np.searchsorted(x[0], child[0] - reach) : np.searchsorted(x[0], child[0] + reach),
            ]
            u, v = x[near] - child[0], y[near] - child[1]
            a, b = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
            cap = 1.5 * radii.min() * (1.0 - (a / radii[0]) ** 2 - (b / radii[1]) ** 2)
            height[near] = np.maximum(height[near], cap)
    return height


def lattice(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return atoms of an oblique lattice under slow strain, with vacancies and adsorbates."""
    turn, a = sample.uniform(0.0, np.pi), sample.uniform(5.0, 14.0)
    b, between = a * sample.uniform(0.85, 1.2), sample.uniform(np.pi / 3, np.pi / 2)
    cell = np.array([
        [a * np.cos(turn), b * np.cos(turn + between)], [a * np.sin(turn), b * np.sin(turn + between)],
    ])  # fmt: skip
    inverse = np.linalg.inv(cell)
    bent = 0.15 * a * field(place, x.shape, 60.0, 8.0)
    u = inverse[0, 0] * (x + bent) + inverse[0, 1] * y + place.random()
    v = inverse[1, 0] * (x + bent) + inverse[1, 1] * y + place.random()
    atoms = np.exp(np.cos(2 * np.pi * u) + np.cos(2 * np.pi * v))
    half = float(x.max())
    for at in place.uniform(-half, half, (place.poisson((2 * half) ** 2 / sample.uniform(800.0, 3000.0)) + 1, 2)):
        near = np.s_[
            np.searchsorted(y[:, 0], at[1] - 2 * a) : np.searchsorted(y[:, 0], at[1] + 2 * a),
            np.searchsorted(x[0], at[0] - 2 * a) : np.searchsorted(x[0], at[0] + 2 * a),
        ]
        blob = np.exp(-((x[near] - at[0]) ** 2 + (y[near] - at[1]) ** 2) / (0.7 * a) ** 2)
        atoms[near] += place.choice((-5.0, 5.0)) * place.uniform(0.5, 1.2) * blob
    return np.asarray(atoms)


def steps(place: Random, sample: Random, x: Array, y: Array) -> Array:
    """Return level sets of a slope with waves, and islands on the terraces."""
    turn, terrace, edge = sample.uniform(0.0, 2 * np.pi), sample.uniform(20.0, 80.0), sample.uniform(0.5, 3.0)
    slope = (x * np.cos(turn) + y * np.sin(turn)) / terrace
    level = slope + sample.uniform(0.1, 0.5) * field(place, x.shape, sample.uniform(15.0, 50.0), 5.0) + place.random()
    level += sample.uniform(0.0, 0.05) * field(place, x.shape, 5.0, 5.0)
    below = np.floor(level)
    stairs = below + (1.0 + np.tanh((level - below - 0.5) * terrace / edge)) / 2 - slope
    islands = field(place, x.shape, 12.0, 8.0)
    return np.asarray(stairs + 0.4 * (1.0 + np.tanh((islands - sample.uniform(1.8, 2.6)) * 6.0)))


SURFACES: dict[str, Callable[[Random, Random, Array, Array], Array]] = {
    "stamper": stamper, "rough": rough, "particles": particles, "lattice": lattice, "steps": steps,
}  # fmt: skip


def field(random: Random, shape: tuple[int, ...], length_px: float, power: float, ratio: float = 1.0) -> Array:
    """Return a Gaussian field of unit variance whose spectrum falls as (1 + (k length)²)^-power/2, [y, x]."""
    size = [fft.next_fast_len(n + int(2 * length_px * FINE), real=True) for n in shape]
    ky, kx = np.fft.fftfreq(size[0])[:, None] * FINE, np.fft.rfftfreq(size[1])[None, :] * FINE
    amplitude = (1.0 + (2 * np.pi * length_px / 4) ** 2 * ((kx * ratio) ** 2 + (ky / ratio) ** 2)) ** (-power / 4)
    white = fft.rfft2(random.standard_normal(size))
    made = fft.irfft2(white * amplitude, s=size)[: shape[0], : shape[1]]
    return np.asarray((made - made.mean()) / made.std())


@dataclass(frozen=True)
class Sample:
    """A surface as imaged by a tip, between -half and half px in x and y."""

    coefficients: Array
    half_px: float

    @classmethod
    def of(cls, surface: str, half_px: float, place: Random, sample: Random, tip: float) -> Sample:
        """Draw a surface and image it with a pyramid."""
        count = 2 * math.ceil(half_px * FINE) + 1
        axis = np.linspace(-half_px, half_px, count)
        height = SURFACES[surface](place, sample, *np.meshgrid(axis, axis))
        height = (height - height.mean()) / height.std()
        for _ in range(6):  # by one point at a time
            for shift in (np.s_[1:, :], np.s_[:, 1:]):
                back = tuple(slice(None, -1) if axis.start else axis for axis in shift)
                lower = tip / FINE
                np.maximum(height[shift], height[back] - lower, out=height[shift])
                np.maximum(height[back], height[shift] - lower, out=height[back])
        return cls(ndimage.spline_filter(ndimage.gaussian_filter(height, 0.45 * FINE)), half_px)

    def at(self, xy: Array) -> Array:
        """Return heights at positions (2, …)."""
        points = (self.coefficients.shape[0] - 1) / 2
        where = (xy / self.half_px + 1.0) * points
        return np.asarray(ndimage.map_coordinates(self.coefficients, where[::-1], mode="nearest", prefilter=False))

    def slope(self, xy: Array) -> Array:
        """Return the gradient at positions, (2, …), per px."""
        h = 0.05
        by_x, by_y = (np.reshape(v, (2, *[1] * (xy.ndim - 1))) for v in ((h, 0.0), (0.0, h)))
        return np.stack([self.at(xy + d) - self.at(xy - d) for d in (by_x, by_y)]) / (2 * h)


@dataclass(frozen=True)
class Frame:
    """The place of a scan: tip position p shows the sample at `seen + matrix @ (p - middle)`; all in px.

    Attributes:
        turn_rad: of its axes.
        step_px: between its pixels.
    """

    middle: Array
    turn_rad: float
    step_px: float
    pixels: int
    seen: Array
    matrix: Array

    @property
    def width_px(self) -> float:
        return self.step_px * (self.pixels - 1)

    @property
    def axes(self) -> Array:
        """Fast and slow axis in the columns."""
        cos, sin = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return np.array([[cos, -sin], [sin, cos]])

    def positions(self, creep_px: float, length_px: float) -> Array:
        """Return tip positions (2, y, x) of its pixels; creep displaces the start of lines."""
        along = (np.arange(self.pixels) - (self.pixels - 1) / 2) * self.step_px
        crept = along + creep_px * self.step_px * np.exp(-np.arange(self.pixels) / length_px)
        u, v = np.meshgrid(crept, along)
        return np.asarray(self.middle[:, None, None] + np.tensordot(self.axes, np.stack([u, v]), 1))

    def sample(self, p: Array) -> Array:
        """Return positions (2, …) in the sample."""
        flat = p.reshape(2, -1)
        return np.asarray((self.seen[:, None] + self.matrix @ (flat - self.middle[:, None])).reshape(p.shape))

    def tip(self, sample: Array) -> Array:
        """Return tip positions (2, …) for positions in the sample."""
        flat = sample.reshape(2, -1)
        back = np.linalg.solve(self.matrix, flat - self.seen[:, None])
        return np.asarray((self.middle[:, None] + back).reshape(sample.shape))

    def holds(self, p: Array) -> NDArray[np.bool_]:
        """Return whether tip positions (2, …) are within it."""
        own = np.tensordot(self.axes.T, p - self.middle.reshape(2, *[1] * (p.ndim - 1)), 1)
        return np.asarray((np.abs(own) <= self.width_px / 2 + 1e-9).all(axis=0))


@dataclass(frozen=True)
class ForeignPair:
    """Two scans and their truth.

    Attributes:
        displacement_px: true displacement of a feature at `center_px` of the reference, in tip coordinates, with the
            mean wander of the lines over the overlap.
        linear: change of the displacement with the position.
        bound_px: root of the trace of the Cramér-Rao bound; NaN for unrelated scans.
        elsewhere: whether the scans are unrelated.
    """

    reference: DriftScan
    scan: DriftScan
    prior: Prior | None
    displacement_px: Array
    linear: Array
    center_px: Array
    bound_px: float
    elsewhere: bool

    def displacement_m(self, at_m: Array) -> Array:
        """Return the true displacement of a feature at a position of the reference."""
        return np.asarray(PIXEL_M * self.displacement_px + self.linear @ (at_m - PIXEL_M * self.center_px))


def foreign_pair(cell: str, surface: str, seed: int) -> ForeignPair:
    """Return the pair of these arguments."""
    numbers = [90_210, seed, list(SURFACES).index(surface), CELLS.index(cell)]
    random = np.random.default_rng(numbers)
    how = circumstances(cell, random)
    first, second = _frames(how, random)
    clear = [f.sample(f.positions(how.creep_px, how.creep_length_px)) for f in (first, second)]
    half = max(float(np.abs(c).max()) for c in clear) + MARGIN_PX
    samples = [
        Sample.of(
            surface, half, np.random.default_rng([*numbers, 1 + k]), np.random.default_rng([*numbers, 0]), how.tip
        )
        for k in range(2 if how.elsewhere else 1)
    ]
    if how.zoom_px:
        second = _onto_something(samples[0], second, first.width_px, random)
        clear[1] = second.sample(second.positions(how.creep_px, how.creep_length_px))
    wanders = [np.zeros((2, frame.pixels, 1)) for frame in (first, second)]
    if how.wander_px or how.slow_creep_px:
        wanders = [wander(frame, how, random) for frame in (first, second)]
        clear = [
            frame.sample(frame.positions(how.creep_px, how.creep_length_px) + moved)
            for frame, moved in zip((first, second), wanders, strict=True)
        ]
    heights = [samples[0].at(clear[0]), samples[-1].at(clear[1])]
    level, unit = heights[0].mean(), heights[0].std()
    gain = float(np.exp(how.gain * random.uniform(-1.0, 1.0)))
    scans = []
    for k, (frame, height) in enumerate(zip((first, second), heights, strict=True)):
        values = (height - level) / unit
        if k:
            values = gain * (values + how.bend * random.uniform(-1.0, 1.0) / 2 * values**2)
        size_m = frame.width_px * PIXEL_M
        region = Region(tuple((frame.middle * PIXEL_M).tolist()), (size_m, size_m), frame.turn_rad)
        begin_s = 1000.0 * k
        end_s = begin_s + LINE_S * frame.pixels
        scans.append(DriftScan(HEIGHT_M * recorded(values, how, random), region, begin_s, end_s, upwards=True))
    p = first.positions(0.0, 1.0)
    shown = second.holds(second.tip(first.sample(p)))
    center = np.array([p[0][shown].mean(), p[1][shown].mean()])
    displacement = second.tip(first.sample(center)) - center
    if any(each.any() for each in wanders):
        q = second.positions(0.0, 1.0)
        back = first.holds(first.tip(second.sample(q)))
        means = [
            np.broadcast_to(w, q.shape)[:, there].mean(axis=1) for w, there in zip(wanders, (shown, back), strict=True)
        ]
        displacement = displacement + means[0] - means[1]
    linear = np.linalg.solve(second.matrix, first.matrix) - np.eye(2)
    prior = None
    if how.prior_px is not None:
        prior = Prior(
            PIXEL_M * (displacement + how.prior_px * random.standard_normal(2)),
            (PIXEL_M * how.prior_px) ** 2 * np.eye(2),
            velocity_sd_m_s=math.sqrt(2.0) * how.drift_px * PIXEL_M / (LINE_S * first.pixels),
        )
    bound = math.nan
    if not how.elsewhere:
        bound = _bound(samples[0], first, second, shown, center, unit, gain, how)
    return ForeignPair(scans[0], scans[1], prior, displacement, linear, center, bound, how.elsewhere)


def wander(frame: Frame, how: Circumstances, random: Random) -> Array:
    """Return the displacement (2, y, 1) of each line: waves or 1/f noise, and slow creep at the first lines."""
    rows = np.arange(frame.pixels, dtype=np.float64)
    made = _waves(rows, how.wander_rows, random) if random.random() < 0.5 else _one_over_f(frame.pixels, random)
    crept = how.slow_creep_px * random.choice((-1.0, 1.0)) * np.exp(-rows / how.slow_creep_rows)
    own = frame.step_px * (how.wander_px * made + np.outer((0.0, 1.0), crept))
    return np.asarray((frame.axes @ own)[:, :, None])


def _waves(rows: Array, mean_period: float, random: Random) -> Array:
    moved, power = np.zeros((2, rows.size)), np.zeros((2, 1))
    for axis in range(2):
        for _ in range(24):
            period = mean_period * random.uniform(0.1, 2.0)
            size, start = period * math.sqrt(random.exponential()), random.random()
            moved[axis] += size * np.sin(2 * np.pi * (rows / period + start))
            power[axis] += size**2 / 2
    return np.asarray(moved / np.sqrt(power))


def _one_over_f(count: int, random: Random) -> Array:
    # of unit rms over eight frames
    size = random.standard_normal((2, 4 * count)) / np.sqrt(np.arange(1, 4 * count + 1))
    turned = np.fft.irfft(np.column_stack([np.zeros(2), size * np.exp(2j * np.pi * random.random(size.shape))]))
    return np.asarray((turned / turned.std(axis=1, keepdims=True))[:, :count])


def _frames(how: Circumstances, random: Random) -> tuple[Frame, Frame]:
    width = PIXELS - 1.0
    if how.zoom_px:
        pixels = int(random.choice((64, 96, 128)))
        step = how.zoom_px / (pixels - 1)
        shift = np.zeros(2)
    else:
        pixels, step = PIXELS, 1.0
        shared, share = random.uniform(*how.overlap), random.random()
        shift = width * (1.0 - shared ** np.array([share, 1.0 - share])) * random.choice((-1.0, 1.0), 2)
    turn = random.normal(0.0, how.turn_rad) if how.turn_rad else 0.0
    sample = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    sample = sample @ np.diag(1.0 + how.stretch * random.standard_normal(2))
    made = []
    for k, (count, apart) in enumerate(((PIXELS, 1.0), (pixels, step))):
        seen = k * shift if how.zoom_px else (k - 0.5) * shift
        frame = Frame(random.uniform(-30.0, 30.0, 2), how.frame_turn_rad * k, apart, count, seen, np.eye(2))
        during = how.drift_px * random.standard_normal(2)
        sheared = (sample if k else np.eye(2)) - np.outer(during, frame.axes[:, 1]) / frame.width_px
        made.append(replace(frame, matrix=sheared))
    return made[0], made[1]


def _onto_something(sample: Sample, zoom: Frame, width_px: float, random: Random) -> Frame:
    # a survey takes zooms of targets: of some places the one with the largest relief
    reach = (width_px - zoom.width_px) / 2 - 2.0
    places = [replace(zoom, seen=random.uniform(-reach, reach, 2)) for _ in range(5)]
    return max(places, key=lambda at: float(sample.at(at.sample(at.positions(0.0, 1.0))).std()))


def recorded(values: Array, how: Circumstances, random: Random) -> Array:
    """Return heights [y, x] of unit variance as a microscope records them."""
    ny, nx = values.shape
    x, y = np.linspace(-1.0, 1.0, nx)[None, :], np.linspace(-1.0, 1.0, ny)[:, None]
    white = random.standard_t(5, (ny, nx)) / math.sqrt(5 / 3) if how.heavy else random.standard_normal((ny, nx))
    seen = values + how.white * white
    for size, length in zip(how.relaxing, RELAXATIONS_PX, strict=True):
        keep = math.exp(-1.0 / length)
        made = signal.lfilter([math.sqrt(1.0 - keep**2)], [1.0, -keep], random.standard_normal(2 * ny * nx))
        seen = seen + size * made.reshape(ny, 2 * nx)[:, :nx]
    amplitude, period = how.hum
    time = np.arange(ny)[:, None] * 2.0 * nx * random.uniform(0.99, 1.01) + np.arange(nx)
    seen = seen + amplitude * np.sin(2 * np.pi * (time / period + random.random()))
    seen += how.offset * random.standard_t(4, (ny, 1)) / math.sqrt(2.0)
    for row in np.flatnonzero(random.random(ny) < how.scars):
        _scar(seen, int(row), random)
    for row, column in np.argwhere(random.random((ny, nx)) < how.spikes):
        seen[row, column : column + random.integers(1, 3)] += random.choice((-1.0, 1.0)) * random.uniform(1.5, 6.0)
    bent = random.uniform(-1.0, 1.0, 6)
    seen += bent[0] * x + bent[1] * y
    seen += how.bow * (bent[2] * x**2 + bent[3] * y**2 + 0.4 * bent[4] * x**3 + 0.5 * bent[5] * x * y)
    if how.step:
        seen = np.round(seen / how.step) * how.step
    seen = levelled(seen, how.flattening)
    if how.lost:
        for row in np.flatnonzero(random.random(ny) < how.lost):
            seen[row : row + random.integers(1, 3)] = np.nan
    return np.asarray(seen)


def _scar(seen: Array, row: int, random: Random) -> None:
    # one to three rows in which the tip drags something: it begins at once, and ends at once or slowly
    ny, nx = seen.shape
    thick = random.choice(3, p=(0.45, 0.35, 0.2)) + 1
    start, length = random.integers(nx), 5.0 + random.exponential(40.0)
    size = random.choice((-1.0, 1.0)) * random.uniform(0.3, 1.6)
    along = np.arange(nx) - start
    ending = np.exp(-np.maximum(along, 0) / length) if random.random() < 0.5 else along < length
    for k in range(row, min(row + thick, ny)):
        late = random.integers(0, 4)
        seen[k] += size * random.uniform(0.8, 1.2) * np.where(along >= late, ending, 0.0)


def levelled(values: Array, flattening: Flattening) -> Array:
    """Return rows flattened as by a controller's software."""
    if flattening == "none":
        return values
    if flattening == "median":
        return np.asarray(values - np.median(values, axis=1, keepdims=True))
    if flattening == "steps":
        offsets = np.concatenate([[0.0], np.cumsum(np.median(np.diff(values, axis=0), axis=1))])
        return np.asarray(values - offsets[:, None])
    x = np.linspace(-1.0, 1.0, values.shape[1])
    fitted = np.polynomial.legendre.legfit(x, values.T, 1 if flattening == "line" else 2)
    return np.asarray(values - np.polynomial.legendre.legval(x, fitted))


def _bound(
    sample: Sample,
    first: Frame,
    second: Frame,
    shown: NDArray[np.bool_],
    center: Array,
    unit: float,
    gain: float,
    how: Circumstances,
) -> float:
    # The root of the trace of the Bayesian Cramér-Rao bound of the shift at `center`. Unknown are a line in each row (a
    # parabola where rows were flattened by one), the contrast, and the linear map, with the prior of the circumstances.
    p = first.positions(0.0, 1.0)
    seen = first.sample(p)
    slope = np.tensordot(first.matrix.T, sample.slope(seen), 1) / unit
    level = sample.at(seen) / unit
    x, y = p - center[:, None, None]
    columns = np.stack([*slope, level, slope[0] * x, slope[0] * y, slope[1] * x, slope[1] * y], axis=1)
    order = 2 if how.flattening == "parabola" else 1
    information = np.zeros((7, 7))
    precisions: dict[int, Array] = {}
    for row, known in zip(columns, shown, strict=True):
        count = int(known.sum())
        if count < order + 2:
            continue
        if count not in precisions:
            precisions[count] = _row_precision(count, order, how)
        there = row[:, known]
        information += there @ precisions[count] @ there.T
    information /= 1.0 + (second.step_px / first.step_px) ** 2 / gain**2
    size = first.width_px
    linear = np.diag([0.0, 1.0, 0.0, 1.0]) * 2.0 * (how.drift_px / size) ** 2
    if second.width_px < size:
        linear = np.diag([0.0, 1.0, 0.0, 1.0]) * how.drift_px**2 * (size**-2 + second.width_px**-2)
    turned = np.array([0.0, -1.0, 1.0, 0.0])
    linear += how.turn_rad**2 * np.outer(turned, turned) + how.stretch**2 * np.diag([1.0, 0.0, 0.0, 1.0])
    linear += 1e-10 * np.eye(4)
    information[3:, 3:] += np.linalg.inv(linear)
    information[2, 2] += 1.0 / max(how.gain, 0.01) ** 2
    if how.prior_px is not None:
        information[:2, :2] += np.eye(2) / how.prior_px**2
    return math.sqrt(float(np.trace(np.linalg.inv(information)[:2, :2])))


def _row_precision(count: int, order: int, how: Circumstances) -> Array:
    lags = np.arange(count)
    covariance = np.where(lags == 0, how.white**2, 0.0) + how.hum[0] ** 2 / 2 * np.cos(2 * np.pi * lags / how.hum[1])
    for size, length in zip(how.relaxing, RELAXATIONS_PX, strict=True):
        covariance = covariance + size**2 * np.exp(-lags / length)
    covariance[0] += how.step**2 / 12
    precision = np.linalg.inv(linalg.toeplitz(covariance))
    lines = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), order)
    through = precision @ lines
    return np.asarray(precision - through @ np.linalg.solve(lines.T @ through, through.T))
