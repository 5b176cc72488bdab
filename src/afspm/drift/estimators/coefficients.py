"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 2561 pairs of the fitted half of the families, from seed 20000;
1014 of them were wrong.
"""

INTERCEPT = -5.7637
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -1.0482,
    "sd_px": 1.0784,
    "gap": -1.1056,
    "rival": 0.3724,
    "agreement": -5.6084,
    "above_repeats": -1.9349,
    "surprise": 1.2881,
    "searched": 0.5009,
}

RIGHT = {
    "overlap": -0.4786,
    "sd_px": -3.1594,
    "gap": 5.2541,
    "rival": 0.0258,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.05
"""The largest probability with which at most 0.35% of those accepted were wrong."""

SPREAD = {
    "all": 2.8919,
    "varied": 0.3192,
    "shared": 0.5721,
    "unclear": 0.2348,
    "leverage": 1.4772,
    "most": 43.4972,
}
"""By which covariances are larger than their model says, see `Doubt`."""
