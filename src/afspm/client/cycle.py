"""One scan or spectrum, followed through the published packets to its outcome, without input or output."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import Any

from afspm.model import MeasurementConditions, ScopeState


class CycleOutcome(Enum):
    """Outcome of one attempt at a scan or spectrum."""

    COMPLETED = auto()
    INTERRUPTED = auto()
    """The microscope reports a stop."""
    VANISHED = auto()
    """The microscope is free again without a result, e.g. after a restart of its controller."""
    ANOTHER = auto()
    """The results do not fit the request, e.g. since a person at the panel has moved the frame."""


class Cycle:
    """A measurement as a sequence of states: `busy`, then results, then FREE.

    After a lost connection the cache may hold the results without the state `busy`; such results count, too.

    Args:
        busy: the state during the measurement, SCANNING or SPEC.
        fits: returns whether a result fits the request. Only such results count, even while this component is in
            control: a person, or another program, can always use the controller itself.
        since_ns: packets up to this time belong to an earlier measurement; None: nothing was published before.
        resumed: whether the measurement was requested before a restart of the component, so that other components may
            have measured since.

    Attributes:
        begun: whether the state `busy`, or a fitting result, was published.
        results: the results that fit.
        other: the first result since `busy` that does not fit.
        conditions: those published last before the first result that fits; None: none were.
    """

    def __init__(
        self, busy: ScopeState, fits: Callable[[Any], bool], *, since_ns: int | None = None, resumed: bool = False
    ) -> None:
        self._busy = busy
        self._fits = fits
        self._since_ns = since_ns
        self._resumed = resumed
        self.begun = False
        self.outcome: CycleOutcome | None = None
        self.results: list[Any] = []
        self.other: Any = None
        self.conditions: MeasurementConditions | None = None

    def control_was_lost(self) -> None:
        """Note the loss of control: other components may measure from now on."""
        self._resumed = True

    def on_state(self, state: ScopeState, time_ns: int | None) -> None:
        """Process a published state of the microscope."""
        if self.outcome is not None or self._is_old(time_ns):
            return
        if state is self._busy:
            self.results.clear()  # results before the start belong to another measurement
            self.other = self.conditions = None
            self.begun = True
        elif not self.begun:
            return
        elif state is ScopeState.INTERRUPTED:
            self.outcome = CycleOutcome.INTERRUPTED
        elif state is ScopeState.FREE:
            without = CycleOutcome.VANISHED if self.other is None else CycleOutcome.ANOTHER
            self.outcome = CycleOutcome.COMPLETED if self.results else without

    def on_conditions(self, conditions: MeasurementConditions, time_ns: int | None) -> None:
        """Process the published conditions of the result that follows."""
        if self.outcome is None and not self.results and not self._is_old(time_ns):
            self.conditions = conditions

    def on_result(self, result: object, time_ns: int | None, *, is_ours: bool = True) -> None:
        """Process a published channel of a scan, or a spectrum.

        Args:
            is_ours: False if the translator says that another has asked for it, or a person at the microscope.
        """
        if self.outcome is not None or self._is_old(time_ns):
            return
        if is_ours and self._fits(result):
            self.begun = True
            self.results.append(result)
        elif self.begun and self.other is None:
            self.other = result

    def _is_old(self, time_ns: int | None) -> bool:
        if time_ns is None:  # a peer without times: count it, unless others may have measured since
            return self._resumed
        return self._since_ns is not None and time_ns <= self._since_ns
