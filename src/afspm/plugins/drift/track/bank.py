"""`BankTracker`: the default tracker, with a bank of filters, anchors, and several references for each scan."""

from __future__ import annotations

from collections.abc import Mapping as Table
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from afspm.basics import InvalidValue, Plain, PlainMapping
from afspm.components import Array, restored, snapshot
from afspm.plugins.drift.registration import DriftScan, Estimator, Registration
from afspm.plugins.drift.track.filters import Filters
from afspm.plugins.drift.track.forecast import BankForecast, Compensation
from afspm.plugins.drift.track.measurements import AGREEMENT, Comparison, NewestScan, PairMeasurement, agreeing
from afspm.plugins.drift.track.references import ReferenceScan, ReferenceScans
from afspm.plugins.drift.track.settings import BankSettings
from afspm.plugins.drift.track.shear import velocity_from_up_down
from afspm.plugins.drift.track.similarity import Similarity, SimilarityMeasurement
from afspm.plugins.drift.track.tracking import Forecast, Prediction, Update, require_newer

VERSION = 4
_LIKE = 1.2  # largest relative difference of a second surprise that confirms the first (doubled by a new velocity)


@dataclass(eq=False)
class BankState:
    """Complete saved state of a tracker.

    Attributes:
        filters: bank of filters; None before the first scan.
        similarity: rotation and scale; None if only translations are tracked.
        references: stored scans in order of time, as in the filters' state.
        compensation: velocity of tip coordinates, which follow the sample.
        newest_s: middle of the newest scan, even if the scan was dropped.
        scans: number of scans so far.
        unmatched: number of scans in a row that should have matched, but did not.
        proven: whether any two scans have matched; until then, the first scan itself may be unusable.
        doubted_m: (2,) measured minus expected position of the newest scan, if doubted; else None.
        matched_s: middle of the newest scan with a measured place.
        lost: see `Update`.
    """

    filters: Filters | None = None
    similarity: Similarity | None = None
    references: list[ReferenceScan] = field(default_factory=list)
    compensation: Compensation = field(default_factory=Compensation)
    newest_s: float | None = None
    scans: int = 0
    unmatched: int = 0
    proven: bool = False
    doubted_m: Array | None = None
    matched_s: float = 0.0
    lost: bool = False


