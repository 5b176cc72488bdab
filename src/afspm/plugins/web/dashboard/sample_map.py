"""The sample as a map of all scans, spectra and targets of the run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

import numpy as np

from afspm.basics import counted, quantity, scale, time_of_day, typeset_area, typeset_position
from afspm.components import Array
from afspm.drawing import Axis
from afspm.model import XY, Region
from afspm.night import FoundPlace, ScanSummary, SpectrumSummary

MOST_PLACES = 1500
MOST_PICTURES = 300
_MARGIN = 0.06
_LEAST = np.array([1.1, 0.67])  # width and height, as parts of the longer side
_SAME = 200.0  # regions that differ by less than 1/200 of their size are the same place on the map


@dataclass(frozen=True)
class MapContent:
    """The content of the map, in the coordinates of components (sample coordinates where drift is corrected).

    Attributes:
        current: the present scan region.
        limits: the allowed region of scans, in tip coordinates.
        tip_to_sample: 2 x 3; None if both coordinates are equal.
        probe_m: the probe's position.
        shown_ns: time of the newest scan.
        targets: places found by components.
        pictures: the address of pictures of scans; empty: only outlines are drawn.
    """

    scans: Sequence[ScanSummary] = ()
    spectra: Sequence[SpectrumSummary] = ()
    current: Region | None = None
    limits: Region | None = None
    tip_to_sample: Array | None = None
    probe_m: XY | None = None
    shown_ns: int | None = None
    targets: Sequence[FoundPlace] = ()
    pictures: str = ""


def map_html(content: MapContent, *, whole: bool = True) -> str:
    """Return the map; scans have their time and channel as data-time and data-channel, spectra their time.

    Args:
        whole: the whole region of the limits; else only the area of measurements and of the region in force.
    """
    places, left_out = places_of(content.scans)
    spectra = [one for one in content.spectra if one.position_m is not None][-MOST_PLACES:]
    limits = None if content.limits is None else _over_the_sample(content.limits, content.tip_to_sample)
    corners = _shown_points(content, places, spectra)
    if limits is not None and (whole or not corners):
        corners.append(limits)
    if content.probe_m is not None and (whole or not corners):
        corners.append(np.array([content.probe_m]))
    if not corners:
        return '<p class="nothing">No scan or spectrum yet.</p>'
    view = MapView.around(np.concatenate(corners))
    probe = content.probe_m
    shapes = [
        *(_picture(view, one, content.pictures) for one, _ in places[-MOST_PICTURES:] if content.pictures),
        "" if limits is None else view.polygon(limits, "limits"),
        # a small scan below a newer, larger one can still be seen and clicked
        *(_scan(view, *place, content.shown_ns) for place in sorted(places, key=_area_m2, reverse=True)),
        "" if content.current is None else view.polygon(content.current.corners_m(), "current"),
        *(_target(view, one) for one in content.targets[-MOST_PLACES:]),
        *(_spectrum(view, one) for one in spectra),
        "" if probe is None else _probe(view, probe),
    ]
    away = "" if probe is None or view.contains(probe) else _away(view, probe)
    more = f"<p>{left_out} older places are left out.</p>" if left_out else ""
    words = f"{counted(len(places), 'place')} with scans and {counted(len(spectra), 'spectrum', 'spectra')}"
    aspect = view.width / view.height
    return (
        f'<figure class="map" role="img" aria-label="Map of the sample: {words}">'
        f'<div class="map-fit"><div class="map-area" style="--aspect:{aspect:.6g}">'
        f'<svg viewBox="0 0 {view.width:.6g} {view.height:.6g}">{"".join(shapes)}</svg>{_ticks(view)}{away}</div></div>'
        f'<div class="map-keys">{_keys(content, spectra, whole=whole)}</div>{_drift_words(content.tip_to_sample)}{more}'
        "</figure>"
    )


def _shown_points(
    content: MapContent, places: Sequence[tuple[ScanSummary, int]], spectra: Sequence[SpectrumSummary]
) -> list[Array]:
    # points in every view of the map
    points = [one.region.corners_m() for one, _ in places] + [np.array([one.position_m]) for one in spectra]
    if content.current is not None:
        points.append(content.current.corners_m())
    return points


def _keys(content: MapContent, spectra: Sequence[SpectrumSummary], *, whole: bool) -> str:
    keys = {
        "scan": ("scans; click one to see it", bool(content.scans)),
        "current": ("set now", content.current is not None),
        "probe": (f"probe {'' if content.probe_m is None else typeset_position(content.probe_m)}", content.probe_m),
        "target": (f"found: {len(content.targets)} places", bool(content.targets)),
        "spectrum": ("spectra", bool(spectra)),
        "limits": ("limits", content.limits is not None and whole),
    }
    return "".join(f'<span class="key-{name}">{text}</span>' for name, (text, is_there) in keys.items() if is_there)


def places_of(scans: Sequence[ScanSummary]) -> tuple[list[tuple[ScanSummary, int]], int]:
    """Return [(newest scan, number of scans) per place], newest place last, and the number of older places left out."""
    found: dict[tuple[int, ...], tuple[ScanSummary, int]] = {}
    seen: dict[tuple[int, ...], int] = {}
    for scan in scans:
        key = _place_key(scan.region)
        if seen.get(key) != scan.time_ns:
            seen[key] = scan.time_ns
            count = found.pop(key, (scan, 0))[1]
            found[key] = (scan, count + 1)
    newest = list(found.values())[-MOST_PLACES:]
    return newest, len(found) - len(newest)


def _area_m2(place: tuple[ScanSummary, int]) -> float:
    return math.prod(place[0].region.size_m)


def _place_key(region: Region) -> tuple[int, ...]:
    # The same for regions alike in size, place and angle. Sizes count by their logarithm: divided by the size itself,
    # all squares would be the same.
    step_m = max(region.size_m) / _SAME
    sizes = (round(math.log(side_m) * _SAME) for side_m in region.size_m)
    return (*(round(v / step_m) for v in region.center_m), *sizes, round(region.angle_rad * 500))


@dataclass(frozen=True)
class MapView:
    """The visible part of the plane, in a unit that gives short numbers. y is upwards, unlike on the screen."""

    left_m: float
    low_m: float
    width: float
    height: float
    per_m: float

    @classmethod
    def around(cls, points_m: Array) -> MapView:
        """Return the view that contains all points, with a margin."""
        low, high = points_m.min(axis=0), points_m.max(axis=0)
        side = max(*(high - low), 1e-10)
        low, high = low - _MARGIN * side, high + _MARGIN * side
        # fits the page's width, and is high enough for clicks
        lacking = np.maximum(_LEAST * (high - low).max() - (high - low), 0.0)
        low, high = low - lacking / 2, high + lacking / 2
        per_m = 1000.0 / float((high - low).max())
        width, height = (float(v) * per_m for v in high - low)
        return cls(float(low[0]), float(low[1]), width, height, per_m)

    def at(self, xy_m: Sequence[float] | Array) -> tuple[float, float]:
        x, y = (float(xy_m[0]) - self.left_m) * self.per_m, (float(xy_m[1]) - self.low_m) * self.per_m
        return x, self.height - y

    def contains(self, xy_m: XY) -> bool:
        x, y = self.at(xy_m)
        return 0.0 <= x <= self.width and 0.0 <= y <= self.height

    def polygon(self, corners_m: Array, style: str, inside: str = "", data: str = "") -> str:
        points = " ".join("{:.2f},{:.2f}".format(*self.at(corner)) for corner in corners_m)
        return f'<polygon class="{style}" points="{points}"{data}>{inside}</polygon>'


def _over_the_sample(limits: Region, tip_to_sample: Array | None) -> Array:
    # limits are in tip coordinates: on the map they move over a drifting sample
    corners = limits.corners_m()
    return corners if tip_to_sample is None else np.asarray(corners @ tip_to_sample[:, :2].T + tip_to_sample[:, 2])


def _picture(view: MapView, one: ScanSummary, pictures: str) -> str:
    # nothing is shown where the values are no longer kept
    (x, y), (width, height) = view.at(one.region.center_m), (side_m * view.per_m for side_m in one.region.size_m)
    turned = f"rotate({-math.degrees(one.region.angle_rad):.3f} {x:.2f} {y:.2f})"
    return (
        f'<image href="{picture_url(pictures, one)}" x="{x - width / 2:.2f}" y="{y - height / 2:.2f}" '
        f'width="{width:.2f}" height="{height:.2f}" preserveAspectRatio="none" transform="{turned}"/>'
    )


def picture_url(pictures: str, scan: ScanSummary) -> str:
    """Return the address of a small picture of a scan, escaped for an attribute."""
    return escape(f"{pictures}/{scan.time_ns}?channel={quote(scan.channel)}")


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


def _target(view: MapView, one: FoundPlace) -> str:
    x, y = view.at(one.xy_m)
    score = "" if one.score is None else f", score {one.score:.3g}"
    return (
        f'<path class="target" d="M{x - 9:.2f} {y:.2f}l9 -9l9 9l-9 9z">'
        f"<title>{escape(f'found at {typeset_position(one.xy_m)}{score}')}</title></path>"
    )


def _probe(view: MapView, probe_m: XY) -> str:
    x, y = view.at(probe_m)
    cross = f"M{x - 22:.2f} {y:.2f}h16m12 0h16M{x:.2f} {y - 22:.2f}v16m0 12v16"
    return f'<path class="probe-ground" d="{cross}"/><path class="probe" d="{cross}"><title>the probe</title></path>'


def _away(view: MapView, probe_m: XY) -> str:
    # an arrow at the edge for a probe outside the view, with its distance
    x, y = view.at(probe_m)
    edge = min(max(x, 0.0), view.width), min(max(y, 0.0), view.height)
    distance_m = math.dist((x, y), edge) / view.per_m
    left, top = 100 * edge[0] / view.width, 100 * edge[1] / view.height
    angle = math.degrees(math.atan2(y - edge[1], x - edge[0]))
    inwards = f"translate({-left:.1f}%,{-top:.1f}%)"
    return (
        f'<span class="map-away" style="left:{left:.2f}%;top:{top:.2f}%;transform:{inwards}">'
        f"probe {quantity(distance_m, 'm', 2)} away"
        f'<i style="transform:rotate({angle:.1f}deg)">➔</i></span>'
    )


def _ticks(view: MapView) -> str:
    low = np.array([view.left_m, view.low_m])
    high = low + np.array([view.width, view.height]) / view.per_m
    largest_m = float(np.abs(np.concatenate([low, high])).max())
    _, unit = scale(largest_m, "m")
    parts = []
    for axis, side in ((0, "left"), (1, "bottom")):
        for at, text in Axis("", "m", float(low[axis]), float(high[axis]), largest_m).ticks(4):
            parts.append(f'<span class="tick-{"xy"[axis]}" style="{side}:{100 * at:.2f}%">{text}</span>')
    return f'{"".join(parts)}<span class="map-unit">{unit}</span>'


def _drift_words(tip_to_sample: Array | None) -> str:
    if tip_to_sample is None:
        return ""
    x, y = tip_to_sample[:, 2]
    factor, unit = scale(max(abs(x), abs(y)), "m")
    return (
        f'<p class="map-drift">Sample coordinates; the sample has moved by ({-x * factor:.3g}, {-y * factor:.3g}) '
        f"{unit} under the tip, and so has the area within reach.</p>"
    )
