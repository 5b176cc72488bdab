"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 1590 pairs of the fitted half of the families, from seed 20000;
653 of them were wrong.
"""

INTERCEPT = -5.9944
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -1.0522,
    "sd_px": 1.4460,
    "gap": -0.5652,
    "rival": 0.5237,
    "agreement": -8.7422,
    "above_repeats": -2.7199,
    "surprise": 1.2067,
    "searched": 0.5607,
}

RIGHT = {
    "overlap": -0.5250,
    "sd_px": -3.6551,
    "gap": 5.6091,
    "rival": 0.0252,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.07
"""The largest probability with which at most 0.35% of those accepted were wrong."""

SPREAD = {
    "all": 2.0694,
    "varied": 0.6690,
    "shared": 0.3063,
    "unclear": 0.6537,
}
"""By which covariances are larger than their model says, see `Doubt`."""
