"""What a picture cuts off at its border."""

from __future__ import annotations

from pathlib import Path


def cut_sides(path: Path) -> list[str]:
    """Return the sides of an image file where something other than its paper touches the border."""
    from matplotlib.image import imread

    pixels = imread(path)[..., :3].mean(axis=2)
    edges = {"top": pixels[0], "bottom": pixels[-1], "left": pixels[:, 0], "right": pixels[:, -1]}
    return [side for side, edge in edges.items() if abs(edge - pixels[0, 0]).max() > 0.1]
