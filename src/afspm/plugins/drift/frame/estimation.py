"""The worker's task: registration of scans one after the other, with a memory of the last answers.

After a kill of worker or scheduler, a scan may be requested again. The answer then comes from memory: no tracker may
process a scan twice, and no scan has two mappings.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from afspm.basics import ConfigError, Plain
from afspm.model import Region
from afspm.plugins.drift.estimators import PairFailure
from afspm.plugins.drift.frame.messages import Registered
from afspm.plugins.drift.frame.settings import RescanRule
from afspm.plugins.drift.pairs.overlap import too_far_off, too_little_shared
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track.tracking import Tracker, Update

_ANSWERS = 16


class Estimation:
    """A tracker with a memory of its last answers.

    Args:
        save: function that saves the state, called before a result is returned.
        failures: list to which the tracker's estimator adds its errors; emptied before each scan.
    """

    def __init__(
        self, tracker: Tracker, rule: RescanRule, save: Callable[[Plain], None], failures: list[PairFailure]
    ) -> None:
        self._tracker = tracker
        self._rule = rule
        self._save = save
        self._failures = failures
        self._answers: OrderedDict[str, Registered] = OrderedDict()

    @property
    def forecast(self) -> Plain | None:
        """The tracker's forecast as plain JSON; None before the first scan."""
        return self._tracker.forecast.to_dict() if self._answers else None

    def restore(self, state: Plain) -> None:
        """Restore a saved state.

        Raises:
            InvalidValue, KeyError, TypeError: the state belongs to another tracker or version.
        """
        self._tracker.restore(state["tracker"])
        self._answers = OrderedDict((one["key"], Registered(**one)) for one in state["answers"])

    def register(self, key: str, scan: DriftScan, asked: Region | None = None) -> Registered:
        """Register a scan, or return the remembered answer.

        Args:
            key: unique key of the scan; `scan.key` is its name for people.
            asked: the requested region, in sample coordinates.

        Raises:
            AfspmError: the tracker refuses the scan.
        """
        known = self._answers.get(key)
        if known is not None:
            return known
        self._failures.clear()
        answer = self._answer(key, scan, asked, self._tracker.add(scan))
        self._answers[key] = answer
        if len(self._answers) > _ANSWERS:
            self._answers.popitem(last=False)
        self._keep()
        return answer

    def compensated(self, time_s: float, velocity_m_s: tuple[float, float]) -> None:
        """Take into account that the controller moves the tip with this velocity from `time_s` on.

        Raises:
            ConfigError: the tracker can't take this into account. InvalidValue: as `BankTracker.compensated`.
        """
        compensated = getattr(self._tracker, "compensated", None)
        if compensated is None:
            raise ConfigError("the tracker can't follow a controller that compensates", hint='tracker = "bank"')
        compensated(time_s, velocity_m_s)
        self._keep()

    def _keep(self) -> None:
        # not asdict: it copies sixteen forecasts at each scan, and an answer never changes
        self._save({"tracker": self._tracker.state(), "answers": [dict(vars(one)) for one in self._answers.values()]})

    def _answer(self, key: str, scan: DriftScan, asked: Region | None, update: Update) -> Registered:
        after, before = update.after, update.before
        center_m = np.asarray(scan.region.center_m)
        residual_m = before.mapping.apply(center_m) - after.mapping.apply(center_m)
        used = [key for key, one in update.registrations.items() if one.accepted]
        return Registered(
            key=key,
            time_s=scan.mid_s,
            matrix=after.mapping.matrix.tolist(),
            covariance_m2=_plain(after.covariance_m2),
            rate_m_s=_plain(after.rate_m_s),
            rate_covariance=_plain(after.rate_covariance),
            outcome=update.outcome,
            lost=update.lost,
            reason=update.reason,
            residual_m=_plain(residual_m),
            references=used,
            rescan=_why_again(self._rule, scan, asked, update),
            forecast=update.forecast.to_dict(),
            failures=list(dict.fromkeys(map(str, self._failures))),  # a pair may be tried in several ways
        )


def _why_again(rule: RescanRule, scan: DriftScan, asked: Region | None, update: Update) -> str:
    # before the first scan nothing was predicted, and an unmatched scan has no measured position
    if rule.rule == "never" or asked is None or not update.registrations or not update.matched or update.lost:
        return ""
    scanned = update.after.mapping.to_sample(scan.region)
    if rule.rule == "paper":
        return too_little_shared(asked, scanned, rule.f_rescan)
    tolerance_m = min(scan.region.size_m) / 10 if rule.tolerance is None else rule.tolerance
    return too_far_off(asked, scanned, update.after.sd_m, tolerance_m)


def _plain(array: object) -> list[Any]:
    plain: list[object] = np.asarray(array, dtype=np.float64).tolist()
    return plain
