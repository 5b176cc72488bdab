"""The default tracker: a bank of filters, an anchor, and several references for each scan."""

from __future__ import annotations

from collections.abc import Mapping as Table
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from afspm.drift.registration import DriftScan, Estimator, Registration
from afspm.drift.shear import velocity_by_shear
from afspm.drift.trackers import saving
from afspm.drift.trackers.compensation import Compensation
from afspm.drift.trackers.filters import Filters
from afspm.drift.trackers.forecast import BankForecast
from afspm.drift.trackers.pairs import Comparison, Measured, Newest, agreeing
from afspm.drift.trackers.references import Reference, References
from afspm.drift.trackers.settings import BankSettings
from afspm.drift.tracking import Forecast, Prediction, Update
from afspm.errors import InvalidValue

Array = NDArray[np.float64]

VERSION = 1


class BankTracker:
    """Filters that each expect drift to move differently, weighted by how well they foresaw it.

    A scan is registered with several earlier ones: with an anchor, the scan that first showed its part of the sample,
    for as long as it can be recognised, and with recent ones. Each result is a measurement of the difference of two
    positions, and the positions of all scans that are kept are part of the filters' state, so what is known of each
    stays consistent and nothing is counted twice. Positions are those at the middle of a scan; where the overlap lies
    elsewhere, the time that its rows were taken at counts.

    A result far from all that was expected is believed only if that of the next scan is too. It is lost when the
    standard deviation of a position is more than half of what a scan may be misplaced and still be compared; several
    scans in a row that nothing could be registered with mean that too. It then looks everywhere, and is found again
    when that has made positions certain enough.

    Args:
        estimator: gets what is expected as prior.
        settings: fields of `BankSettings` and `Choice`.

    Raises:
        ConfigError: a setting without a meaning.
    """

    def __init__(self, estimator: Estimator, **settings: Any) -> None:
        self._settings, choice = BankSettings.split(settings)
        self._estimator = estimator
        self._references = References(choice)
        self._filters: Filters | None = None
        self._newest_s: float | None = None
        self._compensation = Compensation()
        self._scans = 0
        self._unmatched = 0  # scans in a row that should have matched
        self._doubted = False  # the newest scan's result
        self._lost = False
        self._forecast = BankForecast.at_start()

    @property
    def forecast(self) -> Forecast:
        """See `Tracker`."""
        return self._forecast

    def add(self, scan: DriftScan) -> Update:
        """See `Tracker`."""
        saving.must_be_newer(scan, self._newest_s)
        self._newest_s = scan.mid_s
        self._scans += 1
        if self._filters is None:
            return self._first(scan)
        followed_m = self._compensation.followed_m(self._filters.time_s, scan.mid_s)
        filters = self._filters.moved(scan.mid_s, followed_m)
        before = self._known(filters)
        filters = self._turned(filters, scan)
        anywhere = self._lost or before.sd_m > self._limit_m(scan)
        tried = self._tried(filters, scan, anywhere=anywhere)
        comparison, surprise = self._believed(filters, scan, tried, anywhere=anywhere)
        self._unmatched = 0 if comparison else self._unmatched + bool(tried and not self._doubted)
        registrations = {self._references.kept[number].scan.key: found for number, found in tried.items()}
        self._references.judged(self._succeeded(tried, comparison), self._scans)
        self._filters = self._learned(filters, scan, comparison)
        self._keep(scan)
        self._forecast = BankForecast.of(self._filters, self._compensation)
        after = self._known(self._filters)
        self._lost = after.sd_m > self._limit_m(scan)
        return Update(
            key=scan.key,
            before=before,
            after=after,
            matched=comparison is not None,
            reason="" if comparison else self._why_not(tried, surprise),
            lost=self._lost,
            registrations=registrations,
            forecast=self._forecast,
            quality={"references": float(len(comparison.measured) if comparison else 0), "surprise_sd": surprise**0.5},
        )

    def set_velocity(self, time_s: float, velocity_m_s: ArrayLike, covariance: ArrayLike) -> None:
        """Take in a drift velocity (2,) that was measured otherwise, in tip coordinates, with its covariance (2, 2).

        Raises:
            InvalidValue: before the first scan.
        """
        if self._filters is None:
            raise InvalidValue("a velocity was given before the first scan", hint="positions are counted from that")
        velocity = np.asarray(velocity_m_s, dtype=np.float64) + self._compensation.velocity_m_s(time_s)
        noise = np.asarray(covariance, dtype=np.float64)
        self._filters = self._with_velocity(self._filters, time_s, velocity, noise)
        self._forecast = BankForecast.of(self._filters, self._compensation)

    def compensated(self, time_s: float, velocity_m_s: ArrayLike) -> None:
        """From a time on, the controller moves tip coordinates along with a velocity (2,) by itself.

        Raises:
            InvalidValue: before the middle of the newest scan: its position has been told already.
        """
        if self._newest_s is not None and time_s < self._newest_s:
            raise InvalidValue(
                f"compensation since {time_s:g} s is told after a scan of {self._newest_s:g} s",
                hint="tell it before the next scan",
            )
        velocity = np.asarray(velocity_m_s, dtype=np.float64)
        needed_s = time_s if self._newest_s is None else self._newest_s
        self._compensation = self._compensation.changed(time_s, velocity, needed_s=needed_s)
        self._forecast = replace(self._forecast, compensation=self._compensation)

    # -- one scan

    def _first(self, scan: DriftScan) -> Update:
        before, settings = self._forecast.at(scan.mid_s), self._settings
        position_sd_m = settings.start_px * min(scan.pixel_m)
        self._filters = Filters.start(settings.models(), scan.mid_s, position_sd_m, settings.start_velocity_sd_m_s)
        now = self._known(self._filters)
        self._references.kept.append(Reference(scan, now.rate_m_s, now.rate_covariance, anchor=True, used=1))
        self._forecast = BankForecast.of(self._filters, self._compensation)
        return Update(
            scan.key, before, now, matched=True, reason="", lost=False, registrations={}, forecast=self._forecast
        )

    def _turned(self, filters: Filters, scan: DriftScan) -> Filters:
        """With the velocity that shows in the shear against the scan before, if that was scanned the other way."""
        last = self._references.kept[-1].scan
        if last.upwards is None or scan.upwards is None or last.upwards == scan.upwards:
            return filters
        if scan.mid_s - last.mid_s > 3.0 * max(scan.duration_s, last.duration_s):  # too long ago for one velocity
            return filters
        found = self._estimator.register(last, scan)
        sheared = velocity_by_shear(last, scan, found)
        if not found.accepted or sheared is None:
            return filters
        between_s = (last.mid_s + scan.mid_s) / 2
        return self._with_velocity(
            filters, between_s, sheared[0] + self._compensation.velocity_m_s(between_s), sheared[1]
        )

    def _tried(self, filters: Filters, scan: DriftScan, *, anywhere: bool) -> dict[int, Registration]:
        """What the estimator says of the scan and each reference, by its number, the best first."""
        newest = self._newest(filters, scan)
        widening = self._settings.widening * 4.0 ** (self._unmatched + self._doubted)
        tried = {}
        for number in self._references.candidates(scan, *_drifts(filters), anywhere=anywhere):
            reference = self._references.kept[number]
            prior = None if anywhere else newest.prior(number, reference, filters, widening)
            tried[number] = self._estimator.register(reference.scan, scan, prior)
        return tried

    def _believed(
        self, filters: Filters, scan: DriftScan, tried: Table[int, Registration], *, anywhere: bool
    ) -> tuple[Comparison | None, float]:
        """What is taken in of that, and the chi2 of how far it is from what was expected."""
        newest, kept = self._newest(filters, scan), self._references.kept
        measured = [
            Measured.of(newest, number, kept[number], found, self._settings.inflation)
            for number, found in tried.items()
            if found.accepted
        ]
        if not measured:
            self._doubted = False
            return None, 0.0
        comparison = Comparison(agreeing(measured, filters))
        surprise = comparison.surprise(filters)
        self._doubted = surprise > self._settings.doubt and not (self._doubted or anywhere)
        return None if self._doubted else comparison, surprise

    @staticmethod
    def _succeeded(tried: Table[int, Registration], comparison: Comparison | None) -> dict[int, bool]:
        used = {one.link.number for one in comparison.measured} if comparison else set()
        return {number: number in used for number in tried}

    def _learned(self, filters: Filters, scan: DriftScan, comparison: Comparison | None) -> Filters:
        settings = self._settings
        if self._unmatched == settings.lost_after:
            filters = filters.widened(self._limit_m(scan), settings.start_velocity_sd_m_s)
        noise = np.eye(2) * settings.jitter_m**2
        if comparison is None:
            return filters.with_scan(noise)
        filters = filters.with_scan(noise + comparison.scan_noise_m2)
        rows, values, noise = comparison.rows(filters.mean.shape[1])
        return filters.updated(rows, values, noise, forget=settings.forget, rarest=settings.rarest)

    def _keep(self, scan: DriftScan) -> None:
        """Keep a scan, and let go of what there is too much of then; one in doubt is not kept."""
        assert self._filters is not None
        drift_m, drifts_m = _drifts(self._filters)
        now = self._known(self._filters)
        anchor = self._references.needs_anchor(scan, drift_m, drifts_m[:-1])
        self._references.kept.append(Reference(scan, now.rate_m_s, now.rate_covariance, anchor, used=self._scans))
        if self._doubted:
            self._drop(len(self._references) - 1)
        while (number := self._references.superfluous()) is not None:
            self._drop(number)

    def _drop(self, number: int) -> None:
        assert self._filters is not None
        del self._references.kept[number]
        self._filters = self._filters.without_scan(number)

    def _why_not(self, tried: Table[int, Registration], surprise: float) -> str:
        if self._doubted:
            far = f"found {surprise**0.5:.1f} standard deviations from where it was expected"
            return f"{far}; believed if the next one is too"
        if tried:
            return next(iter(tried.values())).reason
        return "no earlier scan of this part of the sample is kept"

    def _with_velocity(self, filters: Filters, time_s: float, velocity_m_s: Array, covariance: Array) -> Filters:
        """With a velocity of the sample itself that was measured at about the time of the filters."""
        elsewhen = self._settings.models().over(abs(filters.time_s - time_s))[1][:, 2, 2]
        noise = covariance + np.eye(2) * float(filters.weight @ elsewhen)
        rows = np.eye(filters.mean.shape[1])[2:4]
        return filters.updated(rows, velocity_m_s, noise, forget=1.0, rarest=self._settings.rarest)

    def _newest(self, filters: Filters, scan: DriftScan) -> Newest:
        now = self._known(filters)
        return Newest(scan, now.rate_m_s, now.rate_covariance, self._compensation.velocity_m_s(scan.mid_s))

    def _known(self, filters: Filters) -> Prediction:
        return BankForecast.of(filters, self._compensation).at(filters.time_s)

    def _limit_m(self, scan: DriftScan) -> float:
        """Half of how far a scan may be off and still be compared."""
        return (1.0 - self._references.choice.overlap_min) * min(scan.region.size_m) / 2

    # -- being killed and coming back

    def state(self) -> dict[str, Any]:
        """See `Tracker`."""
        filters = self._filters
        return {
            "kind": "bank",
            "version": VERSION,
            "newest_s": self._newest_s,
            "compensation": [list(change) for change in self._compensation.changes],
            "scans": self._scans,
            "unmatched": self._unmatched,
            "doubted": self._doubted,
            "lost": self._lost,
            "filters": None if filters is None else filters.to_dict(),
            "references": [one.to_dict() for one in self._references.kept],
        }

    def restore(self, state: Table[str, Any]) -> None:
        """See `Tracker`. Raises InvalidValue for the state of another tracker, or of one with other filters."""
        saving.must_be(state, "bank", VERSION)
        models, filters = self._settings.models(), None
        if state["filters"] is not None:
            filters = Filters.from_dict(models, state["filters"])
        self._filters, self._newest_s = filters, state["newest_s"]
        self._compensation = Compensation.from_list(state["compensation"])
        self._scans, self._unmatched = int(state["scans"]), int(state["unmatched"])
        self._doubted, self._lost = bool(state["doubted"]), bool(state["lost"])
        self._references.kept = [Reference.from_dict(one) for one in state["references"]]
        self._forecast = BankForecast.at_start()
        if filters is not None:
            self._forecast = BankForecast.of(filters, self._compensation)


def _drifts(filters: Filters) -> tuple[Array, Array]:
    """The expected displacement (2,) of now, and those (n, 2) that the scans show."""
    states = filters.mean.shape[1]
    mean, _ = filters.mixed(np.eye(states))
    return mean[:2], mean[4:].reshape(-1, 2)
