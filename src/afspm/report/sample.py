"""The scans of a report as a contact sheet, and on a map of the sample."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from afspm.basics import typeset_area
from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import counted, duration_text, quantity, scale, typeset_position
from afspm.drawing import Axis
from afspm.drawing.image_html import data_url, scale_bar
from afspm.model import Frame, RegistrationOutcome
from afspm.model.geometry import XY
from afspm.model.parameter_names import CRASH, PULSE
from afspm.night.tables import ScanRow
from afspm.night.treatment_ledger import TreatmentPlace
from afspm.report import markup
from afspm.report.markup import PageTimes
from afspm.report.pictures import TopographyPicture
from afspm.report.story import RunStory, colours

_LEGEND = (
    "Click a picture to enlarge it. The bar below it has the colour of who was in control; framed: "
    "bad or interrupted. Topography, rows brought to one height, without its plane; scans of one size share one range "
    "of heights."
)
_OUTCOMES = {
    RegistrationOutcome.REFUSED: "it was recognised in no earlier scan of its place",
    RegistrationOutcome.FAILED: "an error, a time limit or a missing channel prevented the comparison",
    RegistrationOutcome.NEW: "no earlier scan shows its part of the sample",
}
"""The reason for each mark of a scan whose place is extrapolated from earlier drift."""
_MARKS = {PULSE: ("+", "pulse", "pulses"), CRASH: ("×", "crash", "crashes")}
_WIDENED = 3.0
"""The map grows at most by this factor to include treatments; otherwise its scans would get too small."""
_MARGIN = 0.04
_HIDDEN_BEHIND = 40  # most pictures on the map: older pictures disappear beneath newer pictures


def sheet(story: RunStory, shown: Sequence[TopographyPicture], clock: PageTimes) -> str:
    """Return the contact sheet of scans as HTML; empty if the run has spectra only."""
    if not shown:
        return "" if story.spectra else "<p>None.</p>"
    styles = colours(story)
    names = ["", *(name_of(picture.row) for picture in shown), ""]
    figures = [
        _figure(picture, story, styles, clock, (names[index], names[index + 2])) for index, picture in enumerate(shown)
    ]
    left_out = len(story.scans) - len(shown)
    note = f'<p class="note">{left_out} more are not shown.</p>' if left_out else ""
    return f'<div class="sheet">{"".join(figures)}</div>{note}<p class="note">{_LEGEND}{_estimated(shown)}</p>'


def _estimated(shown: Sequence[TopographyPicture]) -> str:
    marks = {picture.row.registration for picture in shown}
    meanings = [f"<b>{outcome.label}</b>: {reason}" for outcome, reason in _OUTCOMES.items() if outcome in marks]
    text = f" The place on the sample is only estimated, from earlier drift: {'; '.join(meanings)}." if meanings else ""
    if RegistrationOutcome.COARSE in marks:
        text += f" <b>{RegistrationOutcome.COARSE.label}</b>: the place was measured, but less accurately."
    return text


def sample_map(
    shown: Sequence[TopographyPicture], spectra_m: Sequence[XY], treated: Sequence[TreatmentPlace], frame: Frame
) -> str:
    """Return an HTML map of the newest scans, the newest on top, and of all spectra; empty if there are neither.

    Treatments of the tip are marked, or listed below the map if they are too far away.
    """
    pictures = _topmost(shown)
    corners = [picture.row.region.corners_m() for picture in pictures if picture.row.region is not None]
    corners += [np.array([position]) for position in spectra_m]
    if not corners:
        return ""
    measured_m = np.concatenate(corners)
    view = _View(measured_m)
    if treated:
        wider = _View(np.concatenate([measured_m, np.array([treatment.xy_m for treatment in treated])]))
        view = wider if max(wider.width, wider.height) <= _WIDENED * max(view.width, view.height) else view
    marked = [treatment for treatment in treated if view.contains(treatment.xy_m)]
    images = "".join(view.image(picture) for picture in pictures)
    points = "".join(view.point(position) for position in spectra_m)
    points += "".join(view.mark(treatment) for treatment in marked)
    places = "sample coordinates" if frame is Frame.SAMPLE else "coordinates of the scanner"
    points_told = "; the points are spectra" if spectra_m else ""
    scans_told = ", the newest scan on top; click one to see it" if pictures else ""
    legend = f"{places.capitalize()}{scans_told}{points_told}{_marks_text(marked)}."
    far = _far_text([treatment for treatment in treated if treatment not in marked])
    return f'{view.frame(images + points)}<p class="note">{legend}{far}</p>'


def _marks_text(marked: Sequence[TreatmentPlace]) -> str:
    made = {treatment.action for treatment in marked}
    return "".join(f"; {sign} {singular}" for action, (sign, singular, _) in _MARKS.items() if action in made)


def _far_text(far: Sequence[TreatmentPlace]) -> str:
    if not far:
        return ""
    counts = Counter(treatment.action for treatment in far)
    what = " and ".join(counted(counts[action], *words[1:]) for action, words in _MARKS.items() if counts[action])
    (left, low), (right, high) = (
        edge(np.array([treatment.xy_m for treatment in far]), axis=0) for edge in (np.min, np.max)
    )
    if (left, low) == (right, high):
        return f" Outside the map: {what} at {typeset_position((left, low))}."
    return f" Outside the map: {what} between {typeset_position((left, low))} and {typeset_position((right, high))}."


class _View:
    """The conversion of positions in m to percent of the width and height of the map."""

    def __init__(self, places_m: NDArray[np.float64]) -> None:
        low, high = places_m.min(axis=0), places_m.max(axis=0)
        extent = max(float((high - low).max()), 1e-12)
        middle = (low + high) / 2.0
        half = np.maximum((high - low) / 2.0, 0.3 * extent) + _MARGIN * extent
        self.left, self.low = (float(value) for value in middle - half)
        self.width, self.height = (float(value) for value in 2.0 * half)

    def frame(self, content: str) -> str:
        largest_m = max(abs(self.left), abs(self.low), self.width, self.height)
        x = Axis("", "m", self.left, self.left + self.width, largest_m)
        y = Axis("", "m", self.low, self.low + self.height, largest_m)
        _, unit = scale(largest_m, "m")
        ticks = [f'<s class="x" style="left:{100 * at:.2f}%">{label}</s>' for at, label in x.ticks()[:-1]]
        ticks += [f'<s class="y" style="top:{100 - 100 * at:.2f}%">{label}</s>' for at, label in y.ticks()[:-1]]
        ticks.append(f'<s class="x" style="left:97%">{unit}</s><s class="y" style="top:3%">{unit}</s>')
        bar = scale_bar((self.width, self.height))
        ratio = self.width / self.height
        look = f"aspect-ratio:{ratio:.5g};max-width:{min(560.0, 480.0 * ratio):.0f}px"
        return f'<div class="map" style="{look}">{content}{bar}{"".join(ticks)}</div>'

    def image(self, picture: TopographyPicture) -> str:
        row, region = picture.row, picture.row.region
        assert region is not None
        assert picture.image is not None
        (width, height), (x, y) = region.size_m, region.center_m
        place = (
            f"left:{self._x(x - width / 2):.3f}%;top:{self._y(y + height / 2):.3f}%;"
            f"width:{100 * width / self.width:.3f}%;height:{100 * height / self.height:.3f}%"
        )
        turned = f";transform:rotate({-math.degrees(region.angle_rad):.3f}deg)" if region.angle_rad else ""
        bad = "bad" if picture.is_bad else ""
        return (
            f'<a class="{bad}" href="#{name_of(row)}" title="scan {row.number}, {typeset_area(region.size_m)}" '
            f'style="{place}{turned}"><img src="{data_url(picture.image.image)}" alt=""></a>'
        )

    def point(self, position_m: XY) -> str:
        x, y = position_m
        title = f"spectrum at {typeset_position(position_m)}"
        return f'<b style="left:{self._x(x):.3f}%;top:{self._y(y):.3f}%" title="{title}"></b>'

    def mark(self, treatment: TreatmentPlace) -> str:
        x, y = treatment.xy_m
        sign, what, _ = _MARKS[treatment.action]
        title = f"{what} at {typeset_position(treatment.xy_m)}"
        return f'<u style="left:{self._x(x):.3f}%;top:{self._y(y):.3f}%" title="{title}">{sign}</u>'

    def contains(self, position_m: XY) -> bool:
        x, y = position_m
        return 0.0 <= self._x(x) <= 100.0 and 0.0 <= self._y(y) <= 100.0

    def _x(self, x_m: float) -> float:
        return 100.0 * (x_m - self.left) / self.width

    def _y(self, y_m: float) -> float:
        return 100.0 - 100.0 * (y_m - self.low) / self.height


def _topmost(shown: Sequence[TopographyPicture]) -> list[TopographyPicture]:
    newest = {
        picture.row.region: picture for picture in shown if picture.image is not None and picture.row.region is not None
    }
    return sorted(newest.values(), key=lambda picture: picture.row.number)[-_HIDDEN_BEHIND:]


def _figure(
    picture: TopographyPicture, story: RunStory, styles: dict[str, str], clock: PageTimes, beside: tuple[str, str]
) -> str:
    row, region = picture.row, picture.row.region
    width, height = region.size_m if region else (1.0, 1.0)
    if picture.image is None:
        shown = '<div class="none">no values</div>'
    else:
        shown = (
            f'<img src="{data_url(picture.image.image)}" alt="scan {row.number}" '
            f'style="aspect-ratio:{width / height:.4g}">'
            f"{scale_bar((width, height))}{_change(picture)}"
        )
    mark = " <b>interrupted</b>" if row.interrupted else ""
    if row.registration is not None and row.registration is not RegistrationOutcome.REGISTERED:
        mark += f" <b>{row.registration.label}</b>"
    if row.outside:
        mark += f" <b>outside: {escape(', '.join(row.outside))}</b>"
    noted = " ✎" if any(note.scan == row.number for note in story.notes) else ""
    size = f"<br>{typeset_area(region.size_m)}" if region else ""
    caption = (
        f'<i class="{styles.get(row.holder or "", "state")}"></i>'
        f"{row.number} · {clock.utc(row.time_ns)}{noted}{mark}{size}"
    )
    facts = dict(_facts(picture, story, clock))
    return markup.figure(
        name_of(row), shown, caption, facts, beside=beside, style="scan bad" if picture.is_bad else "scan",
        ratio=width / height,
    )  # fmt: skip


def _change(picture: TopographyPicture) -> str:
    if picture.changed_row is None or not picture.row.shape:
        return ""
    # the first row is at the bottom
    up = 100.0 * picture.changed_row / picture.row.shape[0]
    return f'<hr class="change" style="bottom:{up:.3f}%" title="tip changed, row {picture.changed_row}">'


def _facts(picture: TopographyPicture, story: RunStory, clock: PageTimes) -> Iterator[tuple[str, str]]:
    row, region = picture.row, picture.row.region
    yield "scan", f"{row.number}{f', {escape(row.key)}' if row.key else ''}"
    yield "finished", clock.whole(row.time_ns)
    if row.began_ns is not None:
        yield "took", duration_text((row.time_ns - row.began_ns) / NS_PER_S)
    if region is not None:
        turned = f", turned by {math.degrees(region.angle_rad):.4g}°" if region.angle_rad else ""
        yield "size", f"{typeset_area(region.size_m)}{turned}"
        yield "centre", typeset_position(region.center_m)
    if row.registration is not None:
        sd = "unknown" if row.position_sd_m is None else f"± {quantity(row.position_sd_m, 'm', 2)}"
        how = "" if row.registration.is_registered else ", by dead reckoning"
        yield (
            "position",
            escape(f"{sd}, {row.registration.label}{how}: {story.why_unregistered(row)}".removesuffix(": ")),
        )
    if row.shape is not None:
        yield "pixels", f"{row.shape[1]} × {row.shape[0]}"
    if picture.image is not None:
        span = picture.image.span
        yield (
            "shown",
            f"{escape(picture.channel)}, {quantity(span.high - span.low, picture.unit, 3)} from dark to light",
        )
    for value in row.instruments:
        outside = f", outside: {', '.join(value.outside)}" if value.outside else ""
        yield escape(value.name), escape(f"{value.text}{outside}")
    yield "in control", escape(row.holder or "none")
    yield "problems", escape(", ".join(row.problems))
    yield from story.proofs.facts(row)
    yield "interrupted", "yes" if row.interrupted else ""
    yield (
        "tip changed",
        "" if picture.changed_row is None else f"row {picture.changed_row}, by the lines of the running scan",
    )
    notes = [note for note in story.notes if note.scan == row.number]
    yield "notes", "<br>".join(f"{escape(note.text)} ({escape(note.who)})" for note in notes)
    yield "file", escape(row.file)


def name_of(row: ScanRow) -> str:
    return f"scan-{row.number}"
