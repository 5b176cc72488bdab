"""The colours of the drawings, and their dark counterparts: without afspm, since `make docs` does not install it.

A drawing is kept once, in light colours, with a style that follows the reader's screen, as a forge shows it. The site
has a switch of its own, so `make docs` makes a light and a dark file. Two files in the repository would be twice as
much to keep equal; on a transparent background grey text is readable in one scheme alone.
"""

from __future__ import annotations

from typing import Final

GREY, DATA, CONTROL, BAD, GOOD = "#777777", "#2c7fb8", "#d95f0e", "#c0392b", "#2a7f3f"
INK, QUIET, PAPER = "#222222", "#555555", "#ffffff"
DARK: Final = {
    INK: "#e8e8e8",
    QUIET: "#b4b4b4",
    PAPER: "#15171c",
    GREY: "#a8a8a8",
    DATA: "#6fb3e0",
    CONTROL: "#f39a55",
    BAD: "#ef7b70",
    GOOD: "#6cc384",
    "#bbbbbb": "#62656d",
    "#dddddd": "#4a4d55",
    "#eaf5ea": "#1c3323",
    "#fdf0e3": "#3b2a18",
    "#e7f1f8": "#17313f",
    "#eeeeee": "#31343b",
    "#fff8dc": "#38321a",
    "#a08000": "#cdb04a",
}
"""Each colour of a drawing, and the one that takes its place on a dark page."""
_STYLE_END: Final = "</style>\n"


def following_the_screen(drawing: str) -> str:
    """Return a drawing that is dark where the reader's screen is."""
    rules = [f'[{name}="{old}"]{{{name}:{new}}}' for old, new in DARK.items() for name in ("fill", "stroke")]
    style = f"<style>@media (prefers-color-scheme: dark){{{''.join(rules)}}}{_STYLE_END}"
    return drawing.replace("<defs>", f"{style}<defs>", 1)


def light(drawing: str) -> str:
    """Return a drawing that is light whatever the screen, for a page with a switch of its own."""
    before, _, after = drawing.partition("<style>")
    return before + after.partition(_STYLE_END)[2]


def dark(drawing: str) -> str:
    """Return a drawing that is dark whatever the screen."""
    text = light(drawing)
    for old, new in DARK.items():
        text = text.replace(f'"{old}"', f'"{new}"')
    return text
