"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.

Fitted to 2315 pairs of the fitted half of the families, from seed 20000;
923 of them were wrong.
"""

INTERCEPT = -5.5717
"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""

WEIGHTS = {
    "overlap": -0.9394,
    "sd_px": 0.9531,
    "gap": -1.2035,
    "rival": 0.1889,
    "agreement": -6.9922,
    "above_repeats": -1.8749,
    "surprise": 1.4202,
    "searched": 0.6047,
}

RIGHT = {
    "overlap": -0.4685,
    "sd_px": -3.0753,
    "gap": 5.1959,
    "rival": 0.0225,
    "agreement": 1.0000,
    "above_repeats": 3.4012,
    "surprise": 0.0000,
    "searched": 0.0000,
}
"""The median of right matches."""

SPREAD = {
    "all": 3.8300,
    "varied": 0.0786,
    "shared": 0.8741,
    "unclear": 0.0000,
    "leverage": 1.1494,
    "most": 39.4562,
}
"""Ratio of true covariances to those of the model, in the evidence for a match, see `Doubt`."""
