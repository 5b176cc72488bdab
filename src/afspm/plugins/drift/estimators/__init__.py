"""Estimators by name: the estimators of afspm, and a user's own classes.

estimator("least-squares")
estimator({"class": "sift", "transform": "affine"})
estimator({"class": "my_lab.Periodicity", "lattice_m": 2.5e-10})
"""

from __future__ import annotations

from collections.abc import Mapping

from afspm.basics import ConfigError, PlainMapping
from afspm.plugins.drift.estimators.guarded import Guarded, PairFailure, Report, log_failure
from afspm.plugins.drift.estimators.naming import named
from afspm.plugins.drift.registration import Estimator

__all__ = ["DEFAULT", "Guarded", "PairFailure", "estimator", "unguarded"]

DEFAULT = "least-squares"


def estimator(spec: str | PlainMapping | Estimator = DEFAULT, report: Report = log_failure) -> Estimator:
    """Return an estimator by name, in a guard that reports errors and replaces failed results by a coarse estimate.

    Args:
        spec: a name declared by a package, or "module.Name"; a table with such a name as its `class`, and the settings;
            or an estimator. An estimator with a guard is returned as it is.
        report: function called with each error; by default the error is logged.

    Raises:
        ConfigError: no such name, class or setting, a meaningless setting, or a missing library.
    """
    if isinstance(spec, Guarded):
        return spec
    return Guarded(*_made(spec), report)


def unguarded(spec: str | PlainMapping | Estimator = DEFAULT) -> Estimator:
    """Return an estimator by name without its guard, for tests and benchmarks that must see errors.

    Raises:
        ConfigError: as `estimator`.
    """
    return _made(spec)[0]


def _made(spec: str | PlainMapping | Estimator) -> tuple[Estimator, str]:
    made: object = spec
    name = type(spec).__name__
    if isinstance(spec, str | Mapping):
        made, name = named("estimator", spec, DEFAULT)
    if not callable(getattr(made, "register", None)):
        raise ConfigError(
            f"{name} is not an estimator",
            hint="give it a method register(reference, scan, prior), see afspm.plugins.drift.registration",
        )
    return made, name  # type: ignore[return-value]
