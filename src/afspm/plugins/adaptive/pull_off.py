"""The pull-off force of a force curve, from the baseline of the free cantilever.

A recorded force is the deflection of the cantilever times its spring constant, and has an offset, a slope along z, and
often the interference of the laser with light from the sample, whose period is half a wavelength. None of these is a
force. The farthest quarter of each way has to be free; from there, each way is followed for as far as it stays on the
baseline: the way there up to the snap-in, which is often nearer than the place of the pull-off.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.model import Spectrum

_BACK: Final = ", retrace"
_LEAST_POINTS: Final = 32
_FREE: Final = 0.25
"""Share of each way, at its far end, where the cantilever has to be free."""
_ROUNDS: Final = 20
_LEFT: Final = 4.0
"""In standard deviations of the farthest quarter from the baseline: where a way is not free any more, at two points."""
_LEFT_SLOWLY: Final = 2.0
"""The same for the mean of neighbours."""
_NEIGHBOURS: Final = 9
_PERIODS_M: Final = (250e-9, 550e-9)
"""Shortest and longest half of the wavelength of a visible or near infrared laser."""
_LEAST_PERIODS: Final = 25
_MOST_INTERFERENCE: Final = 0.1
"""Largest amplitude of the interference, as a share of the range of the force: a larger one is a force."""
_GROWTH: Final = 1.3
_LEAST_PULL: Final = 5.0
"""Least pull-off force, in standard deviations of the force: of many points, one lies below the others by four."""
_MOST_ERROR: Final = 0.1
"""Largest standard error of the pull-off force, as a share of it."""
_DIP: Final = 0.8
"""Share of the pull-off force beyond which the points around the lowest one are its dip."""
_LEAST_DIP: Final = 6


@dataclass(frozen=True)
class PullOff:
    """The pull-off from the sample.

    Attributes:
        force_n: the largest attraction while the tip withdraws, below the free cantilever; positive.
        error_n: standard error, from the noise and the baseline.
    """

    force_n: float
    error_n: float


def pull_off(spectrum: Spectrum) -> PullOff:
    """Return the pull-off force: the lowest force of the way back, below the force of the free cantilever.

    Raises:
        NoSuchItem: the spectrum has no height or no force, or no way back: the approach has its lowest force at the
            snap-in. InvalidValue: the force is not in N, no attraction is above the noise, or it is known to less than
            a tenth.
    """
    if spectrum.has("force" + _BACK) and (unit := spectrum.si_unit_of("force" + _BACK)) != "N":
        raise InvalidValue(f"the force is in {unit or 'no unit'}", hint="calibrate the cantilever at the controller")
    back = _Way.of(spectrum, _BACK)
    has_approach = spectrum.has("force") and spectrum.has("height")
    baseline = _Baseline.of([back, _Way.of(spectrum, "")] if has_approach else [back])
    force = back.force_n - baseline.at(back.height_m)
    lowest = int(np.argmin(force))
    value, reading = _bottom(force, lowest, baseline.noise_n)
    error = math.hypot(reading, baseline.error_at(float(back.height_m[lowest])))
    found = f"{value * 1e9:.3g} nN ± {error * 1e9:.1g} nN"
    if value < _LEAST_PULL * max(error, baseline.noise_n):
        what = f"the attraction of {found} is not above the noise of {baseline.noise_n * 1e9:.1g} nN"
        raise InvalidValue(what, hint="average more curves, or use a softer cantilever")
    if error > _MOST_ERROR * value:
        raise InvalidValue(f"the pull-off force of {found} is too uncertain", hint="withdraw farther")
    return PullOff(value, error)


@dataclass(frozen=True)
class _Way:
    # one way of a curve, the farthest point first
    height_m: Array
    force_n: Array

    @classmethod
    def of(cls, spectrum: Spectrum, way: str) -> _Way:
        force, height = spectrum.of("force" + way), spectrum.of("height" + way)
        good = np.isfinite(height) & np.isfinite(force)
        height, force = height[good], force[good]
        if len(height) < _LEAST_POINTS or not np.ptp(height):
            raise InvalidValue(f"{len(height)} points of a way are too few", hint=f"measure {_LEAST_POINTS} or more")
        step = 1 if height[0] > height[-1] else -1
        return cls(height[::step], force[::step])

    def first(self, points: int) -> _Way:
        return _Way(self.height_m[:points], self.force_n[:points])


@dataclass(frozen=True)
class _Baseline:
    # the force of the free cantilever on the way back: the first of the ways
    far_m: float
    extent_m: float
    ways: int
    period_m: float | None
    fit: Array
    covariance: Array
    noise_n: float
    nearest_m: float
    points: int
    model_n: float = 0.0

    @property
    def amplitude_n(self) -> float:
        return 0.0 if self.period_m is None else math.hypot(*self.fit[-2:])

    @classmethod
    def of(cls, ways: list[_Way]) -> _Baseline:
        """Return the line if it holds at the height of the pull-off, else with interference if that reaches nearer."""
        line = cls._grown(ways, _without)
        if line.nearest_m <= _pull_off_m(ways[0], line):
            return line
        rippled = cls._grown(ways, _with_interference)
        swing = max(float(np.ptp(way.force_n)) for way in ways)
        if rippled.period_m is None or rippled.amplitude_n > _MOST_INTERFERENCE * swing:
            return line
        at_m = _pull_off_m(ways[0], rippled)
        best = rippled if rippled.points > line.points else line
        if best.nearest_m <= at_m:
            return best
        # neither is measured at the height of the pull-off, so that their difference is an error
        return replace(best, model_n=abs(line.at_one(at_m) - rippled.at_one(at_m)))

    @classmethod
    def _grown(cls, ways: list[_Way], fitted: Callable[[list[_Way]], _Baseline]) -> _Baseline:
        least = [math.ceil(_FREE * len(way.height_m)) for way in ways]
        free = least
        found = fitted([way.first(n) for way, n in zip(ways, free, strict=True)])
        noise_n = found.noise_n  # the noise of later rounds may include a force
        for _ in range(_ROUNDS):
            reach = [found._reach(way, number, noise_n) for number, way in enumerate(ways)]
            # an extrapolation is trusted for a part of its way alone
            grown = [
                min(max(n, m), math.ceil(_GROWTH * before)) for n, m, before in zip(reach, least, free, strict=True)
            ]
            if grown == free:
                break
            free = grown
            found = fitted([way.first(n) for way, n in zip(ways, free, strict=True)])
        return replace(found, noise_n=max(noise_n, found.noise_n))

    @classmethod
    def fitted(cls, parts: list[_Way], period_m: float | None = None) -> _Baseline:
        far_m, extent_m = float(parts[0].height_m[0]), float(np.ptp(parts[0].height_m))
        nearest_m = min(float(part.height_m[-1]) for part in parts)
        points = sum(len(part.height_m) for part in parts)
        empty = cls(far_m, extent_m, len(parts), period_m, np.zeros(0), np.zeros(0), 0.0, nearest_m, points)
        design = np.concatenate([empty._terms(part.height_m, number) for number, part in enumerate(parts)])
        force = np.concatenate([part.force_n for part in parts])
        fit, *_ = np.linalg.lstsq(design, force, rcond=1e-9)
        left = force - design @ fit
        noise = math.sqrt(float(left @ left) / max(len(left) - design.shape[1], 1))
        # noise of low frequency is alike in neighbouring points, and averages out the less
        alike = min(max(float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300), 0.0), 0.98)
        inverse = np.linalg.pinv(design.T @ design, rcond=1e-12)
        return replace(empty, fit=fit, covariance=noise**2 * (1.0 + alike) / (1.0 - alike) * inverse, noise_n=noise)

    def _terms(self, height_m: Array, number: int) -> Array:
        x = (height_m - self.far_m) / self.extent_m
        columns = [np.where(way == number, term, 0.0) for way in range(self.ways) for term in (np.ones_like(x), x)]
        if self.period_m is not None:
            angle = 2.0 * math.pi / self.period_m * (height_m - self.far_m)
            columns += [np.sin(angle), np.cos(angle)]
        return np.stack(columns, axis=1)

    def _reach(self, way: _Way, number: int, noise_n: float) -> int:
        # the number of points before the way leaves the baseline: by points, or slowly
        away = way.force_n - self._terms(way.height_m, number) @ self.fit
        mean = np.convolve(away, np.full(_NEIGHBOURS, 1.0 / _NEIGHBOURS), mode="same")
        far = np.abs(away) > _LEFT * noise_n
        gone = np.flatnonzero((far[:-1] & far[1:]) | (np.abs(mean) > _LEFT_SLOWLY * noise_n)[:-1])
        first = int(gone[gone >= math.ceil(_FREE * len(away))].min(initial=len(away)))
        return first if first == len(away) else first - _NEIGHBOURS

    def at(self, height_m: Array) -> Array:
        return np.asarray(self._terms(height_m, 0) @ self.fit)

    def at_one(self, height_m: float) -> float:
        return float(self.at(np.array([height_m]))[0])

    def error_at(self, height_m: float) -> float:
        (row,) = self._terms(np.array([height_m]), 0)
        return math.hypot(self.model_n, math.sqrt(max(float(row @ self.covariance @ row), 0.0)))


def _without(parts: list[_Way]) -> _Baseline:
    return _Baseline.fitted(parts)


def _with_interference(parts: list[_Way]) -> _Baseline:
    longest, shortest = max(_PERIODS_M), min(_PERIODS_M)
    phases = max(float(np.ptp(part.height_m)) for part in parts) / shortest
    periods_m = np.geomspace(shortest, longest, max(_LEAST_PERIODS, math.ceil(8.0 * phases)))
    return min((_Baseline.fitted(parts, float(period_m)) for period_m in periods_m), key=lambda one: one.noise_n)


def _pull_off_m(back: _Way, baseline: _Baseline) -> float:
    return float(back.height_m[int(np.argmin(back.force_n - baseline.at(back.height_m)))])


def _bottom(force: Array, lowest: int, noise: float) -> tuple[float, float]:
    # the depth of the dip, and its error: the lowest of many noisy points is too low
    in_dip = force < _DIP * force[lowest]
    outside = np.flatnonzero(~in_dip)
    begin = int(outside[outside < lowest].max(initial=-1)) + 1
    end = int(outside[outside > lowest].min(initial=len(force)))
    if end - begin >= _LEAST_DIP:
        x = np.linspace(-1.0, 1.0, end - begin)
        fit = np.polynomial.Polynomial.fit(x, force[begin:end], 2)
        scatter = float(np.std(force[begin:end] - fit(x)))
        if scatter < 2.0 * noise:
            return -float(fit(x).min()), max(scatter, noise) * math.sqrt(3.0 / len(x))
    return -float(force[lowest]), noise
