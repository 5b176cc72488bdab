"""Pairs cut out of images of real microscopes, through a known warp and with the noise of another real image.

The images are in `DATA`; the two halves share no sample. A pair is resampled from one image of 256 px by two frames,
so its surface, its tip and its artefacts are real, and its displacement is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import ndimage

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan, Prior
from afspm.storage.formats import read
from benchmarks.data_folder import DATA
from benchmarks.drift.conditions import flattened, measured
from benchmarks.drift.families import Half, drawn_condition, source
from benchmarks.drift.pairs import HEIGHT_M, PIXEL_M, ROW_S, Frame, Sampling, Truth, framed, prior_of, truth_of

SURFACE = "images"
PIXELS = 96
IMAGES: dict[Half, tuple[tuple[str, str], ...]] = {
    "fitted": (
        ("asylum/PZT_final0001.h5", "HeightRetrace"),
        ("asylum/PZT_final0001.h5", "DeflectionRetrace"),
        ("asylum/PZT_final0002.h5", "AmplitudeRetrace"),
        ("asylum/PTO_Funakubo0004.h5", "HeightRetrace"),
        ("asylum/PTO_Funakubo0004.h5", "AmplitudeRetrace"),
    ),
    "unseen": (
        ("asylum/PMN28Pt0000.h5", "HeightRetrace"),
        ("asylum/PMN28Pt0001.h5", "HeightRetrace"),
        ("asylum/PMN28Pt0001.h5", "AmplitudeRetrace"),
        ("asylum/DTMicroscope_scan_0001.ibw", "HeightRetrace"),
        ("asylum/DTMicroscope_scan_0001.ibw", "Amplitude1Retrace"),
    ),
}
# Channels of a frame in which there was nothing to be seen.
NOISE: dict[Half, tuple[str, str]] = {"fitted": ("Amplitude", "Excitation"), "unseen": ("LIX_1_omega", "LIY_1_omega")}
NOISY = "nanonis/A151216.123306-02602.sxm"


@dataclass(frozen=True)
class Cut:
    """Two scans with their truth; see `pairs.Pair`."""

    reference: DriftScan
    scan: DriftScan
    truth: Truth | None
    prior: Prior | None


def there_are_images() -> bool:
    """Return whether the data of real microscopes are there."""
    return DATA.is_dir()


def cut(condition: str, seed: int, half: Half, prior_sd_px: float | None = None) -> Cut:
    """Return a pair that depends only on the arguments; see `pairs.pair`."""
    random = source(half, seed, len(condition), 77)
    how = replace(drawn_condition(condition, random), white=0.0, second_tip_px=0.0)
    frames = framed(*(Sampling((PIXELS, PIXELS), (1.0, how.aspect)),) * 2, how, random)
    chosen = IMAGES[half][random.integers(len(IMAGES[half]))]
    image = _image(*chosen)
    middle, step = _placed(frames, image, random)
    places = [(image, middle)] * 2
    if how.elsewhere:
        others = [one for one in IMAGES[half] if one[0][:10] != chosen[0][:10]]  # of another sample
        places[1] = (_image(*others[random.integers(len(others))]), middle)
    level, gain = 10 ** random.uniform(-2.0, -1.0), math.exp(random.uniform(-1.0, 1.0) * math.log(how.gain))
    centers_m = [random.uniform(-20.0, 20.0, 2) * PIXEL_M for _ in frames]
    scans = []
    for k, (frame, (there, at)) in enumerate(zip(frames, places, strict=True)):
        where = at[:, None, None] + step * frame.sample_px(frame.offsets_px())
        values = ndimage.map_coordinates(there, where[::-1], order=3, mode="mirror")
        noise = _noise(half, random)
        if k:  # turned round: both may be of one frame, and noise that is the same in both would be a feature
            noise = noise[::-1, ::-1]
        seen = measured(values / values.std(), how, random, gain if k else 1.0) + level * noise
        region = Region(tuple(centers_m[k]), tuple(frame.width_px * PIXEL_M))
        start_s = 900.0 * k
        upwards = not (k and how.turned_round)
        scans.append(DriftScan(HEIGHT_M * seen, region, start_s, start_s + ROW_S * PIXELS, upwards, f"{seed}-{k}"))
    truth = truth_of(frames, centers_m)
    known = None if prior_sd_px is None else prior_of(truth, prior_sd_px, how, PIXELS, random)
    return Cut(scans[0], scans[1], None if how.elsewhere else truth, known)


def _placed(frames: tuple[Frame, Frame], image: Array, random: np.random.Generator) -> tuple[Array, float]:
    # where in the image the origin of the sample lies, (x, y), and pixels of the image per pixel of the sample, so that
    # the frames fit in
    corners = np.array([[-0.5, -0.5, 0.5, 0.5], [-0.5, 0.5, -0.5, 0.5]])
    reached = np.concatenate([f.sample_px(corners * f.width_px[:, None]) for f in frames], axis=1)
    low, high = reached.min(axis=1), reached.max(axis=1)
    size = np.array(image.shape[::-1]) - 5.0
    step = min(random.uniform(1.0, 1.4), float((size / (high - low)).min()))
    return 2.0 - step * low + random.random(2) * (size - step * (high - low)), step


@cache
def _image(name: str, channel: str) -> Array:
    # flattened line by line, as usual for viewing, and without the noise of single pixels
    values = _channel(name, channel)
    return np.asarray(ndimage.gaussian_filter(values - np.median(values, axis=1, keepdims=True), 0.6))


@cache
def _channel(name: str, channel: str) -> Array:
    (found,) = (one.values for one in read(DATA / name).scans if one.channel == channel)
    return np.asarray(found, dtype=np.float64)


def _noise(half: Half, random: np.random.Generator) -> Array:
    # of unit rms, with the spectrum of real electronics
    there = _channel(NOISY, f"{random.choice(NOISE[half])} {random.choice(('Forward', 'Backward'))}")
    row, column = (random.integers(n - PIXELS + 1) for n in there.shape)
    part = flattened(there[row : row + PIXELS, column : column + PIXELS])
    return np.asarray(part / part.std())