class BankTracker:
    """Tracker with a bank of filters: models of drift, weighted by the quality of their predictions.

    A scan is registered with several earlier scans: recent ones, and an anchor, the first scan of its part of the
    sample, as long as the anchor can be recognised. Each result measures the difference of two positions. The positions
    of all stored scans are part of the filters' state, so they stay consistent and nothing is counted twice. A position
    holds for the middle of a scan; where the overlap lies elsewhere, the time of its rows counts.

    A result far from every prediction is used only if the next scan confirms it. A scan that matches no other is
    adrift: the scan is stored at its predicted place, and neither this scan nor scans that match only scans adrift are
    evidence. Their places relative to each other are still tracked. After several such scans in a row the tracker is
    lost. A single such scan is enough if the standard deviation of its position exceeds half of the misplacement at
    which scans can still be compared. A lost tracker searches everywhere, until a scan has a measured place again; this
    scan also corrects the scans adrift.

    A scan that can't be compared with any other, such as a zoom too fine for the overview, starts a new series. A zoom
    is searched in an overview only at its expected place, and the tracker is not lost if the zoom is not recognised
    there, since one particle looks like the next.

    With the transform "similarity", rotation and scale are first removed from scans: see `Similarity`.

    Args:
        estimator: estimator for registrations, with the prediction as prior.
        settings: fields of `BankSettings` and `Choice`.

    Raises:
        ConfigError: a setting is invalid.
    """

    def __init__(self, estimator: Estimator, **settings: object) -> None:
        self._settings, choice = BankSettings.split(settings)
        self._estimator = estimator
        self._references = ReferenceScans(choice)
        self._state = BankState(references=self._references.kept)

    @property
    def forecast(self) -> Forecast:
        if (filters := self._state.filters) is None:
            return replace(BankForecast.at_start(), compensation=self._state.compensation)
        return self._forecast_of(filters)

    def add(self, scan: DriftScan) -> Update:
        state = self._state
        require_newer(scan, state.newest_s)
        state.newest_s = scan.mid_s
        state.scans += 1
        if state.filters is None:
            return self._first(scan)
        if state.similarity is not None:
            since_s = scan.mid_s - state.filters.time_s
            state.similarity = state.similarity.moved(self._settings.linear_walk_per_s * since_s)
            scan = state.similarity.straightened(scan)
        followed_m = state.compensation.followed_m(state.filters.time_s, scan.mid_s)
        filters = state.filters.moved(scan.mid_s, followed_m)
        before = self._estimate(filters)
        compensated_m_s = state.compensation.velocity_m_s(scan.mid_s)
        newest = NewestScan(scan, self._with_shear_velocity(filters, scan), compensated_m_s, state.similarity)
        anywhere = state.lost or self._is_blind(newest)
        tried = self._tried(newest, anywhere=anywhere)
        registrations = {self._references.kept[number].scan.key: found for number, found in tried.items()}
        found = self._compared(newest, tried)
        used = self._believed(newest, found, anywhere=anywhere)
        placed = used is not None and any(self._is_evidence(one.link.number) for one in used.measured)
        state.unmatched = 0 if placed else state.unmatched + self._should_have_matched(scan, tried)
        self._learn(newest, used, tried, placed=placed)
        after = self._estimate(state.filters)
        # a scan without comparable references begins a series of its own, whose distance stays unknown
        if tried:
            state.lost = not placed and after.sd_m > self._limit_m(scan)
        state.lost |= state.unmatched >= self._settings.lost_after
        return Update(
            key=scan.key,
            before=before,
            after=after,
            matched=placed,
            reason=_coarse_reason(tried) if placed else _why_not(tried, found, adrift=used is not None),
            lost=state.lost,
            registrations=registrations,
            forecast=self.forecast,
            quality={
                "references": float(len(used.measured) if used else 0),
                **({} if state.similarity is None else {"linear_sd": state.similarity.sd}),
            },
        )

    def set_velocity(self, time_s: float, velocity_m_s: ArrayLike, covariance: ArrayLike) -> None:
        """Update with a drift velocity (2,) in tip coordinates from another measurement, with its covariance (2, 2).

        Raises:
            InvalidValue: there is no scan yet.
        """
        state = self._state
        if state.filters is None:
            raise InvalidValue("a velocity was set before the first scan", hint="positions are counted from that")
        velocity = np.asarray(velocity_m_s, dtype=np.float64) + state.compensation.velocity_m_s(time_s)
        noise = np.asarray(covariance, dtype=np.float64)
        state.filters = state.filters.with_velocity(time_s, velocity, noise, rarest=self._settings.rarest)

    def compensated(self, time_s: float, velocity_m_s: ArrayLike) -> None:
        """Take into account that the controller moves tip coordinates with a velocity (2,) from `time_s` on.

        Raises:
            InvalidValue: `time_s` is before the middle of the newest scan, whose position is already published.
        """
        state = self._state
        if state.newest_s is not None and time_s < state.newest_s:
            raise InvalidValue(
                f"compensation since {time_s:g} s is reported after a scan of {state.newest_s:g} s",
                hint="report it before the next scan",
            )
        velocity = np.asarray(velocity_m_s, dtype=np.float64)
        needed_s = time_s if state.newest_s is None else state.newest_s
        state.compensation = state.compensation.changed(time_s, velocity, needed_s=needed_s)

    # -- one scan

    def _first(self, scan: DriftScan) -> Update:
        state = self._state
        before, settings = self.forecast.at(scan.mid_s), self._settings
        state.filters = settings.filters(scan)
        state.matched_s = scan.mid_s
        if settings.transform == "similarity":
            state.similarity = Similarity.at_start(scan)
        now = self._estimate(state.filters)
        compensated_m_s = state.compensation.velocity_m_s(scan.mid_s)
        self._references.kept.append(ReferenceScan(scan, compensated_m_s, anchor=True, used=state.scans))
        return Update(
            scan.key, before, now, matched=True, reason="", lost=False, registrations={}, forecast=self.forecast
        )

    def _with_shear_velocity(self, filters: Filters, scan: DriftScan) -> Filters:
        # the shear against a scan in the other direction gives the velocity
        last = self._references.kept[-1].scan
        if last.upwards is None or scan.upwards is None or last.upwards == scan.upwards:
            return filters
        if scan.mid_s - last.mid_s > 3.0 * max(scan.duration_s, last.duration_s):  # too long for a constant velocity
            return filters
        found = velocity_from_up_down(last, scan, self._estimator)
        if not found.accepted:
            return filters
        # only the shear is used here: the displacement is compared like any other later
        velocity = found.by_shear_m_s + self._state.compensation.velocity_m_s(found.time_s)
        return filters.with_velocity(found.time_s, velocity, found.by_shear_covariance, rarest=self._settings.rarest)

    def _should_have_matched(self, scan: DriftScan, tried: Table[int, Registration]) -> bool:
        # an unmatched scan means that the sample may be gone; not so a zoom that an overview does not show, nor an
        # error of the estimator
        return any(self._references.is_alike(number, scan) for number, one in tried.items() if not one.failure)

    def _is_blind(self, newest: NewestScan) -> bool:
        # the prediction is too uncertain relative to each comparable reference
        kept = self._references.kept
        comparable = self._references.candidates(newest.scan, *_drifts(newest.filters), anywhere=True)
        spreads = (newest.expected(number, kept[number])[1] for number in comparable)
        return min((np.linalg.eigvalsh(one)[-1] for one in spreads), default=0.0) > self._limit_m(newest.scan) ** 2

    def _tried(self, newest: NewestScan, *, anywhere: bool) -> dict[int, Registration]:
        kept, filters = self._references.kept, newest.filters
        widening = self._settings.widening * 4.0 ** min(self._state.unmatched, self._settings.lost_after)
        tried = {}
        for number in self._references.candidates(newest.scan, *_drifts(filters), anywhere=anywhere):
            # a zoom fits many places of an overview, so it is never searched everywhere there
            everywhere = anywhere and self._references.is_alike(number, newest.scan)
            prior = None if everywhere else newest.prior(number, kept[number], widening)
            tried[number] = self._estimator.register(kept[number].scan, newest.scan, prior)
        firm = [number for number in tried if self._is_evidence(number)]
        if not anywhere and not any(tried[number].accepted for number in firm):
            # not found at the expected place: search a few references everywhere
            elsewhere = [number for number in firm if self._references.is_alike(number, newest.scan)]
            for number in elsewhere[: self._settings.second_looks]:
                again = self._estimator.register(kept[number].scan, newest.scan)
                if again.accepted or not tried[number].failure:  # a refusal does not replace an error
                    tried[number] = again
        return tried

    def _compared(self, newest: NewestScan, tried: Table[int, Registration]) -> Comparison | None:
        # references adrift count only without others, and coarse results only without exact results
        kept, inflation = self._references.kept, self._settings.inflation
        measured = [
            PairMeasurement.of(newest, number, kept[number], found, inflation)
            for number, found in tried.items()
            if found.accepted
        ]
        firm = [one for one in measured if self._is_evidence(one.link.number)] or measured
        exact = [one for one in firm if not one.found.failure] or firm
        return Comparison(agreeing(exact, newest.filters), newest.filters) if measured else None

    def _believed(self, newest: NewestScan, found: Comparison | None, *, anywhere: bool) -> Comparison | None:
        # a surprise is believed only without a prediction, or after a similar one
        state = self._state
        before, state.doubted_m = state.doubted_m, None
        if found is None or found.surprise <= self._settings.doubt:
            return found
        again = before is not None and np.linalg.norm(found.apart_m - before) <= _LIKE * np.linalg.norm(before)
        if not (anywhere or again):
            state.doubted_m = found.apart_m
            return None
        # either the sample jumped, or its velocity has changed: the next scan will show
        far_m, since_s = float(np.linalg.norm(found.apart_m)), newest.scan.mid_s - state.matched_s
        return replace(found, filters=found.filters.widened(far_m, far_m / max(since_s, 1.0)))

    def _learn(
        self, newest: NewestScan, used: Comparison | None, tried: Table[int, Registration], *, placed: bool
    ) -> None:
        state = self._state
        settings, references, scan = self._settings, self._references, newest.scan
        filters = newest.filters if used is None else used.filters
        if state.unmatched == settings.lost_after and state.proven and not placed:
            filters = self._cut_off(filters, scan)
        noise = np.eye(2) * settings.jitter_m**2
        if used is None:
            state.filters = filters.with_scan(noise, scan.duration_s)
        else:
            filters = filters.with_scan(noise + used.scan_noise_m2, scan.duration_s)
            rows, values, pair_noise = used.rows(filters.mean.shape[1])
            state.filters = filters.updated(rows, values, pair_noise, forget=settings.forget, rarest=settings.rarest)
        if placed:
            state.matched_s = scan.mid_s
            numbers = {one.link.number for one in used.measured} if used else set()
            if not state.proven:
                references.known(numbers)
            state.proven = True
            judged = [number for number, one in tried.items() if number in numbers or not one.failure]
            references.judged({number: number in numbers for number in judged}, state.scans)
            self._clear_adrift(newest, {number: tried[number] for number in tried if tried[number].accepted})
        if state.similarity is not None:
            state.similarity = self._straightened(state.similarity, scan, used if placed else None)
        drift_m, drifts_m = _drifts(state.filters)
        adrift = bool(tried) and not placed
        anchor = not adrift and references.needs_anchor(scan, drift_m, drifts_m[:-1])
        references.kept.append(ReferenceScan(scan, newest.compensated_m_s, anchor, adrift, used=state.scans))
        if state.doubted_m is not None:
            self._drop(len(references) - 1)
        while (number := references.superfluous()) is not None:
            self._drop(number)

    def _straightened(self, similarity: Similarity, scan: DriftScan, used: Comparison | None) -> Similarity:
        best = None if used is None else used.measured[0]
        if best is None or best.found.linear_seen is None:
            return similarity.with_scan()
        pair = self._references.kept[best.link.number].scan, scan
        seen = SimilarityMeasurement.of(best.found.linear_seen, pair, self._settings.inflation)
        learned = similarity.learned(best.link.number, seen).with_scan()
        return learned.straight_about(best.found.center_m + best.found.displacement_m)

    def _cut_off(self, filters: Filters, scan: DriftScan) -> Filters:
        # the present and all scans adrift may be anywhere, but together: their places relative to each other are still
        # known
        adrift = [number for number, one in enumerate(self._references) if one.adrift]
        return filters.widened(self._limit_m(scan), self._settings.start_velocity_sd_m_s, scans=adrift)

    def _is_evidence(self, number: int) -> bool:
        return not (self._state.proven and self._references.kept[number].adrift)

    def _clear_adrift(self, newest: NewestScan, found: Table[int, Registration]) -> None:
        # clear the adrift flag of references found at their predicted position
        state = self._state
        assert state.filters is not None
        kept, states = self._references.kept, state.filters.mean.shape[1]
        for number in [number for number in found if kept[number].adrift]:
            one = PairMeasurement.of(newest, number, kept[number], found[number], self._settings.inflation)
            expected, covariance = state.filters.mixed(one.link.rows(states, states - 4))
            apart = one.value_m - expected
            if apart @ np.linalg.solve(covariance + one.pair_noise_m2, apart) <= AGREEMENT:
                self._references.known([number])

    def _drop(self, number: int) -> None:
        state = self._state
        assert state.filters is not None
        del self._references.kept[number]
        state.filters = state.filters.without_scan(number)
        if state.similarity is not None:
            state.similarity = state.similarity.without_scan(number)

    def _forecast_of(self, filters: Filters) -> BankForecast:
        state = self._state
        straight = None if state.similarity is None else state.similarity.straight
        return BankForecast.of(filters, state.compensation, straight)

    def _estimate(self, filters: Filters) -> Prediction:
        return self._forecast_of(filters).at(filters.time_s)

    def _limit_m(self, scan: DriftScan) -> float:
        # half of the largest misplacement at which scans can be compared
        return (1.0 - self._references.choice.overlap_min) * min(scan.region.size_m) / 2

    def state(self) -> Plain:
        return snapshot(self._state, "bank", VERSION)

    def restore(self, state: PlainMapping) -> None:
        """Restore the result of `state`. Raises InvalidValue for the state of another tracker or of other settings."""
        found = restored(BankState, state, "bank", VERSION)
        if (filters := found.filters) is not None:
            if (self._settings.transform == "similarity") != (found.similarity is not None):
                raise InvalidValue(f"a saved tracker of another transform than {self._settings.transform!r}")
            models, count = self._settings.models(), len(filters.log_weight)
            if count != len(models.density_m2_s3):
                raise InvalidValue(f"a saved bank of {count} filters instead of {len(models.density_m2_s3)}")
            found.filters = replace(filters, models=models)
        self._state, self._references.kept = found, found.references


def _drifts(filters: Filters) -> tuple[Array, Array]:
    return (filters.weight @ filters.mean)[:2], filters.scan_drifts_m()


def _why_not(tried: Table[int, Registration], found: Comparison | None, *, adrift: bool) -> str:
    if adrift:
        return "it matches only scans that themselves matched no older scan"
    if found is not None:
        far = f"found {found.surprise**0.5:.1f} standard deviations from where it was expected"
        return f"{far}; believed if the next one is too"
    if tried:
        failed = (one.failure for one in tried.values() if one.failure)
        return next(failed, next(iter(tried.values())).reason)
    return "no earlier scan of this part of the sample is stored"


def _coarse_reason(tried: Table[int, Registration]) -> str:
    failures = [one.failure for one in tried.values() if one.accepted]
    return failures[0] if failures and all(failures) else ""
