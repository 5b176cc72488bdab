"""Trackers by name (afspm's, and a user's own classes), and forecasts from JSON.

tracker("bank", estimator)
tracker({"class": "paper", "w_update": 0.8}, estimator)
tracker({"class": "my_lab.Follower"}, estimator)
"""

from __future__ import annotations

from collections.abc import Mapping as Table

from afspm.basics import ConfigError, InvalidValue, PlainMapping
from afspm.components import restored
from afspm.plugins.drift.estimators import estimator as default_estimator
from afspm.plugins.drift.estimators.naming import named
from afspm.plugins.drift.registration import Estimator
from afspm.plugins.drift.track.bank import BankTracker
from afspm.plugins.drift.track.forecast import BankForecast
from afspm.plugins.drift.track.paper import PaperForecast, PaperTracker
from afspm.plugins.drift.track.tracking import FORECAST_VERSION, Forecast, Tracker

__all__ = ["DEFAULT", "BankTracker", "PaperTracker", "forecast_from_dict", "tracker"]

DEFAULT = "bank"

_FORECASTS: Table[str, type[BankForecast] | type[PaperForecast]] = {
    kind.KIND: kind for kind in (BankForecast, PaperForecast)
}


def tracker(spec: str | PlainMapping = DEFAULT, estimator: Estimator | None = None) -> Tracker:
    """Return a tracker by name.

    Args:
        spec: a name declared by a package, or "module.Name"; or a table with such a name as its `class`, and the
            settings.
        estimator: estimator for registrations, the tracker's first argument; None: the default estimator.

    Raises:
        ConfigError: a name, class or setting is unknown or invalid, or a library is missing.
    """
    made, name = named("tracker", spec, DEFAULT, default_estimator() if estimator is None else estimator)
    if not all(callable(getattr(made, method, None)) for method in ("add", "state", "restore")):
        raise ConfigError(
            f"{name} is not a tracker",
            hint="give it the methods add, state and restore, see afspm.plugins.drift.track.tracking",
        )
    return made  # type: ignore[return-value]


def forecast_from_dict(table: PlainMapping) -> Forecast:
    """Return the forecast of an afspm tracker from the result of `Forecast.to_dict`.

    Raises:
        InvalidValue: the table is not such a result.
    """
    kind = str(table.get("kind"))
    if kind not in _FORECASTS:
        raise InvalidValue(f"a forecast of kind {kind!r}", hint=f"one of {', '.join(_FORECASTS)}")
    return restored(_FORECASTS[kind], table, kind, FORECAST_VERSION)
