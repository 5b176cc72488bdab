"""A quantity of a curve of any kind."""

from afspm import Spectrum


def middle(spectrum: Spectrum) -> float:
    """Return the middle value of the last measured column."""
    return float(spectrum.values[len(spectrum.values) // 2, -1])
