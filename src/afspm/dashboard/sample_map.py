"""The sample as a map: where everything of the run lies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from afspm.drawing.curves import Array, round_ticks
from afspm.formatting import scale, time_of_day, typeset_area
from afspm.model import Region
from afspm.record.overview import ScanSummary, SpectrumSummary

MOST_PLACES = 1500
_MARGIN = 0.06
_SAME = 200.0  # places that differ by less than this part of their size are one on the map


@dataclass(frozen=True)
class MapContent:
    """The content of the map, in the coordinates of components (of the sample, where drift is corrected).

    Attributes:
        current: the region that is set.
        limits: where scans may lie at all, in tip coordinates.
        tip_to_sample: 2 x 3; None where the two are the same.
        probe_m: where the probe stands.
        shown_ns: time of the newest scan.
    """

    scans: Sequence[ScanSummary] = ()
    spectra: Sequence[SpectrumSummary] = ()
    current: Region | None = None
    limits: Region | None = None
    tip_to_sample: Array | None = None
    probe_m: tuple[float, float] | None = None
    shown_ns: int | None = None


def map_html(content: MapContent, *, whole: bool = True) -> str:
    """Return the map; scans have their time and channel as data-time and data-channel, spectra their time.

    Args:
        whole: all of what the limits allow; else the part where something was measured, and what is set now.
    """
    places, left_out = places_of(content.scans)
    spectra = [one for one in content.spectra if one.position_m is not None][-MOST_PLACES:]
    corners = [one.region.corners_m() for one, _ in places] + [np.array([one.position_m]) for one in spectra]
    if content.current is not None:
        corners.append(content.current.corners_m())
    limits = None if content.limits is None else _over_the_sample(content.limits, content.tip_to_sample)
    if limits is not None and (whole or not corners):
        corners.append(limits)
    if content.probe_m is not None and (whole or not corners):
        corners.append(np.array([content.probe_m]))
    if not corners:
        return '<p class="nothing">No place is known yet.</p>'
    view = MapView.around(np.concatenate(corners))
    shapes = [
        "" if limits is None else view.polygon(limits, "limits"),
        *(_scan(view, one, count, content.shown_ns) for one, count in places),
        "" if content.current is None else view.polygon(content.current.corners_m(), "current"),
        *(_spectrum(view, one) for one in spectra),
    ]
    if content.probe_m is not None:
        x, y = view.at(content.probe_m)
        cross = f"M{x - 14:.2f} {y:.2f}h28M{x:.2f} {y - 14:.2f}v28"
        shapes.append(f'<path class="probe" d="{cross}"><title>the probe</title></path>')
    keys = {
        "scan": ("scans; click one to see it", bool(content.scans)),
        "current": ("set now", content.current is not None),
        "spectrum": ("spectra", bool(spectra)),
        "limits": ("limits", limits is not None and whole),
    }
    shown = "".join(f'<span class="key-{name}">{text}</span>' for name, (text, is_there) in keys.items() if is_there)
    more = f"<p>{left_out} older places are not drawn.</p>" if left_out else ""
    words = f"{len(places)} places with scans and {len(spectra)} spectra"
    return (
        f'<figure class="map" role="img" aria-label="Map of the sample: {words}">'
        f'<div class="map-area" style="aspect-ratio:{view.width:.6g}/{view.height:.6g}">'
        f'<svg viewBox="0 0 {view.width:.6g} {view.height:.6g}">{"".join(shapes)}</svg>{_ticks(view)}</div>'
        f'<div class="map-keys">{shown}</div>{_drift_words(content.tip_to_sample)}{more}</figure>'
    )


def places_of(scans: Sequence[ScanSummary]) -> tuple[list[tuple[ScanSummary, int]], int]:
    """Return ([(newest scan, how many) for each place], how many older places are left out); large ones first."""
    found: dict[tuple[int, ...], tuple[ScanSummary, int]] = {}
    seen: dict[tuple[int, ...], int] = {}
    for scan in scans:
        key = _place_key(scan.region)
        if seen.get(key) != scan.time_ns:
            seen[key] = scan.time_ns
            count = found.pop(key, (scan, 0))[1]
            found[key] = (scan, count + 1)
    newest = list(found.values())[-MOST_PLACES:]
    newest.sort(key=lambda one: -one[0].region.size_m[0] * one[0].region.size_m[1])
    return newest, len(found) - len(newest)


def _place_key(region: Region) -> tuple[int, ...]:
    """Return a key that is the same for regions alike in size, place and angle.

    Sizes count by their logarithm: divided by the size, those of all squares would be the same.
    """
    step_m = max(region.size_m) / _SAME
    sizes = (round(math.log(side_m) * _SAME) for side_m in region.size_m)
    return (*(round(v / step_m) for v in region.center_m), *sizes, round(region.angle_rad * 500))


@dataclass(frozen=True)
class MapView:
    """The part of the plane that is shown, in a unit that makes handy numbers. y is upwards, unlike on the screen."""

    left_m: float
    low_m: float
    width: float
    height: float
    per_m: float

    @classmethod
    def around(cls, points_m: Array) -> MapView:
        """Return the view that has all points in it, with a margin."""
        low, high = points_m.min(axis=0), points_m.max(axis=0)
        side = max(*(high - low), 1e-10)
        low, high = low - _MARGIN * side, high + _MARGIN * side
        # never narrower than two to three, which nobody could click in
        lacking = np.maximum(0.67 * (high - low).max() - (high - low), 0.0)
        low, high = low - lacking / 2, high + lacking / 2
        per_m = 1000.0 / float((high - low).max())
        width, height = (float(v) * per_m for v in high - low)
        return cls(float(low[0]), float(low[1]), width, height, per_m)

    def at(self, xy_m: Sequence[float] | Array) -> tuple[float, float]:
        x, y = (float(xy_m[0]) - self.left_m) * self.per_m, (float(xy_m[1]) - self.low_m) * self.per_m
        return x, self.height - y

    def polygon(self, corners_m: Array, style: str, inside: str = "", data: str = "") -> str:
        points = " ".join("{:.2f},{:.2f}".format(*self.at(corner)) for corner in corners_m)
        return f'<polygon class="{style}" points="{points}"{data}>{inside}</polygon>'


def _over_the_sample(limits: Region, tip_to_sample: Array | None) -> Array:
    """Return the corners of what is allowed, moved along with the tip over a sample that drifts."""
    corners = limits.corners_m()
    return corners if tip_to_sample is None else np.asarray(corners @ tip_to_sample[:, :2].T + tip_to_sample[:, 2])


def _scan(view: MapView, one: ScanSummary, count: int, shown_ns: int | None) -> str:
    often = f", {count} scans" if count > 1 else ""
    cut = ", interrupted" if one.interrupted else ""
    who = f" by {one.holder}" if one.holder else ""
    title = f"{typeset_area(one.region.size_m)} at {time_of_day(one.time_ns)}{who}{often}{cut}"
    style = "scan" + (" cut" if one.interrupted else "") + (" shown" if shown_ns == one.time_ns else "")
    data = f' data-time="{one.time_ns}" data-channel="{escape(one.channel)}"'
    return view.polygon(one.region.corners_m(), style, f"<title>{escape(title)}</title>", data)


def _spectrum(view: MapView, one: SpectrumSummary) -> str:
    assert one.position_m is not None
    x, y = view.at(one.position_m)
    title = escape(f"{one.kind or 'spectrum'} at {time_of_day(one.time_ns)}")
    return f'<path class="spectrum" d="M{x:.2f} {y:.2f}h0" data-spectrum="{one.time_ns}"><title>{title}</title></path>'


def _ticks(view: MapView) -> str:
    low = np.array([view.left_m, view.low_m])
    high = low + np.array([view.width, view.height]) / view.per_m
    factor, unit = scale(float(np.abs(np.concatenate([low, high])).max()), "m")
    parts = []
    for axis, side in ((0, "left"), (1, "bottom")):
        span = high[axis] - low[axis]
        for value in round_ticks(float(low[axis]) * factor, float(high[axis]) * factor, 4):
            at = 100.0 * (value / factor - low[axis]) / span
            text = f"{value:g}".replace("-", "−")
            parts.append(f'<span class="tick-{"xy"[axis]}" style="{side}:{at:.2f}%">{text}</span>')
    return f'{"".join(parts)}<span class="map-unit">{unit}</span>'


def _drift_words(tip_to_sample: Array | None) -> str:
    if tip_to_sample is None:
        return ""
    x, y = tip_to_sample[:, 2]
    factor, unit = scale(max(abs(x), abs(y)), "m")
    return (
        f'<p class="map-drift">Sample coordinates; the sample has moved by ({-x * factor:.3g}, {-y * factor:.3g}) '
        f"{unit} under the tip, and what it may reach with it.</p>"
    )
