"""Draws the pictures of docs/explanation/drift.md from the simulator: `python tools/drift_pictures.py [NAME…]`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy import fft, ndimage

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.estimators import estimator
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.report.style import (
    BLUE,
    GREEN,
    GREY,
    HOUR_S,
    MAGENTA,
    ORANGE,
    WIDTH_IN,
    figure,
    letter,
    shared_span,
    show_scan,
    styled,
    time_axis,
)  # fmt: skip
from afspm.simulation import World
from afspm_lab.study import NightSettings, night

PICTURES = Path(__file__).resolve().parents[1] / "docs" / "pictures"
NM = 1e9
DPI = 150
LINE_S = 1.0
TRIALS = 40


def taken(world: World, center_m: tuple[float, float], start_s: float, size_m: float = 2e-6, **how: Any) -> DriftScan:
    """A scan of 128 x 128 pixels."""
    region = Region(center_m, (size_m, size_m))
    scan = world.scan(region, (128, 128), LINE_S, start_s, **how)
    _, values = scan.channels()["Height"]
    return DriftScan(values, region, scan.start_s, scan.end_s, how.get("direction", "up") == "up")


def levelled(scan: DriftScan) -> Array:
    return np.asarray(scan.values - np.median(scan.values, axis=1, keepdims=True))


def registration() -> Figure:
    """From two scans to hundredths of a pixel."""
    settings = {"surface": {"kind": "stamper"}, "scanner": {"flatten": "line"}}
    world = World.from_settings(settings, seed=11, start_s=0.0)
    moved_m = np.array((270e-9, -130e-9))
    away = (-moved_m[0], -moved_m[1])  # seen from there, everything lies where drift would have brought it
    pairs = [(taken(world, (0.0, 0.0), 1e3 * k), taken(world, away, 1e3 * k + 500)) for k in range(TRIALS)]
    pairs = [(first, replace(second, region=first.region)) for first, second in pairs]
    found = [estimator().register(*pair) for pair in pairs]
    first, second = pairs[0]
    moved_px = found[0].displacement_m / first.pixel_m
    with styled():
        made = figure(WIDTH_IN, 4.9)
        axes = made.subplots(2, 3).ravel()
        for ax, scan, title in ((axes[0], first, "a scan"), (axes[1], second, "two hours later")):
            show_scan(ax, scan, shared_span((first, second)))
            ax.set(xlabel="x / µm", ylabel="y / µm", title=title)
        arrow = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
        axes[1].annotate("", 1e6 * found[0].displacement_m, (0.0, 0.0), arrowprops=arrow)
        _correlation(axes[2], first, second)
        whole = np.round(moved_px)
        limit = 4 * np.std(_difference(first, second, moved_px))
        for ax, by, title in (
            (axes[3], whole, "difference, by whole px"),
            (axes[4], moved_px, "difference, as estimated"),
        ):
            ax.imshow(_difference(first, second, by), cmap="gray", vmin=-limit, vmax=limit, origin="lower")
            ax.set(xlabel="x / px", ylabel="y / px", title=title)
        _cloud(axes[5], np.array([one.displacement_m - moved_m for one in found]) * NM, found[0].covariance_m2 * NM**2)
        for ax, name in zip(axes, "abcdef", strict=True):
            letter(ax, name)
    return made


def _correlation(ax: Axes, first: DriftScan, second: DriftScan) -> None:
    """How alike the two are at every shift: the place of the search's candidates."""
    pictures = [ndimage.gaussian_filter(levelled(scan), 1.0, order=(0, 1)) for scan in (first, second)]
    n = len(pictures[0])
    size = (2 * n, 2 * n)
    spectra = [fft.rfft2(picture - picture.mean(), size) for picture in pictures]
    both = fft.fftshift(fft.irfft2(spectra[1] * np.conj(spectra[0]), size))
    overlap = fft.fftshift(fft.irfft2(np.abs(fft.rfft2(np.ones((n, n)), size)) ** 2, size))
    both /= np.sqrt(np.maximum(overlap, 0.2 * n * n))
    reach = int(0.7 * n)
    cut = both[n - reach : n + reach + 1, n - reach : n + reach + 1]
    side = reach * first.pixel_m[0] * NM
    ax.imshow(cut, origin="lower", extent=(-side, side, -side, side), cmap="viridis")
    row, column = np.unravel_index(int(np.argmax(cut)), cut.shape)
    at = (np.array([column, row]) - reach) * first.pixel_m[0] * NM
    ax.plot(*at, "o", markersize=9, markerfacecolor="none", markeredgecolor=ORANGE)
    ax.set(xlabel="shift in x / nm", ylabel="shift in y / nm", title="correlation at every shift")


def _difference(first: DriftScan, second: DriftScan, moved_px: Array) -> Array:
    back = ndimage.shift(levelled(second), (-moved_px[1], -moved_px[0]), order=3, cval=np.nan)
    here = levelled(first)
    left = back - here
    rows, columns = (
        slice(max(0, int(np.ceil(-m)) + 2), len(here) - max(0, int(np.ceil(m)) + 2)) for m in moved_px[::-1]
    )
    part = left[rows, columns]
    columns_px = np.arange(part.shape[1])  # a line is taken away from each row, as flattening differs
    lines = np.polynomial.polynomial.polyfit(columns_px, part.T, 1)
    return np.asarray(part - np.polynomial.polynomial.polyval(columns_px, lines))


