"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 1087 pairs of the fitted half of the families, from seed 20000;
433 of them were wrong.
"""

INTERCEPT = -5.6724
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.1929,
    "sd_px": 0.8906,
    "gap": -1.0931,
    "rival": 0.4650,
    "agreement": -6.9564,
    "above_repeats": -1.4866,
    "surprise": 1.3414,
    "searched": 0.4268,
}

RIGHT = {
    "overlap": -0.4762,
    "sd_px": -3.2465,
    "gap": 5.2089,
    "rival": 0.0261,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

SPREAD = {
    "all": 4.1576,
    "varied": 0.1816,
    "shared": 0.1366,
    "unclear": 0.2408,
    "leverage": 0.8679,
    "most": 24.5484,
}
"""By which covariances are larger than their model says, see `Doubt`."""
