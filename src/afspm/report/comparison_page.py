"""The comparison of runs as one HTML page, without scripts and external files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from afspm.basics import typeset_area
from afspm.basics.errors import FileError
from afspm.basics.formatting import quantity
from afspm.drawing import DIVERGING, PALETTES, reduced
from afspm.drawing.image_html import Shown, image_html
from afspm.drawing.raster import ValueRange, indices, png, shared_range, value_range
from afspm.model.arrays import Array
from afspm.report.comparison import ComparedRegion, RegionScan, RunComparison, ScanDifference
from afspm.report.markup import document, section, table
from afspm.storage.atomic import replace_file

_LARGEST_PX = 256
_WIDTH = "220px"
# the second picture covers the first in turns of 0.7 s: slow enough for people who are sensitive to flashes
_CSS = """
main{max-width:1280px}th b{color:var(--problem)}
.beside{display:flex;flex-wrap:wrap;gap:1rem 1.6rem}.beside figure{margin:0;width:290px}
.stack{position:relative}.stack>.over{position:absolute;inset:0;visibility:hidden;background:var(--paper)}
figure:has(:checked) .over{animation:flicker 1.4s steps(1) infinite}
@keyframes flicker{50%{visibility:visible}}
@media print{.flicker{display:none}}
"""


def write(comparison: RunComparison, target: Path) -> None:
    """Write a comparison as an HTML page.

    Raises:
        FileError: the page can't be written.
    """
    try:
        replace_file(target, [html(comparison).encode()], synced=False)
    except OSError as error:
        raise FileError(f"can't be written: {error.strerror or error}", where=str(target)) from error


def html(comparison: RunComparison) -> str:
    title = escape(" and ".join(comparison.names))
    badge = '<span class="badge">SIMULATED</span>' if any(comparison.simulated) else ""
    heads = ["", *comparison.names]
    facts = [[escape(head), *map(escape, texts)] for head, texts in comparison.facts.items()]
    settings = [[f"<code>{escape(key)}</code>", *map(escape, texts)] for key, texts in comparison.settings.items()]
    body = [
        f"<header><h1>{title}{badge}</h1></header>",
        section("Runs", table(heads, facts)),
        section("Different settings", table(heads, settings) or "<p>None.</p>"),
        section("Roughness", _roughness(comparison)),
        section("The same regions", _regions(comparison)),
        section("Not compared", "".join(f'<p class="note">{escape(reason)}</p>' for reason in comparison.unread)),
    ]
    return document(title, "".join(body), _CSS)


def roughness_rows(comparison: RunComparison) -> list[list[str]]:
    """Return a row for each region: its name, and a text for each run."""
    return [[region.name, *map(_roughness_text, region.scans)] for region in comparison.regions]


def _roughness_text(scan: RegionScan | None) -> str:
    if scan is None or scan.roughness is None:
        return "–"
    rows, columns = scan.scan.shape
    sq, sa = (quantity(value, scan.scan.unit, 3) for value in (scan.roughness.sq, scan.roughness.sa))
    return f"Sq {sq}, Sa {sa} ({columns} × {rows})"


def _roughness(comparison: RunComparison) -> str:
    rows = [[escape(cell) for cell in row] for row in roughness_rows(comparison)]
    note = (
        '<p class="note">Root mean square Sq and mean deviation Sa of each region, with its pixels. Lines are levelled '
        "to one height and a plane is subtracted, so undulations along the slow axis do not count. Values of different "
        "pixel sizes or different probes are not comparable.</p>"
    )
    return table(["region", *comparison.names], rows) + note if rows else ""


def _regions(comparison: RunComparison) -> str:
    if not comparison.regions:
        return (
            "<p>None: no two runs have whole scans with the same key, or without a key at the same place. After a "
            "sample was mounted again, <code>afspm find</code> finds the places.</p>"
        )
    shown = "".join(_region(region, comparison) for region in comparison.regions)
    more = f'<p class="note">{comparison.left_out} more regions are in the records.</p>' if comparison.left_out else ""
    return shown + more


def _region(region: ComparedRegion, comparison: RunComparison) -> str:
    seen = [scan for scan in region.scans if scan is not None]
    units = {(scan.scan.channel, scan.scan.unit) for scan in seen}
    # one contrast for all; scans of different channels have none in common
    span = shared_range(scan.values for scan in seen) if len(units) == 1 else None
    figures = "".join(_figures(region, comparison, span))
    about = f"{seen[0].scan.channel}, {typeset_area(seen[0].scan.region.size_m)}"
    return f"<h3>{escape(region.name)}</h3><p class='note'>{escape(about)}</p><div class='beside'>{figures}</div>"


def _figures(region: ComparedRegion, comparison: RunComparison, span: ValueRange | None) -> Iterator[str]:
    names, marks = comparison.names, [" SIMULATED" if one else "" for one in comparison.simulated]
    for name, mark, scan in zip(names, marks, region.scans, strict=True):
        if scan is not None:
            caption = f"{name}, scan {scan.row.number}{mark}"
            yield _figure(_image(scan.values, scan, span), caption)
    first = next(scan for scan in region.scans if scan is not None)
    for k, change in region.differences.items():
        yield from _change(first, change, names[k], span)


def _change(first: RegionScan, change: ScanDifference, name: str, span: ValueRange | None) -> Iterator[str]:
    if change.values is None or change.aligned is None:
        yield _figure("", f"{name}: {change.words}")
        return
    found = value_range(change.values)
    most = max(abs(found.low), abs(found.high))
    drawn = _image(change.values, first, ValueRange(-most, most), DIVERGING)  # white is no difference
    yield _figure(drawn, f"{name} minus the first; {change.words}")
    stack = (
        f'<div class="stack">{_image(first.values, first, span)}'
        f'<div class="over">{_image(change.aligned, first, span)}</div></div>'
    )
    box = '<label class="flicker"><input type="checkbox"> Flicker</label>'
    yield _figure(stack, f"the first and {name}, aligned", box)


def _figure(picture: str, caption: str, control: str = "") -> str:
    return f"<figure>{picture}{control}<figcaption>{escape(caption)}</figcaption></figure>"


def _image(values: Array, scan: RegionScan, span: ValueRange | None, palette: str = PALETTES[0]) -> str:
    some = reduced(values, _LARGEST_PX, each_side=True)
    span = span or value_range(some)
    image = Shown(png(indices(some, span), palette), span)
    return image_html(image, scan.scan.region.size_m, scan.scan.unit, _WIDTH, palette)


def rows_that_differ(comparison: RunComparison) -> Sequence[tuple[str, Sequence[str]]]:
    """Return the rows of the printed table: facts, then settings, then roughness."""
    roughness = [(f"roughness of {name}", texts) for name, *texts in roughness_rows(comparison)]
    return [*comparison.facts.items(), *comparison.settings.items(), *roughness]
