"""A drawing in the making: boxes, arrows and texts, in colours that have a dark counterpart."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from drawing_colours import BAD, CONTROL, DATA, GOOD, GREY, INK, PAPER, QUIET, following_the_screen

from afspm.experiment.svg import Svg

__all__ = ["BAD", "CONTROL", "DATA", "GOOD", "GREY", "INK", "PAPER", "QUIET", "Sheet"]

FILLS: Final = {
    "component": ("#eaf5ea", GOOD),
    "scheduler": ("#fdf0e3", CONTROL),
    "translator": ("#e7f1f8", DATA),
    "controller": ("#eeeeee", GREY),
    "frame": ("none", "#bbbbbb"),
    "decision": ("#fff8dc", "#a08000"),
    "flag": (BAD, BAD),
    "idle": ("none", "#bbbbbb"),
}
XY = tuple[float, float]


@dataclass
class Sheet:
    """A drawing in the making; boxes are given by their middle."""

    svg: Svg = field(default_factory=Svg)

    def box(
        self, at: XY, size: XY, kind: str, *lines: str, bold: bool = True, ink: str = INK, outlined: str = ""
    ) -> None:
        """A box with lines of text in its middle, and a second outline around it in the colour `outlined`."""
        (x, y), (width, height) = at, size
        fill, stroke = FILLS[kind]
        if outlined:
            for wider in (6, 8):
                self.svg.box(
                    x - (width + wider) / 2,
                    y - (height + wider) / 2,
                    width + wider,
                    height + wider,
                    fill="none",
                    stroke=outlined,
                    corner=9,
                )
        self.svg.box(x - width / 2, y - height / 2, width, height, fill=fill, stroke=stroke, dashed=kind == "idle")
        for number, line in enumerate(lines):
            below = (number - (len(lines) - 1) / 2) * 15 + 4
            self.svg.text(x, y + below, line, size=12, bold=bold and number == 0, fill=ink)

    def frame(self, corner: XY, size: XY, title: str) -> None:
        """A dashed frame with a title at its top."""
        fill, stroke = FILLS["frame"]
        self.svg.box(*corner, *size, fill=fill, stroke=stroke, dashed=True)
        self.svg.text(corner[0] + 10, corner[1] + 18, title, anchor="start", fill=QUIET)

    def arrow(self, *points: XY, stroke: str = GREY, both: bool = False, text: str = "", at: XY | None = None) -> None:
        """A line through points, with a word beside it."""
        self.svg.line(points, stroke=stroke, start=both)
        if text:
            x, y = at or ((points[0][0] + points[-1][0]) / 2, (points[0][1] + points[-1][1]) / 2 - 5)
            self.svg.text(x, y, text, size=11, fill=stroke, halo=True)

    def note(
        self, at: XY, text: str, *, anchor: str = "middle", bold: bool = False, fill: str = INK, size: float = 12
    ) -> None:
        """A line of text."""
        self.svg.text(*at, text, anchor=anchor, bold=bold, fill=fill, size=size)

    def document(self, width: float, height: float, title: str) -> str:
        """The whole picture, which is dark where the reader's screen is."""
        return following_the_screen(self.svg.document(width, height, title, (GREY, DATA, CONTROL, BAD, GOOD)))