def _cloud(ax: Axes, estimates_nm: Array, covariance: Array) -> None:
    """Estimates of many pairs that differ by noise alone, and what the first of them said of its own error."""
    values, vectors = np.linalg.eigh(covariance)
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    axes = 2 * np.sqrt(5.99 * values)
    ax.add_patch(Ellipse((0.0, 0.0), axes[1], axes[0], angle=angle, facecolor=BLUE, alpha=0.2, label="95 % ellipse"))
    ax.plot(*estimates_nm.T, "o", markersize=3, color=BLUE, label=f"{len(estimates_nm)} pairs")
    ax.plot(0.0, 0.0, "+", markersize=12, color="black", linestyle="none", label="truth")
    limit = 1.5 * max(np.abs(estimates_nm).max(), axes.max() / 2)
    ax.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xlabel="x / nm", ylabel="y / nm")
    ax.set_title("its error; a pixel is 15.7 nm")
    ax.legend(loc="upper left", handletextpad=0.3)


def shear() -> Figure:
    """What drift does to an image while it is taken, and how it is undone."""
    velocity = (0.2e-9, -0.25e-9)
    settings = {"surface": {"kind": "particles"}, "drift": {"velocity_m_per_s": (*velocity, 0.0)}}
    world = World.from_settings(settings, seed=2, start_s=0.0)
    up = taken(world, (0.0, 0.0), 0.0, 1e-6)
    at_m = np.zeros(2)
    down = taken(world, (0.0, 0.0), up.end_s + 2.0, 1e-6, direction="down")
    from afspm.model.drift_removal import undistorted
    from afspm.plugins.drift.track.shear import velocity_from_up_down

    told = velocity_from_up_down(up, down, estimator())
    v = (float(told.velocity_m_s[0]), float(told.velocity_m_s[1]))
    with styled():
        made = figure(WIDTH_IN, 2.35)
        axes = made.subplots(1, 4)
        both = (("scanned upwards", up), ("then downwards", down))
        for ax, (title, scan) in zip(axes[:2], both, strict=True):
            show_scan(ax, scan, shared_span((up, down)))
            ax.set(xlabel="x / µm", title=title)
        mended = [
            undistorted(levelled(scan), scan.region, v, scan.duration_s, upwards=bool(scan.upwards)) for _, scan in both
        ]
        shift = np.array(velocity) * (down.mid_s - up.mid_s) - at_m
        moved = shift / up.pixel_m
        raw = [levelled(up), ndimage.shift(levelled(down), (-moved[1], -moved[0]), order=3, cval=np.nan)]
        mended[1] = ndimage.shift(np.nan_to_num(mended[1]), (-moved[1], -moved[0]), order=3, cval=np.nan)
        for ax, pictures, title in ((axes[2], raw, "one over the other"), (axes[3], mended, "undistorted")):
            ax.imshow(_overlay(*pictures), origin="lower")
            ax.set(xlabel="x / px", title=title)
        axes[0].set_ylabel("y / µm")
        for ax, name in zip(axes, "abcd", strict=True):
            letter(ax, name)
        nm_min = np.array((*v, *velocity)) * 60e9
        made.suptitle(
            f"velocity from both frames ({nm_min[0]:.1f}, {nm_min[1]:.1f}) nm/min; "
            f"true ({nm_min[2]:.1f}, {nm_min[3]:.1f}) nm/min".replace("-", "−"),
            size=7,
        )
    return made


def _overlay(first: Array, second: Array) -> Array:
    """The first in orange, the second in blue: grey where they agree."""

    def scaled(picture: Array) -> Array:
        low, high = np.nanpercentile(picture, (2, 99.5))
        return np.nan_to_num(np.clip((picture - low) / (high - low), 0.0, 1.0))

    a, b = scaled(first), scaled(second)
    return np.stack([a, (a + b) / 2, b], axis=-1)


def trackers() -> Figure:
    """A night followed in the way of the paper and in ours."""
    hours = 12.0
    ways = (
        ("paper's tracker, BRIEF features", {"tracker": "paper", "estimator": "brief"}, MAGENTA),
        ("paper's tracker, least squares", {"tracker": "paper"}, GREEN),
        ("filter bank, least squares", {}, BLUE),
    )
    with styled():
        made = figure(WIDTH_IN, 4.4)
        above, below = made.subplots(2, 1, sharex=True)
        for name, names, colour in ways:
            done = night(NightSettings.of({"hours": hours, "rescan": "never"} | names), seed=5)
            time_h = (done.record.time_s - done.record.time_s[0]) / HOUR_S
            how: dict[str, Any] = {"color": colour, "markersize": 2.5, "linewidth": 0.8, "label": name}
            above.semilogy(time_h[1:], NM * done.misplaced_m[1:], "o-", **how)
            below.semilogy(time_h[1:], NM * np.hypot(*done.unknown_m[1:].T), "o-", **how)
        above.set_ylabel("position error of the scan / nm")
        below.set_ylabel("error of what is known / nm")
        above.axhline(2e-6 / 127 * NM, color=GREY, linestyle="--", linewidth=0.8)
        above.text(hours, 2e-6 / 127 * NM * 1.1, "a pixel", color=GREY, ha="right")
        above.legend(ncols=3, loc="upper right")
        for ax, part in ((above, "a"), (below, "b")):
            letter(ax, part)
        time_axis(below)
    return made


DRAWN: dict[str, Callable[[], Figure]] = {"registration": registration, "shear": shear, "trackers": trackers}


def main() -> None:
    for name in sys.argv[1:] or DRAWN:
        path = PICTURES / f"drift-{name}.png"
        DRAWN[name]().savefig(path, dpi=DPI)
        sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main()
