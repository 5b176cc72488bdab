"""A quantity of a curve of any kind."""


def middle(spectrum) -> float:
    """Return the middle value of the last measured column."""
    return float(spectrum.values[len(spectrum.values) // 2, -1])
