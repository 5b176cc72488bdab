"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 3398 pairs of the fitted half of the families, from seed 20000;
1230 of them were wrong.
"""

INTERCEPT = -6.8063
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.7767,
    "sd_px": 1.5910,
    "gap": -0.7911,
    "rival": 0.1968,
    "agreement": -11.7822,
    "above_repeats": -3.4219,
    "surprise": 1.0095,
    "searched": 0.5736,
}

RIGHT = {
    "overlap": -0.5607,
    "sd_px": -3.2751,
    "gap": 5.4069,
    "rival": 0.0283,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.07
"""The largest probability with which at most 0.45% of those accepted were wrong."""

SPREAD = {
    "all": 2.0938,
    "varied": 0.4773,
    "shared": 1.5216,
    "unclear": 0.5242,
    "leverage": 1.5886,
}
"""By which covariances are larger than their model says, see `Doubt`."""
