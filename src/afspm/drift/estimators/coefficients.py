"""Coefficients of the probability that a match is wrong. Written by `python -m benchmarks.drift.fit`.

Fitted to 876 pairs of the fitted half of the families, from seed 20000;
277 of them were wrong.
"""

INTERCEPT = -6.3358

WEIGHTS = {
    "overlap": -0.7259,
    "sd_px": 1.1311,
    "gap": -0.4545,
    "rival": 0.6447,
    "agreement": -8.5430,
    "correlation": -0.4388,
    "above_repeats": -2.0817,
    "surprise": 0.5418,
}

RIGHT = {
    "overlap": -0.4461,
    "sd_px": -3.9210,
    "gap": 5.7057,
    "rival": 0.0332,
    "agreement": 1.0000,
    "correlation": 2.7836,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
}
"""The median of right matches."""

WRONG_AT_MOST = 0.15
"""The largest probability with which at most 0.2% of those accepted were wrong."""

SPREAD = {
    "all": 2.2000,
    "varied": 0.3600,
    "shared": 1.8000,
    "unclear": 0.9000,
}
"""By which covariances are larger than their model says, see `Doubt`."""
