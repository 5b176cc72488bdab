"""Estimators by name, and users' own.

estimator("least-squares")
estimator({"class": "sift", "transform": "affine"})
estimator({"class": "my_lab.Periodicity", "lattice_m": 2.5e-10})
"""

from __future__ import annotations

from collections.abc import Mapping

from afspm.drift.estimators.guarded import Guarded
from afspm.drift.naming import named
from afspm.drift.registration import Estimator
from afspm.errors import ConfigError
from afspm.plain_data import PlainMapping

__all__ = ["DEFAULT", "READY_MADE", "Guarded", "estimator"]

DEFAULT = "least-squares"

READY_MADE: Mapping[str, str] = {
    DEFAULT: "afspm.drift.estimators.least_squares.LeastSquares",
    "brief": "afspm.drift.estimators.features.Brief",
    "orb": "afspm.drift.estimators.features.Orb",
    "sift": "afspm.drift.estimators.features.Sift",
    "correlation": "afspm.drift.estimators.correlation.Correlation",
}


def estimator(spec: str | PlainMapping | Estimator = DEFAULT) -> Estimator:
    """The estimator that is meant, guarded: it refuses where it would have raised or told nonsense.

    Args:
        spec: a name of `READY_MADE` or "module.Name"; a table with that as its `class` and the settings of it (only
            `class` names code); or an estimator.

    Raises:
        ConfigError: no such name, class or setting, a setting without a meaning, or a library that is missing.
    """
    if isinstance(spec, Guarded):
        return spec
    if not isinstance(spec, str | Mapping):
        return _guarded(spec, type(spec).__name__)
    return _guarded(*named("estimator", spec, READY_MADE, DEFAULT))


def _guarded(made: object, name: str) -> Estimator:
    if not callable(getattr(made, "register", None)):
        raise ConfigError(
            f"{name} is not an estimator",
            hint="give it a method register(reference, scan, prior), see afspm.drift.registration",
        )
    return Guarded(made, name)  # type: ignore[arg-type]
