"""The expected end of a measurement: the polling interval follows it, and a scan far beyond it is overdue. Pure.

The end of a scan must be noticed within 20 ms of the controller's report. But polling must not keep a controller busy
that serves one request at a time. So the interval shrinks in proportion to the time left until the expected end, and
grows again in proportion to the time since.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from afspm.basics.formatting import duration_text
from afspm.model.events import NO_LONGER_TRUE

EAGER_S = 0.01
"""Interval between polls when the end may come at any moment; the poll takes the rest of the 20 ms."""
_PART = 0.1  # of the time left until the expected end passes between two looks
_GUESSED, _BY_OTHERS, _SAME = (
    0.35,
    0.03,
    0.005,
)  # uncertainty of the end, as a part of the duration: by settings, by other scans, by the same scan
_LEAST_DOUBT_S = 0.05  # about the end of even the shortest measurement
_REMEMBERED = 64  # durations, of the kinds measured last


@dataclass(frozen=True)
class ExpectedEnd:
    """The expected end of a measurement that began at `began_s`, with its uncertainty; `end_s` is None if unknown."""

    began_s: float
    end_s: float | None = None
    doubt_s: float = 0.0


class AdaptivePolling:
    """The learnt durations of measurements, which determine the time until the next poll. All times are real seconds.

    Args:
        idle_s: interval between polls when no change is expected.
        eager_s: interval between polls when a change is expected at once.
    """

    def __init__(self, idle_s: float, eager_s: float = EAGER_S) -> None:
        self._idle_s = idle_s
        self._eager_s = min(eager_s, idle_s)
        self._lasted_s: OrderedDict[Hashable, float] = OrderedDict()
        self._ratio: float | None = None
        self._measuring: tuple[Hashable, float | None] | None = None
        self._expected: ExpectedEnd | None = None
        self._over_s: float | None = None

    def began(self, what: Hashable, now_s: float, guess_s: float | None = None) -> None:
        """Record the start of a measurement.

        Args:
            what: a key, equal for measurements of equal duration.
            guess_s: the duration computed from the settings; None if unknown.
        """
        self._measuring, self._over_s = (what, guess_s), None
        lasts_s, doubt = self._lasted_s.get(what), _SAME
        if lasts_s is None and guess_s is not None:
            lasts_s, doubt = guess_s * (self._ratio or 1.0), _GUESSED if self._ratio is None else _BY_OTHERS
        if lasts_s is None:
            self._expected = ExpectedEnd(now_s)
        else:
            self._expected = ExpectedEnd(now_s, now_s + lasts_s, max(_LEAST_DOUBT_S, doubt * lasts_s))

    @property
    def expected_s(self) -> float | None:
        """The expected duration of the measurement, learnt from earlier ones if there were any; None if unknown."""
        expected = self._expected
        return None if expected is None or expected.end_s is None else expected.end_s - expected.began_s

    def moved(self, now_s: float) -> None:
        """Record the start of a short activity."""
        self._measuring = None
        self._expected = ExpectedEnd(now_s, now_s)

    def over(self, now_s: float) -> None:
        """Record the end of the measurement at the controller; its result may take a moment to appear."""
        if self._over_s is None and self._expected is not None:
            self._over_s = now_s
            self._expected = ExpectedEnd(self._expected.began_s, now_s)

    def ended(self, now_s: float, *, as_expected: bool) -> None:
        """Record the arrival of the result, and learn the duration unless the measurement was interrupted."""
        if as_expected and self._measuring is not None and self._expected is not None:
            what, guess_s = self._measuring
            lasted_s = (now_s if self._over_s is None else self._over_s) - self._expected.began_s
            self._lasted_s[what] = lasted_s
            self._lasted_s.move_to_end(what)
            if len(self._lasted_s) > _REMEMBERED:
                self._lasted_s.popitem(last=False)
            if guess_s:
                self._ratio = lasted_s / guess_s
        self._measuring = self._expected = self._over_s = None

    def wait_s(self, now_s: float, *, end_is_reported: bool = False) -> float:
        """Return the time until the next poll.

        Args:
            end_is_reported: whether the controller itself reports the end of the running measurement.
        """
        expected = self._expected
        if expected is None or (end_is_reported and self._measuring is not None and self._over_s is None):
            return self._idle_s
        if expected.end_s is None:
            return self._eager_s
        away_s = max(0.0, abs(expected.end_s - now_s) - expected.doubt_s)
        return min(self._idle_s, max(self._eager_s, _PART * away_s))


OVERDUE_RATIO = 3.0
"""Ratio of a scan's duration to its expected duration above which the scan is overdue."""
OVERDUE_S = 600.0
"""Real time added to it: a controller may be slow to begin, and a person may pause a scan."""


class OverdueScan:
    """A watch over a scan that does not end, as of a controller that hangs: everything waits for it."""

    def __init__(self) -> None:
        self._began_s = self._again_s = math.inf
        self._lasted = ""

    def state_changed(self, now_s: float, *, is_scanning: bool) -> str:
        """Process a change of state at a real monotonic time; return the log line that ends an overdue scan, or ""."""
        lasted, self._lasted = self._lasted, ""
        self._began_s, self._again_s = (now_s, now_s + OVERDUE_S) if is_scanning else (math.inf, math.inf)
        return f"the controller reports the scan no longer; {NO_LONGER_TRUE}{lasted}" if lasted else ""

    @property
    def due_s(self) -> float:
        """Real monotonic time from which `look` examines the scan; infinite without a scan."""
        return self._again_s

    def look(self, now_s: float, expected_s: Callable[[], float | None]) -> str:
        """Return the log line about an overdue scan, once; "" otherwise.

        Args:
            expected_s: returns the expected duration in real time; None if unknown.
        """
        if now_s < self._again_s:
            return ""
        lasts_s, self._again_s = expected_s(), now_s + OVERDUE_S
        passed_s = now_s - self._began_s
        if lasts_s is None or passed_s <= OVERDUE_RATIO * lasts_s + OVERDUE_S:
            return ""
        self._again_s = math.inf
        self._lasted = f"the scan has lasted for {duration_text(passed_s)}"
        return f"{self._lasted}, {duration_text(lasts_s)} was expected: does the controller hang?"
