"""Two hypotheses about a spot: their gaps, their fits, and the odds of one against the other.

Places are arrays (n, 2), in units of the region from its centre; gaps are in eV.
"""

import numpy as np
from scipy.optimize import least_squares

EXPONENTS = {"diffuse": 2.0, "sharp": 8.0}  # a Gaussian, as after diffusion; a flat inclusion with a steep edge


def spot(name, places, ground, change, x, y, half_width):
    """Return the gaps of a hypothesis: half of the change is left at the half-width."""
    distance = np.hypot(places[:, 0] - x, places[:, 1] - y) / abs(half_width)
    return ground + change * 0.5 ** np.minimum(distance ** EXPONENTS[name], 99.0)


def fitted(name, places, gaps):
    """Return the best fit of a hypothesis from several starts, since an edge between two curves has local minima."""
    ground, far = np.median(gaps), np.abs(gaps - np.median(gaps)).argmax()
    starts = [(ground, gaps[far] - ground, *places[far], half_width) for half_width in (0.1, 0.2, 0.3)]
    fits = [least_squares(lambda values: spot(name, places, *values) - gaps, start) for start in starts]
    return min(fits, key=lambda fit: fit.cost)


def judged(places, gaps):
    """Return the better hypothesis, its probability if one of them is true, and the parameters of all fits."""
    fits = {name: fitted(name, places, gaps) for name in EXPONENTS}
    better, other = sorted(fits, key=lambda name: fits[name].cost)
    # both have five parameters, and the noise is unknown: the odds are a power of the ratio of the squares
    odds = (fits[other].cost / fits[better].cost) ** ((len(gaps) - 5) / 2)
    return better, float(odds / (1.0 + odds)), {name: fit.x for name, fit in fits.items()}


def difference(fits, places):
    """Return by how many eV the fits differ at places."""
    one, other = (spot(name, places, *values) for name, values in fits.items())
    return np.abs(one - other)
