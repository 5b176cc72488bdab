"""The forecast of the drift, by which everything is mapped until more is known."""

from __future__ import annotations

from afspm.drift.mapping import Mapping
from afspm.drift.trackers import forecast_from_dict
from afspm.drift.tracking import Forecast, Prediction
from afspm.errors import AfspmError
from afspm.plain_data import Plain
from afspm.scheduler.drift.scan_gate import Matrix
from afspm.scheduler.drift.settings import DriftCompensationSettings


class CurrentForecast:
    """The newest forecast, and whether it is made use of.

    Attributes:
        start_s: experiment time at which the experiment began.
        lost: whether the place of the sample is not known any more, as of the newest registered scan.
    """

    def __init__(self, settings: DriftCompensationSettings) -> None:
        self.start_s: float | None = None
        self.lost = False
        self._settings = settings
        self._forecast: Forecast | None = None
        self._plain: Plain | None = None

    def learn(self, forecast: Plain | None) -> None:
        """Take a forecast as the worker tells it; None: it knows nothing yet. Raises InvalidValue if it is none."""
        if forecast is not None:
            self._forecast, self._plain = forecast_from_dict(forecast), forecast

    def predicted(self, time_s: float) -> Prediction | None:
        """For a time; None: nothing is known yet."""
        return None if self._forecast is None else self._forecast.at(time_s)

    def corrects(self, time_s: float) -> bool:
        """Return whether components are given sample coordinates at a time."""
        since_s = 0.0 if self.start_s is None else time_s - self.start_s
        return self._settings.correct and since_s >= self._settings.correct_after

    def mapping_at(self, time_s: float) -> Mapping | None:
        """See `frame.MappingAt`."""
        if not self.corrects(time_s):
            return None
        predicted = self.predicted(time_s)
        return Mapping.identity() if predicted is None else predicted.mapping

    def matrix_at(self, time_s: float) -> Matrix | None:
        """The same as plain numbers."""
        mapping = self.mapping_at(time_s)
        return None if mapping is None else mapping.matrix.tolist()

    def to_dict(self) -> Plain:
        """As plain JSON."""
        return {"start_s": self.start_s, "lost": self.lost, "forecast": self._plain}

    def restore(self, plain: Plain) -> None:
        """Take up what `to_dict` wrote. Raises ValueError if it can't be."""
        self.start_s, self.lost = plain["start_s"], bool(plain["lost"])
        try:
            self.learn(plain["forecast"])
        except AfspmError as error:
            raise ValueError(str(error)) from error
