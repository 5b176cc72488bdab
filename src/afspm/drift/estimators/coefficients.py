"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 3397 pairs of the fitted half of the families, from seed 20000;
1232 of them were wrong.
"""

INTERCEPT = -7.0181
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.3599,
    "sd_px": 1.5224,
    "gap": -0.7130,
    "rival": 0.4883,
    "agreement": -11.1221,
    "above_repeats": -3.3210,
    "surprise": 1.1723,
    "searched": 0.5708,
}

RIGHT = {
    "overlap": -0.5308,
    "sd_px": -3.3673,
    "gap": 5.4726,
    "rival": 0.0282,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.07
"""The largest probability with which at most 0.35% of those accepted were wrong."""

SPREAD = {
    "all": 1.4914,
    "varied": 0.5769,
    "shared": 2.4507,
    "unclear": 0.9024,
    "leverage": 0.8073,
}
"""By which covariances are larger than their model says, see `Doubt`."""
