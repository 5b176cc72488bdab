"""Settings of the default tracker."""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import math
from dataclasses import dataclass

import numpy as np

from afspm.basics import ConfigError, Plain
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track.filters import Filters, Models
from afspm.plugins.drift.track.references import Choice

TRANSFORMS = ("translation", "similarity")


@dataclass(frozen=True)
class BankSettings:
    """Settings of the bank, tuned on simulated nights with 2 µm scans every 15 minutes.

    The defaults cover most microscopes.

    Attributes:
        densities_m2_s3: spectral densities of the acceleration, a measure of how fast the drift velocity changes.
        fadings_s: time constants after which a velocity has decayed to 1/e; inf for a constant velocity.
        walks_m2_s: variances per second of a random walk of the position. There is one filter for each combination of
            density, fading and walk.
        jitter_m: standard deviation of an error in the position of a scan that registrations do not show.
        start_velocity_sd_m_s: standard deviation of the velocity at the start.
        start_px: standard deviation of the sample's position in the first scan, in its pixels.
        forget: share of the logarithm of the filters' weights that is kept from one scan to the next.
        rarest: least weight of a filter, relative to the largest.
        inflation: factor on an estimator's covariance, above 1. The excess over 1 is an error of the pair; the rest is
            divided equally between its scans.
        widening: factor on the covariance of an expected displacement, for the estimator's search; four times as large
            for each unmatched scan in a row.
        doubt: chi² above which a result is ignored until the next scan confirms it.
        second_looks: largest number of references searched without a prediction, if none matched with a prediction.
        lost_after: number of scans in a row that should have matched, but did not, after which the tracker is lost.
        transform: "translation", or "similarity" to estimate rotation and scale as well.
        linear_walk_per_s: variance per second of the angle (rad) and of the logarithm of the scale.
    """

    densities_m2_s3: tuple[float, ...] = (1e-26, 1e-25, 1e-24, 1e-23, 1e-22, 1e-21)
    fadings_s: tuple[float, ...] = (math.inf, 10800.0, 2700.0)
    walks_m2_s: tuple[float, ...] = (0.5e-18 / 900.0, 3e-18 / 900.0, 16e-18 / 900.0)
    jitter_m: float = 0.05e-9
    start_velocity_sd_m_s: float = 3e-10
    start_px: float = 0.02
    forget: float = 0.97
    rarest: float = 1e-6
    inflation: float = 2.0
    widening: float = 4.0
    doubt: float = 36.0
    second_looks: int = 2
    lost_after: int = 3
    transform: str = "translation"
    linear_walk_per_s: float = 2.8e-10

    def __post_init__(self) -> None:
        numbers = (self.jitter_m, self.start_velocity_sd_m_s, self.start_px, self.rarest, self.doubt)
        if self.transform not in TRANSFORMS:
            raise ConfigError(
                f"the bank knows no transform {self.transform!r}",
                where="transform",
                hint=f"one of {', '.join(TRANSFORMS)}",
            )
        several = (self.densities_m2_s3, self.fadings_s, self.walks_m2_s)
        if not all(several):
            raise ConfigError("the bank has no filters", where="densities_m2_s3, fadings_s, walks_m2_s")
        if not min(*numbers, self.linear_walk_per_s, *itertools.chain(*several)) > 0.0:
            raise ConfigError("all settings of the bank must be above 0")
        if not (0.0 < self.forget <= 1.0 and self.rarest < 1.0):
            raise ConfigError("weights: forget up to 1, rarest below it", where="forget, rarest")
        if not (self.inflation > 1.0 and self.widening >= 1.0 and self.lost_after >= 1):
            raise ConfigError("inflation must be above 1, widening and lost_after at least 1", where="inflation")

    @classmethod
    def split(cls, settings: Plain) -> tuple[BankSettings, Choice]:
        """Split settings into settings of the bank and settings of its references.

        Raises:
            ConfigError: a name is unknown, or a value is invalid.
        """
        own, others = ({field.name for field in dataclasses.fields(one)} for one in (cls, Choice))
        for name in settings:
            if name not in own | others:
                close = difflib.get_close_matches(name, sorted(own | others), n=1)
                hint = f"did you mean {close[0]!r}?" if close else ", ".join(sorted(own | others))
                raise ConfigError(f"the tracker has no setting {name!r}", where=name, hint=hint)
        try:
            values: Plain = {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}
            return (
                cls(**{k: v for k, v in values.items() if k in own}),
                Choice(**{k: v for k, v in values.items() if k in others}),
            )
        except TypeError as error:
            raise ConfigError(f"the settings of the tracker: {error}") from error

    def models(self) -> Models:
        """Return one model of motion for each combination of density, fading and walk."""
        densities, fadings, walks = np.meshgrid(self.densities_m2_s3, self.fadings_s, self.walks_m2_s, indexing="ij")
        return Models(densities.ravel(), 1.0 / fadings.ravel(), walks.ravel())

    def filters(self, first: DriftScan) -> Filters:
        """Return the bank of filters after the first scan."""
        position_sd_m = self.start_px * min(first.pixel_m)
        return Filters.start(self.models(), first.mid_s, position_sd_m, self.start_velocity_sd_m_s, first.duration_s)
