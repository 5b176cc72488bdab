"""The forecast of the drift, by which everything is mapped until more is known."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

from afspm.drift.mapping import Mapping
from afspm.drift.trackers import forecast_from_dict
from afspm.drift.tracking import Forecast, Prediction
from afspm.plain_data import Plain
from afspm.scheduler.drift.settings import DriftCompensationSettings


@dataclass(frozen=True)
class CurrentForecast:
    """The newest forecast.

    Attributes:
        start_s: experiment time at which the experiment began; None: before that.
        lost: whether the position of the sample is unknown, as of the newest registered scan.
        text: the forecast as JSON, which only its tracker understands; None: nothing is known yet.

    Raises:
        InvalidValue: the text is no forecast.
    """

    start_s: float | None = None
    lost: bool = False
    text: str | None = None
    forecast: Forecast | None = field(init=False, default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.text is not None:
            object.__setattr__(self, "forecast", forecast_from_dict(json.loads(self.text)))

    def learn(self, forecast: Plain | None) -> CurrentForecast:
        """Take a forecast of the worker; None: it knows nothing new. Raises InvalidValue if it is no forecast."""
        return self if forecast is None else CurrentForecast(self.start_s, self.lost, json.dumps(forecast))

    def predicted(self, time_s: float) -> Prediction | None:
        """Return the prediction for a time; None: nothing is known yet."""
        return None if self.forecast is None else self.forecast.at(time_s)

    def corrects(self, settings: DriftCompensationSettings, time_s: float) -> bool:
        """Return whether components are given sample coordinates at a time."""
        since_s = 0.0 if self.start_s is None else time_s - self.start_s
        return settings.correct and since_s >= settings.correct_after

    def mapping_at(self, settings: DriftCompensationSettings, time_s: float) -> Mapping | None:
        """Return the mapping from tip to sample coordinates; None: components are given tip coordinates."""
        if not self.corrects(settings, time_s):
            return None
        predicted = self.predicted(time_s)
        return Mapping.identity() if predicted is None else predicted.mapping
