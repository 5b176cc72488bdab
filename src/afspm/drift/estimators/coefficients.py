"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 3397 pairs of the fitted half of the families, from seed 20000;
1229 of them were wrong.
"""

INTERCEPT = -6.9362
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.5444,
    "sd_px": 1.4966,
    "gap": -0.6578,
    "rival": 0.4452,
    "agreement": -9.7600,
    "above_repeats": -3.4455,
    "surprise": 1.2655,
    "searched": 0.6174,
}

RIGHT = {
    "overlap": -0.5307,
    "sd_px": -3.3712,
    "gap": 5.4723,
    "rival": 0.0275,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.07
"""The largest probability with which at most 0.35% of those accepted were wrong."""

SPREAD = {
    "all": 1.5103,
    "varied": 0.5749,
    "shared": 2.4268,
    "unclear": 0.9892,
    "leverage": 0.7732,
}
"""By which covariances are larger than their model says, see `Doubt`."""
