"""Names and places as the page writes them."""

from __future__ import annotations

from afspm import formatting


def position(xy_m: tuple[float, float]) -> str:
    """Return a position as "(1.2, −0.5) µm"."""
    return formatting.typeset(formatting.position_text(xy_m))


def area(size_m: tuple[float, float]) -> str:
    """Return a size as "2 × 1 µm"."""
    return formatting.typeset(formatting.area_text(size_m))


def colour_class(name: str) -> str:
    """Return a class of the style sheet that is the same for a name wherever it is shown."""
    return f"tint-{sum(ord(letter) * (i + 7) for i, letter in enumerate(name)) % 8}"
