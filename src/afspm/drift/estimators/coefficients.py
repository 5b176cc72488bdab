"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 1193 pairs of the fitted half of the families, from seed 20000;
487 of them were wrong.
"""

INTERCEPT = -5.4130
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.1451,
    "sd_px": 1.1306,
    "gap": -0.4583,
    "rival": 1.0704,
    "agreement": -11.3588,
    "above_repeats": -1.9976,
    "surprise": 1.0428,
    "searched": 0.4563,
}

RIGHT = {
    "overlap": -0.5283,
    "sd_px": -3.7494,
    "gap": 5.5746,
    "rival": 0.0262,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.07
"""The largest probability with which at most 0.50% of those accepted were wrong."""

SPREAD = {
    "all": 2.4288,
    "varied": 0.6146,
    "shared": -0.3419,
    "unclear": 1.0349,
}
"""By which covariances are larger than their model says, see `Doubt`."""
