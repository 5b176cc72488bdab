"""SVG shapes for drawings of an experiment, and an estimate of text widths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape, quoteattr

FONT = "Helvetica, Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"

_NARROW, _WIDE = set("iljtfrI.,:;'|!()[]/ -"), set("mwMW@%")


def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Return the approximate width of a text in a sans-serif font, rather too wide than too narrow."""
    ems = sum(0.34 if c in _NARROW else 0.9 if c in _WIDE else 0.73 if c.isupper() else 0.62 for c in text)
    return ems * size * (1.07 if bold else 1.0)


class Svg:
    """A drawing of lines, then boxes, then texts, so that no line covers a text."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._boxes: list[str] = []
        self._texts: list[str] = []

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        *,
        fill: str,
        stroke: str,
        dashed: bool = False,
        corner: float = 7,
    ) -> None:
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        self._boxes.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="{corner:g}" '
            f'fill="{fill}" stroke="{stroke}" stroke-width="1.4"{dash}/>'
        )

    def text(
        self,
        x: float,
        y: float,
        text: str,
        *,
        size: float = 12,
        fill: str = "#222222",
        anchor: str = "middle",
        bold: bool = False,
        halo: bool = False,
    ) -> None:
        """Write one line of text on the baseline y; a halo keeps it legible over lines."""
        weight = ' font-weight="600"' if bold else ""
        shape = f'x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}"{weight}'
        if halo:  # drawn as a second text beneath: not every viewer supports paint-order
            self._texts.append(
                f'<text {shape} fill="#ffffff" stroke="#ffffff" stroke-width="5" stroke-linejoin="round" '
                f'aria-hidden="true">{escape(text)}</text>'
            )
        self._texts.append(f'<text {shape} fill="{fill}">{escape(text)}</text>')

    def line(
        self,
        points: Sequence[tuple[float, float]],
        *,
        stroke: str,
        start: bool = False,
        end: bool = True,
        dashed: bool = False,
    ) -> None:
        """Draw a line through points with round corners, and an arrow head at its start or end."""
        dash = ' stroke-dasharray="2 4"' if dashed else ""
        heads = "".join(
            f' marker-{where}="url(#head-{stroke[1:]})"' for where, wanted in (("start", start), ("end", end)) if wanted
        )
        self._lines.append(
            f'<path d={quoteattr(_rounded(points))} fill="none" stroke="{stroke}" stroke-width="1.8"{dash}{heads}/>'
        )

    def document(self, width: float, height: float, title: str, colours: Iterable[str]) -> str:
        """Return the whole picture as SVG, on white."""
        heads = "".join(
            f'<marker id="head-{c[1:]}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
            f'orient="auto-start-reverse"><path d="M0 0.8 L10 5 L0 9.2 z" fill="{c}"/></marker>'
            for c in colours
        )
        body = "\n".join([*self._lines, *self._boxes, *self._texts])
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="{FONT}" role="img">\n'
            f"<title>{escape(title)}</title>\n<defs>{heads}</defs>\n"
            f'<rect width="100%" height="100%" fill="#ffffff"/>\n{body}\n</svg>\n'
        )


def _rounded(points: Sequence[tuple[float, float]], radius: float = 8) -> str:
    x, y = points[0]
    path = [f"M{x:.1f} {y:.1f}"]
    for (ax, ay), (bx, by), (cx, cy) in zip(points, points[1:], points[2:], strict=False):
        before, after = abs(bx - ax) + abs(by - ay), abs(cx - bx) + abs(cy - by)
        r = min(radius, before / 2, after / 2)
        if before and after and r:
            path.append(f"L{bx - (bx - ax) / before * r:.1f} {by - (by - ay) / before * r:.1f}")
            path.append(f"Q{bx:.1f} {by:.1f} {bx + (cx - bx) / after * r:.1f} {by + (cy - by) / after * r:.1f}")
    x, y = points[-1]
    return " ".join([*path, f"L{x:.1f} {y:.1f}"])
