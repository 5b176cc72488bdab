"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 1590 pairs of the fitted half of the families, from seed 20000;
653 of them were wrong.
"""

INTERCEPT = -6.0269
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.8384,
    "sd_px": 1.4938,
    "gap": -0.5993,
    "rival": 0.4676,
    "agreement": -8.9600,
    "above_repeats": -2.7187,
    "surprise": 1.2403,
    "searched": 0.5710,
}

RIGHT = {
    "overlap": -0.5250,
    "sd_px": -3.3695,
    "gap": 5.6091,
    "rival": 0.0252,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.1
"""The largest probability with which at most 0.35% of those accepted were wrong."""

SPREAD = {
    "all": 4.6934,
    "varied": 0.3652,
    "shared": 0.9767,
    "unclear": 0.6373,
}
"""By which covariances are larger than their model says, see `Doubt`."""
